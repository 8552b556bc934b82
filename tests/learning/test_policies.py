"""Choices run over what is available, and ties are broken evenly."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.learning.policies import epsilon_greedy, greedy

DRAWS = 8000
VALUES = jnp.array([1.0, 3.0, 3.0, 9.0])
AVAILABLE = jnp.array([True, True, True, False])


def frequencies(epsilon: float) -> np.ndarray:
    uniform = jax.random.uniform(jax.random.key(0), (DRAWS, 2))
    chosen = jax.vmap(epsilon_greedy, in_axes=(0, None, None, None))(uniform, VALUES, AVAILABLE, jnp.float32(epsilon))
    return np.bincount(np.asarray(chosen), minlength=4) / DRAWS


@pytest.mark.parametrize(
    ("epsilon", "wanted"),
    [(0.0, [0, 1 / 2, 1 / 2, 0]), (1.0, [1 / 3, 1 / 3, 1 / 3, 0]), (0.3, [0.1, 0.45, 0.45, 0])],
)
def test_epsilon_greedy_frequencies(epsilon, wanted):
    found = frequencies(epsilon)
    assert found[3] == 0
    np.testing.assert_allclose(found, wanted, atol=4 * 0.5 / np.sqrt(DRAWS))


def test_greedy_takes_the_first_best_available():
    assert int(greedy(VALUES, AVAILABLE)) == 1
