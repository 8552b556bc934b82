"""Numbering the states that an environment can reach."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.envs.base import example_state
from lodestone.envs.magnet_arm import ArmState, MagnetArm, go_down_task
from lodestone.envs.state_space import StateSpace, reachable_states
from lodestone.errors import TooManyStates


@pytest.mark.parametrize(
    ("size", "states", "goals"),
    [
        ((4, 3, 2, 2), 84, 6),
        ((4, 3, 3, 3), 156, 3),
        ((5, 3, 4, 4), 330, 3),
        ((5, 4, 4, 4), 1180, 4),
        ((6, 4, 4, 4), 1512, 8),
    ],
)
def test_counts(size: tuple[int, int, int, int], states: int, goals: int) -> None:
    """The numbers of SYSTEMS 1.1, found there by another program."""
    arm = MagnetArm(*size)
    space = reachable_states(arm)
    assert space.size == states
    assert int(jnp.sum(jax.vmap(arm.terminal)(space.states))) == goals


@pytest.fixture(scope="module")
def space() -> StateSpace:
    return reachable_states(MagnetArm(6, 4, 4, 4))


def test_index_of_is_the_inverse_of_state(space: StateSpace) -> None:
    np.testing.assert_array_equal(jax.jit(jax.vmap(space.index_of))(space.states), np.arange(space.size))
    state = space.state(jnp.int32(777))
    assert int(space.index_of(state)) == 777


def test_all_numbered_states_are_different(space: StateSpace) -> None:
    leaves = [np.asarray(leaf).reshape(space.size, -1) for leaf in jax.tree.leaves(space.states)]
    assert len(np.unique(np.concatenate(leaves, axis=1).astype(np.int64), axis=0)) == space.size


def test_initial_states_come_first_and_levels_follow(space: StateSpace) -> None:
    """A state's number is above that of a state from which it was reached: breadth first."""
    arm = MagnetArm(6, 4, 4, 4)
    assert int(space.index_of(example_state(arm))) == 0

    @jax.jit
    @partial(jax.vmap, in_axes=(0, None))
    @partial(jax.vmap, in_axes=(None, 0))
    def successor(state: ArmState, action: jax.Array) -> jax.Array:
        return space.index_of(arm.transition(state, action, jnp.int32(0)))

    numbers = np.asarray(successor(space.states, jnp.arange(6)))
    live = ~np.asarray(jax.vmap(arm.terminal)(space.states))
    first_from = np.full(space.size, space.size)
    np.minimum.at(first_from, numbers[live].ravel(), np.repeat(np.flatnonzero(live), 6))
    assert np.all(first_from[1:] < np.arange(1, space.size))
    assert np.all(np.diff(first_from[1:]) >= 0)


def test_contains(space: StateSpace) -> None:
    contains = jax.jit(lambda state: space.contains(state))
    assert bool(jnp.all(jax.vmap(contains)(space.states)))
    state = space.state(jnp.int32(5))
    assert not bool(contains(state._replace(row=jnp.int8(100))))
    assert not bool(contains(state._replace(bricks=jnp.zeros_like(state.bricks))))


def test_terminal_states_are_not_expanded() -> None:
    """The go-down task ends where the arm is down: nothing is reached from there."""
    task = go_down_task(MagnetArm())
    space = reachable_states(task)
    _, starts = task.initial_distribution()
    np.testing.assert_array_equal(jax.jit(jax.vmap(space.index_of))(starts), np.arange(len(starts.row)))
    live = ~np.asarray(jax.vmap(task.terminal)(space.states))
    assert 0 < live.sum() < space.size


def test_the_numbering_is_remembered() -> None:
    assert reachable_states(MagnetArm()) is reachable_states(MagnetArm())


def test_too_many_states() -> None:
    with pytest.raises(TooManyStates, match="More than 100 states"):
        reachable_states(MagnetArm(), limit=100)
