"""Two rooms: the known values, the walls, the pictures."""

from __future__ import annotations

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import lodestone  # noqa: F401 (registers the environments)
from lodestone.envs.state_space import reachable_states
from lodestone.envs.two_rooms import EAST, GOAL, GREEN, NORTH, RED, SOUTH, TwoRooms, TwoRoomsState
from lodestone.errors import InvalidConfig
from lodestone.planning.solve import optimum, value_iteration
from lodestone.planning.tables import tabulate


def at(row: int, column: int) -> TwoRoomsState:
    return TwoRoomsState(jnp.int8(row), jnp.int8(column))


def test_the_optimum_from_the_left_room():
    found = optimum(TwoRooms())
    assert (found.states, found.goals) == (56, 1)
    assert found.optimal_return == pytest.approx(-7.75)
    assert found.optimal_steps == pytest.approx(7.75)


def test_the_value_of_every_cell():
    tables = tabulate(TwoRooms())
    values = np.full((8, 7), np.nan)
    values[tables.space.states.row, tables.space.states.column] = value_iteration(tables, discount=1.0).values

    row, column = np.indices((8, 7))
    to_goal = np.where(column < 6, abs(row - GOAL[0]) + abs(column - GOAL[1]), np.inf)
    by_a_door = np.minimum(row + to_goal[0, 4], 7 - row + to_goal[7, 4]) + 4 - column
    np.testing.assert_allclose(values, -np.where(column < 4, by_a_door, to_goal))
    assert (values[0, 4], values[7, 4]) == (-2, -7)


def test_only_the_doors_lead_from_room_to_room():
    rooms = TwoRooms()

    def after(row: int, column: int, action: int) -> tuple[int, int]:
        state = rooms.transition(at(row, column), jnp.int32(action), jnp.int32(0))
        return int(state.row), int(state.column)

    assert [after(row, 3, EAST)[1] for row in range(8)] == [4, 3, 3, 3, 3, 3, 3, 4]
    assert after(4, 2, EAST) == (4, 3)
    assert after(0, 0, NORTH) == (0, 0)
    assert after(7, 5, SOUTH) == (7, 5)
    assert after(3, 6, EAST) == (3, 6)
    assert after(3, 4, NORTH) == (2, 4)
    assert [bool(rooms.in_left_room(at(0, column))) for column in range(7)] == [True] * 4 + [False] * 3


def test_pictures_show_the_agent_in_its_cell():
    rooms = TwoRooms()
    states = jax.tree.map(jnp.asarray, reachable_states(rooms).states)
    planes, cells = jax.vmap(rooms.observe)(states), jax.vmap(TwoRooms("cell").observe)(states)
    np.testing.assert_array_equal(planes.reshape(56, 56).argmax(axis=1), cells)
    np.testing.assert_array_equal(cells, states.row.astype(np.int32) * 7 + states.column.astype(np.int32))
    assert (planes.sum(axis=(1, 2, 3)) == 1).all()

    side, frame = 44, 12
    for row, column in np.ndindex(8, 7):
        picture = rooms.render(at(row, column))
        rows, columns = np.nonzero((picture == RED).all(axis=-1))
        assert {*((rows - frame) // side).tolist()} == {row}
        assert {*((columns - frame) // side).tolist()} == {column}
        assert (picture[frame + side * GOAL[0] + 4, frame + side * GOAL[1] + 4] == GREEN).all()


@pytest.mark.parametrize("observation", ["planes", "cell"])
def test_gymnasium_takes_it(observation):
    check_env(gymnasium.make("lodestone/TwoRooms-v0", observation=observation).unwrapped, skip_render_check=True)


def test_bad_parameters_are_named():
    with pytest.raises(InvalidConfig, match="observation is 'rgb', but must be 'planes' or 'cell'"):
        TwoRooms(observation="rgb")
