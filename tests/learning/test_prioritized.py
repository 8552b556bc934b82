"""Prioritized replay against the distribution that it is an approximation of, and a naive list."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.learning.prioritized import LEAST_ERROR, draw, empty_prioritized, remember, renew

SEEN = [2.0, 0.5, 4.0, 1.0, 0.0]


def filled() -> tuple:
    """Five items with the errors above, in a replay for eight."""
    replay = empty_prioritized(jnp.int32(0), 8)
    replay = remember(replay, jnp.arange(10, 16, dtype=jnp.int32), jnp.array([True, True, False, True, True, True]))
    return renew(replay, jnp.arange(5), jnp.asarray(SEEN)), np.array([10, 11, 13, 14, 15])


@pytest.mark.parametrize("exponent", [0.0, 0.6, 1.0])
def test_items_are_drawn_in_proportion_to_their_errors(exponent: float) -> None:
    replay, held = filled()
    keys = jax.random.split(jax.random.key(0), 500)
    drawn = jax.vmap(lambda key: draw(replay, key, 16, exponent, 0.5))(keys)
    wanted = (np.array(SEEN) + LEAST_ERROR) ** exponent
    shares = [np.mean(np.asarray(drawn.items) == number) for number in held]
    # 1024 candidates for every 16: their own scatter is the larger part of the error.
    np.testing.assert_allclose(shares, wanted / wanted.sum(), atol=0.01)
    np.testing.assert_array_equal(held[np.asarray(drawn.slots)], drawn.items)


def test_weights_are_those_of_importance_sampling() -> None:
    replay, held = filled()
    for correction in (0.0, 0.5, 1.0):
        drawn = draw(replay, jax.random.key(1), 64, 0.7, correction)
        probs = (np.array(SEEN) + LEAST_ERROR) ** 0.7
        probs = (probs / probs.sum())[np.asarray(drawn.slots)]
        wanted = (1 / (len(held) * probs)) ** correction
        np.testing.assert_allclose(drawn.weights, wanted / wanted.max(), rtol=1e-5)


def test_fully_corrected_draws_have_the_mean_of_uniform_ones() -> None:
    """The ratio of two sums estimates it, as weights are known but for a factor."""
    replay, held = filled()
    keys = jax.random.split(jax.random.key(2), 150)
    drawn = jax.vmap(lambda key: draw(replay, key, 800, 0.5, 1.0))(keys)
    weights, slots = np.asarray(drawn.weights), np.asarray(drawn.slots)
    assert (slots == 4).any(axis=1).all()  # so that this factor is the same in every batch: that of the least likely
    np.testing.assert_allclose((weights * held[slots]).sum() / weights.sum(), held.mean(), atol=0.03)


def test_what_has_not_been_learned_from_counts_as_the_worst() -> None:
    replay, _ = filled()
    replay = remember(replay, jnp.array([20, 21], dtype=jnp.int32), jnp.array([True, True]))
    errors = np.asarray(replay.ring.storage.error)
    np.testing.assert_allclose(errors[:5], np.array(SEEN) + LEAST_ERROR, rtol=1e-6)
    np.testing.assert_allclose(errors[5:7], 4.0 + LEAST_ERROR, rtol=1e-6)


def test_a_slot_that_comes_twice_keeps_the_larger_error_and_slots_beyond_the_end_are_nothing() -> None:
    replay, _ = filled()
    after = renew(replay, jnp.array([2, 0, 2, 8, jnp.iinfo(jnp.int32).max]), jnp.array([0.25, 0.125, 0.5, 9.0, 9.0]))
    wanted = np.array([0.125, *SEEN[1:2], 0.5, *SEEN[3:]]) + LEAST_ERROR
    np.testing.assert_allclose(after.ring.storage.error[:5], wanted, rtol=1e-6)
    assert float(after.highest) == float(replay.highest)


def test_an_empty_replay_gives_empty_items() -> None:
    drawn = draw(empty_prioritized(jnp.int32(0), 8), jax.random.key(0), 4, 1.0, 0.5)
    assert drawn.items.tolist() == [0] * 4
    assert np.isfinite(drawn.weights).all()
