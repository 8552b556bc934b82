"""The sampler of nature's draws and of initial states."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestone.envs.base import (
    example_state,
    initial_state,
    inverse_cdf,
    sample_categorical,
    sample_initial,
    sample_step,
)
from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.magnet_arm import MagnetArm, go_down_task


class WindyWalk(eqx.Module):
    """A walk on the integers with a probability of going the wrong way: only what the sampler needs."""

    wrong: float = 0.25
    num_outcomes: int = 2

    def initial_distribution(self):
        return jnp.array([0.5, 0.0, 0.5]), jnp.array([10, 20, 30])

    def outcome_probs(self, state, action):
        return jnp.array([1 - self.wrong, self.wrong])

    def transition(self, state, action, outcome):
        return state + jnp.where(outcome == 0, action, -action)

    def reward(self, state, action, next_state):
        return (next_state - state).astype(jnp.float32)

    def terminal(self, state):
        return state == 31


draw_many = jax.jit(jax.vmap(sample_categorical, in_axes=(0, None)))


def draw(probs: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    return np.asarray(draw_many(jax.random.split(jax.random.key(seed), count), jnp.asarray(probs)))


@pytest.mark.parametrize("probs", [[0.5, 0.3, 0.2], [0.0, 1.0, 0.0], [0.1, 0.0, 0.0, 0.9], [1.0], [2.0, 6.0]])
def test_frequencies(probs: list[float]) -> None:
    probs = np.array(probs, dtype=np.float32)
    count = 40_000
    frequency = np.bincount(draw(probs, count), minlength=len(probs)) / count
    expected = probs / probs.sum()
    assert np.all(np.abs(frequency - expected) <= 5 * np.sqrt(expected * (1 - expected) / count))


@given(st.lists(st.sampled_from([0.0, 1e-6, 0.1, 0.7]), min_size=6, max_size=6).filter(any), st.integers(0, 2**31))
def test_probability_zero_is_never_drawn(probs: list[float], seed: int) -> None:
    probs = np.array(probs, dtype=np.float32)
    assert np.all(probs[draw(probs, 64, seed)] > 0)


@pytest.mark.parametrize("size", [4, 64, 1000])
def test_extreme_uniform_numbers_pick_no_probability_zero(size: int) -> None:
    """At both ends of the unit interval and at each edge between two outcomes."""
    rng = np.random.default_rng(0)
    probs = np.where(rng.random(size) < 0.5, 0, rng.random(size)).astype(np.float32)
    probs[[0, 1, -1]] = 0, 0.5, 0
    edges = np.asarray(jnp.cumsum(jnp.asarray(probs)))
    edges = edges / edges[-1]
    near = np.concatenate([edges, np.nextafter(edges, 0), np.nextafter(edges, 1), np.float32([0, 1])])
    uniforms = jnp.asarray(np.clip(near, 0, np.float32(1 - 2.0**-23)))
    picked = jax.vmap(inverse_cdf, in_axes=(None, 0))(jnp.asarray(probs), uniforms)
    assert np.all(probs[np.asarray(picked)] > 0)


def test_step_follows_the_outcome_probabilities() -> None:
    walk = WindyWalk()
    keys = jax.random.split(jax.random.key(0), 10_000)
    steps = jax.vmap(lambda key: sample_step(walk, key, jnp.int32(30), jnp.int32(1)))(keys)
    right = np.asarray(steps.state) == 31
    assert abs(right.mean() - 0.75) < 0.02
    np.testing.assert_array_equal(steps.terminated, right)
    np.testing.assert_array_equal(steps.reward, np.where(right, 1, -1))


def test_initial_states_follow_their_probabilities() -> None:
    keys = jax.random.split(jax.random.key(0), 4_000)
    states = np.asarray(jax.vmap(lambda key: sample_initial(WindyWalk(), key))(keys))
    assert set(states) == {10, 30}
    assert abs(np.mean(states == 10) - 0.5) < 0.04


@pytest.mark.parametrize("compiled", [False, True])
def test_even_initial_states_share_the_unit_interval_evenly(compiled: bool) -> None:
    rooms = FourRooms()
    uniforms = jnp.asarray((np.arange(103 * 8) + 0.5) / (103 * 8), dtype=jnp.float32)
    draw_start = jax.vmap(partial(initial_state, rooms))
    cells = np.asarray((jax.jit(draw_start) if compiled else draw_start)(uniforms).cell)
    np.testing.assert_array_equal(cells, np.repeat(np.delete(np.arange(104), rooms.goal), 8))
    last = initial_state(rooms, jnp.float32(1 - 2.0**-24))
    assert int(last.cell) == 103


def test_example_state_is_the_first_initial_state() -> None:
    arm = MagnetArm()
    state = example_state(arm)
    assert (int(state.row), int(state.column), bool(state.magnet)) == (0, 0, False)
    assert state.bricks.tolist() == [1, 1, 1]


def test_a_task_changes_start_end_and_reward_but_not_the_dynamics() -> None:
    arm = MagnetArm()
    task = go_down_task(arm)
    probs, states = task.initial_distribution()
    assert probs.shape == states.row.shape
    assert task == go_down_task(MagnetArm())
    assert hash(task) == hash(go_down_task(MagnetArm()))
    state, down = example_state(arm), jnp.int32(3)
    ours, theirs = task.transition(state, down, jnp.int32(0)), arm.transition(state, down, jnp.int32(0))
    assert jax.tree.all(jax.tree.map(jnp.array_equal, ours, theirs))
    assert task.action_names == arm.action_names
    np.testing.assert_array_equal(task.observe(state), arm.observe(state))
