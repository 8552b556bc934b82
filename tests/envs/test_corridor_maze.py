"""The corridor maze: its geometry, its predicates, and its optimum by other means."""

from __future__ import annotations

from collections import deque

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import lodestone  # noqa: F401 (registers the environments)
from lodestone.envs.corridor_maze import CorridorMaze, MazeState
from lodestone.envs.four_rooms import AGENT, GOAL, PALETTE, STEPS, WALL
from lodestone.envs.state_space import reachable_states
from lodestone.errors import InvalidConfig
from lodestone.planning.solve import optimum

SMALL = {"rows": 3, "columns": 2, "width": 2, "length": 4, "maze_seed": 2}


def goal_square(maze: CorridorMaze) -> tuple[int, int]:
    """The middle of the last intersection, counted from the bottom right corner."""
    height, width = maze.layout.free.shape
    back = 1 + maze.width - maze.width // 2
    return height - back, width - back


def walking_distance(maze: CorridorMaze) -> int:
    """Steps from start to goal by breadth-first search over the squares."""
    start = (1 + maze.width // 2,) * 2
    distance, queue = {start: 0}, deque([start])
    while queue:
        row, column = queue.popleft()
        for ahead in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)):
            if maze.layout.free[ahead] and ahead not in distance:
                distance[ahead] = distance[row, column] + 1
                queue.append(ahead)
    return distance[goal_square(maze)]


