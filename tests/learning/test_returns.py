"""Targets of several steps against their definition, a mixture of n-step returns, in a plain loop."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.learning.returns import lambda_returns

LENGTH, GAMMA = 12, 0.9


def sequence(seed: int) -> tuple[np.ndarray, ...]:
    """Rewards, discounts, values and cuts of some steps: one that terminates, one at a limit, one with both marks."""
    rng = np.random.default_rng(seed)
    reward, value = rng.normal(size=(2, LENGTH)).astype(np.float32)
    terminated, cut = np.zeros((2, LENGTH), dtype=bool)
    terminated[[3, 8]], cut[[6, 8]] = True, True
    return reward, np.where(terminated, 0, GAMMA).astype(np.float32), value, cut


def n_step(reward: np.ndarray, discount: np.ndarray, value: np.ndarray, steps: range) -> float:
    """The rewards of these steps, and the value of where they led to."""
    total, weight = 0.0, 1.0
    for t in steps:
        total += weight * reward[t]
        weight *= discount[t]
    return total + weight * value[steps[-1]]


@pytest.mark.parametrize("decay", [0.0, 0.7, 1.0])
def test_a_mixture_of_n_step_returns(decay):
    for seed in range(3):
        reward, discount, value, cut = sequence(seed)
        found = lambda_returns(*map(jnp.asarray, (reward, discount, value, cut)), decay)
        for t in range(LENGTH):
            last = next((s for s in range(t, LENGTH) if cut[s]), LENGTH - 1)
            returns = [n_step(reward, discount, value, range(t, s + 1)) for s in range(t, last + 1)]
            weights = [(1 - decay) * decay**n for n in range(len(returns))]
            weights[-1] = decay ** (len(returns) - 1)
            assert float(found[t]) == pytest.approx(np.dot(weights, returns), abs=1e-5)


def test_an_end_has_no_future_and_a_limit_has():
    """The future is neither in the next steps of the sequence, where another episode has begun."""
    reward, value = jnp.array([1.0, 5.0]), jnp.array([10.0, 20.0])
    limit, never = jnp.array([True, False]), jnp.array([False, False])
    gamma = jnp.array([0.5, 0.5])
    np.testing.assert_allclose(lambda_returns(reward, gamma, value, limit, 1.0), [1 + 0.5 * 10, 5 + 0.5 * 20])
    np.testing.assert_allclose(lambda_returns(reward, gamma.at[0].set(0.0), value, never, 1.0)[0], 1.0)
    np.testing.assert_allclose(lambda_returns(reward, gamma, value, never, 1.0)[0], 1 + 0.5 * (5 + 0.5 * 20))


def test_sequences_do_not_touch_one_another():
    each = [tuple(map(jnp.asarray, sequence(seed))) for seed in range(3)]
    together = jax.vmap(lambda_returns, in_axes=(0, 0, 0, 0, None))(*map(jnp.stack, zip(*each, strict=True)), 0.7)
    for row, one in zip(together, each, strict=True):
        np.testing.assert_allclose(row, lambda_returns(*one, 0.7), rtol=1e-6)
