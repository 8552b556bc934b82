"""Choices run over what is available, and ties are broken evenly."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.learning.policies import choose, epsilon_greedy, greedy, largest, one_for_two

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


@pytest.mark.parametrize("size", [1, 5, 12, 40])
@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_choices_entry_by_entry_are_epsilon_greedy(size, epsilon):
    """With ties, and with options that may not start."""
    rng = np.random.default_rng(size)
    values = jnp.asarray(rng.integers(-2, 3, size=(400, size)), dtype=jnp.float32)
    available = jnp.asarray(rng.random((400, size)) < 0.6).at[:, rng.integers(size)].set(True)
    uniform = jnp.asarray(rng.random((400, 2)), dtype=jnp.float32)
    draws = (jax.vmap(one, in_axes=(0, 0, 0, None)) for one in (choose, epsilon_greedy))
    found, wanted = (draw(uniform, values, available, jnp.float32(epsilon)) for draw in draws)
    np.testing.assert_array_equal(found, wanted)
    np.testing.assert_array_equal(jax.vmap(largest)(values), values.max(axis=1))


@pytest.mark.parametrize("epsilon", [0.0, 1e-3, 0.3, 1.0])
def test_one_number_serves_for_exploring_and_for_picking(epsilon):
    """On either side of epsilon the pick is uniform in [0, 1), up to the spacing of the numbers there."""
    uniform = jnp.arange(0, 1, 2.0**-20, dtype=jnp.float32).at[-1].set(1 - 2.0**-23)
    explores, picks = one_for_two(uniform, jnp.float32(epsilon))
    explores = explores < epsilon
    assert float(jnp.mean(explores)) == pytest.approx(epsilon, abs=1e-6)
    for side in (explores, ~explores):
        if side.any():
            on_side = np.sort(picks[side])
            assert on_side[0] >= 0
            assert on_side[-1] < 1
            np.testing.assert_allclose(on_side, np.arange(len(on_side)) / len(on_side), atol=2 / len(on_side))
