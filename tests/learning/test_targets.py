"""The semi-Markov target by hand."""

from __future__ import annotations

import jax.numpy as jnp
import pytest

from lodestone.learning.targets import double_semi_markov_target, semi_markov_target

REWARD, DISCOUNT = jnp.float32(2.0), jnp.float32(0.81)
VALUES = jnp.array([1.0, 5.0, 7.0])
AVAILABLE = jnp.array([True, True, False])
NOTHING = jnp.zeros(3, dtype=bool)


def test_maximum_over_available_options():
    assert float(semi_markov_target(REWARD, DISCOUNT, VALUES, AVAILABLE)) == pytest.approx(2 + 0.81 * 5)


def test_double_picks_by_the_other_values():
    preferences = jnp.array([9.0, 1.0, 99.0])
    found = double_semi_markov_target(REWARD, DISCOUNT, VALUES, preferences, AVAILABLE)
    assert float(found) == pytest.approx(2 + 0.81 * 1)


def test_the_end_needs_no_available_option():
    zero = jnp.float32(0.0)
    assert float(semi_markov_target(REWARD, zero, VALUES, NOTHING)) == 2.0
    assert float(double_semi_markov_target(REWARD, zero, VALUES, VALUES, NOTHING)) == 2.0