def expected_steps(maze: CorridorMaze) -> float:
    """Fewest expected steps from start to goal, by sweeps over the whole grid of squares."""
    free, steps = maze.layout.free, np.zeros(maze.layout.free.shape)
    aside, change = (1 - maze.move_success) / 2, np.inf
    while change > 1e-10:
        up, down, left, right = (
            np.where(np.roll(free, shift, axis), np.roll(steps, shift, axis), steps)
            for shift, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1))
        )
        vertical, horizontal = np.minimum(up, down), np.minimum(left, right)
        best = np.minimum(
            maze.move_success * vertical + aside * (left + right), maze.move_success * horizontal + aside * (up + down)
        )
        updated = np.where(free, 1 + best, 0.0)
        updated[goal_square(maze)] = 0.0
        steps, change = updated, np.abs(updated - steps).max()
    return float(steps[1 + maze.width // 2, 1 + maze.width // 2])


def test_the_maze_is_a_lattice_of_corridors_with_one_gap_at_each_obstacle():
    maze = CorridorMaze()
    free, obstacles = maze.layout.free, maze.layout.obstacles
    assert free.shape == (8 * 3 + 7 * 9 + 2,) * 2
    assert not free[[0, -1]].any()
    assert not free[:, [0, -1]].any()
    assert free.sum() + obstacles.sum() == 64 * 9 + 112 * 27
    assert reachable_states(maze).size == free.sum()

    corridors = [
        open_[1 + 12 * row : 4 + 12 * row, 4 + 12 * column : 13 + 12 * column]
        for open_ in (free, free.T)
        for row in range(8)
        for column in range(7)
    ]
    blocks = 3 - np.array([corridor.sum(axis=0) for corridor in corridors])
    assert blocks.shape == (112, 9)
    assert set(blocks.sum(axis=1).tolist()) == {0, 2}
    assert set(blocks.ravel().tolist()) == {0, 2}
    assert not blocks[:, [0, -1]].any()
    # A block touches one of the walls, so that the gap is at the other.
    assert all(corridor[[0, -1]].any(axis=0).all() for corridor in corridors)
    assert 64 < (blocks.sum(axis=1) > 0).sum() < 104
    assert {corridor[0].all() for corridor in corridors if not corridor.all()} == {True, False}


def test_the_seed_and_the_probability_choose_the_obstacles():
    some, others, all_of_them, none = (
        CorridorMaze(**chosen).layout.obstacles
        for chosen in ({}, {"maze_seed": 1}, {"obstacle_prob": 1.0}, {"obstacle_prob": 0.0})
    )
    assert (some != others).any()
    assert all_of_them.sum() == 112 * 2
    assert (all_of_them | some == all_of_them).all()
    assert not none.any()
    assert not CorridorMaze(width=1).layout.obstacles.any()


@pytest.mark.parametrize("size", [{}, SMALL, {"rows": 1, "columns": 2, "width": 1, "length": 3}, {"width": 4}])
def test_the_optimal_steps_without_slips_are_the_walking_distance(size):
    maze = CorridorMaze(**size, move_success=1.0)
    found = optimum(maze)
    assert found.states == maze.layout.free.sum()
    assert found.goals == 1
    assert found.optimal_steps == pytest.approx(walking_distance(maze))
    assert found.optimal_return == pytest.approx(100 - walking_distance(maze))


@pytest.mark.parametrize("size", [{}, SMALL])
def test_the_optimal_steps_with_slips_are_those_of_another_computation(size):
    maze = CorridorMaze(**size)
    steps = expected_steps(maze)
    found = optimum(maze)
    assert found.optimal_steps == pytest.approx(steps, abs=1e-3)
    assert found.optimal_return == pytest.approx(100 - steps, abs=1e-3)
    assert steps > walking_distance(maze) / 0.8


def test_predicates_tell_what_the_maze_shows():
    maze = CorridorMaze(**SMALL)
    squares, free = maze.layout.squares, maze.layout.free
    states = MazeState(jnp.arange(len(squares), dtype=jnp.int32))
    blocked = jax.vmap(jax.vmap(maze.blocked, in_axes=(None, 0)), in_axes=(0, None))(states, jnp.arange(4))
    np.testing.assert_array_equal(blocked, [[not free[tuple(square + step)] for step in STEPS] for square in squares])
    pitch = maze.width + maze.length
    inside = ((squares - 1) % pitch < maze.width).all(axis=1)
    np.testing.assert_array_equal(jax.vmap(maze.at_intersection)(states), inside)
    assert inside.sum() == 6 * 4


def test_a_move_slips_to_both_sides_and_walls_hold():
    maze = CorridorMaze()
    corner = int(np.flatnonzero((maze.layout.squares == (1, 1)).all(axis=1))[0])
    state = MazeState(jnp.int32(corner))
    np.testing.assert_allclose(maze.outcome_probs(state, jnp.int32(1)), [0.8, 0.1, 0.1], atol=1e-6)
    squares = [
        maze.layout.squares[int(maze.transition(state, jnp.int32(1), jnp.int32(outcome)).cell)].tolist()
        for outcome in range(3)
    ]
    assert squares == [[2, 1], [1, 1], [1, 2]]


def test_no_picture_draws_the_agent_in_a_wall():
    maze = CorridorMaze(**SMALL, pixels_per_cell=2)
    free = maze.layout.free
    states = MazeState(jnp.arange(len(maze.layout.squares), dtype=jnp.int32))
    seen = np.asarray(jax.vmap(maze.observe)(states))
    assert seen.shape == (len(states.cell), 2 * free.shape[0], 2 * free.shape[1], 3)
    assert (seen[:, 1::2, ::2][:, ~free] == PALETTE[WALL]).all()
    for cell, (row, column) in enumerate(maze.layout.squares):
        assert (seen[cell, 2 * row : 2 * row + 2, 2 * column : 2 * column + 2] == PALETTE[AGENT]).all()
        goal = PALETTE[AGENT if cell == maze.layout.goal else GOAL]
        assert (seen[cell, 2 * goal_square(maze)[0], 2 * goal_square(maze)[1]] == goal).all()

        picture = maze.render(MazeState(np.int32(cell)))
        side = picture.shape[0] // free.shape[0]
        rows, columns = np.nonzero((picture == PALETTE[AGENT]).all(axis=-1))
        assert {*(rows // side).tolist()} == {row}
        assert {*(columns // side).tolist()} == {column}


@pytest.mark.parametrize("observation", ["rgb", "cell"])
def test_gymnasium_takes_it(observation):
    env = gymnasium.make("lodestone/CorridorMaze-v0", rows=1, columns=2, observation=observation)
    check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"rows": 0}, "rows is 0, but must be at least 1"),
        ({"rows": 1, "columns": 1}, "two intersections"),
        ({"length": 2}, "length is 2, but must be at least 3"),
        ({"obstacle_prob": -0.1}, "obstacle_prob is -0.1, but must be a probability"),
        ({"move_success": float("nan")}, "move_success is nan"),
        ({"maze_seed": -1}, "maze_seed is -1"),
        ({"goal_reward": float("inf")}, "goal_reward is inf"),
        ({"observation": "planes"}, "'planes'"),
    ],
)
def test_bad_parameters_are_named(wrong, says):
    with pytest.raises(InvalidConfig, match=says):
        CorridorMaze(**wrong)
