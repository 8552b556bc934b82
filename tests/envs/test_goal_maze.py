"""The maze of four goals: its exact numbers against a plain search, its walls, its pictures."""

from __future__ import annotations

from collections import deque

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lodestone  # noqa: F401 (registers the environments)
from lodestone.envs.four_rooms import AGENT, FLOOR, GOAL, PALETTE, WALL
from lodestone.envs.goal_maze import GOALS, MAZE, SQUARES, GoalMaze, GoalState
from lodestone.errors import InvalidConfig
from lodestone.planning.solve import optimum, value_iteration
from lodestone.planning.tables import tabulate

DOWN, RIGHT = 1, 3


def distances(goal: tuple[int, int]) -> dict[tuple[int, int], int]:
    """Steps to a goal from every free square, by a search on the drawing."""
    found, waiting = {goal: 0}, deque([goal])
    while waiting:
        row, column = waiting.popleft()
        for ahead in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
            inside = 0 <= ahead[0] < 7 and 0 <= ahead[1] < 7
            if inside and MAZE[ahead[0]][ahead[1]] != "#" and ahead not in found:
                found[ahead] = found[row, column] + 1
                waiting.append(ahead)
    return found


def at(row: int, column: int, goal: int = 0) -> GoalState:
    cell = int(np.flatnonzero(((row, column) == SQUARES).all(axis=1))[0])
    return GoalState(jnp.int32(cell), jnp.int32(GOALS[goal]))


def test_the_optimum_is_that_of_a_search():
    """Mean of the distances from 30 cells to four goals: 6.4 to the upper ones, 7 4/15 to the lower ones."""
    found = optimum(GoalMaze())
    assert (found.states, found.optimal_steps) == (136, pytest.approx(6.8 + 1 / 30))
    assert found.optimal_return == pytest.approx(20 - 6.8 - 1 / 30)
    tables = tabulate(GoalMaze())
    values = value_iteration(tables, discount=1.0).values
    for index in range(tables.num_states):
        state = tables.space.state(index)
        steps = distances(tuple(SQUARES[int(state.goal)]))[tuple(SQUARES[int(state.cell)])]
        assert values[index] == pytest.approx(20 - steps if steps else 0)


def test_goals_are_the_corners_and_episodes_begin_elsewhere():
    assert SQUARES[GOALS].tolist() == [[0, 0], [0, 6], [6, 0], [6, 6]]
    probs, starts = GoalMaze().initial_distribution()
    assert probs.shape == (120,)
    assert not np.isin(starts.cell, GOALS).any()
    assert set(np.asarray(starts.goal).tolist()) == set(GOALS.tolist())


def test_walls_and_edges_hold_back_and_other_goals_do_not_end_the_episode():
    maze = GoalMaze()

    def after(state: GoalState, action: int) -> GoalState:
        return maze.transition(state, jnp.int32(action), jnp.int32(0))

    for state, action, place in ((at(0, 2), RIGHT, (0, 2)), (at(6, 0), DOWN, (6, 0)), (at(0, 5), RIGHT, (0, 6))):
        assert tuple(SQUARES[int(after(state, action).cell)]) == place
    arrived = after(at(0, 5, goal=1), RIGHT)
    assert bool(maze.terminal(arrived))
    assert float(maze.reward(at(0, 5, goal=1), jnp.int32(RIGHT), arrived)) == 19.0
    assert not maze.terminal(after(at(0, 5, goal=0), RIGHT))


def test_pictures_show_walls_the_goal_and_the_agent():
    state = at(3, 2, goal=2)
    codes = np.array([[WALL if square == "#" else FLOOR for square in row] for row in MAZE])
    codes[6, 0], codes[3, 2] = GOAL, AGENT
    np.testing.assert_array_equal(GoalMaze().observe(state), PALETTE[codes])
    assert GoalMaze(pixels_per_cell=2).observe(state).shape == (14, 14, 3)
    planes = np.asarray(GoalMaze(observation="planes").observe(state))
    assert planes.dtype == np.int8
    for plane, code in enumerate((WALL, GOAL, AGENT)):
        np.testing.assert_array_equal(planes[..., plane], codes == code)
    assert GoalMaze().render(state).shape == (280, 280, 3)


def test_it_is_a_gymnasium_environment():
    env = gymnasium.make("lodestone/GoalMaze-v0", observation="planes")
    assert env.reset(seed=0)[0].shape == (7, 7, 3)
    assert env.step(0)[1] in (-1.0, 19.0)


@pytest.mark.parametrize("wrong", [{"observation": "index"}, {"goal_reward": np.inf}, {"pixels_per_cell": 0}])
def test_bad_parameters_are_refused(wrong):
    with pytest.raises(InvalidConfig, match=next(iter(wrong))):
        GoalMaze(**wrong)


def test_the_observation_is_compiled():
    assert jax.jit(GoalMaze().observe)(at(3, 3)).shape == (7, 7, 3)
