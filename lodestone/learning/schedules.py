"""Piecewise-linear schedules over the course of a run."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from lodestone.errors import InvalidConfig

Knots = tuple[tuple[float, float], ...]
"""(fraction of the run, value) pairs in ascending order; constant before the first and after the last."""


def check_knots(name: str, knots: Knots, low: float, high: float) -> None:
    """Raise `InvalidConfig` unless the knots ascend within the run and every value is finite, from `low` to `high`."""
    times = [time for time, _ in knots]
    if not knots or times != sorted(times) or not all(0 <= time <= 1 for time in times):
        raise InvalidConfig(
            f"{name} needs (fraction of the run, value) pairs with fractions ascending from 0 to 1, but is {knots}."
        )
    for _, value in knots:
        if not (math.isfinite(value) and low <= value <= high):
            raise InvalidConfig(f"{name} has the value {value}, but must stay from {low:g} to {high:g}.")


def piecewise_linear(knots: Knots, fraction: Float[Array, ""]) -> Float[Array, ""]:
    """The schedule's value when so much of the run is over."""
    times = jnp.asarray([time for time, _ in knots], dtype=jnp.float32)
    values = jnp.asarray([value for _, value in knots], dtype=jnp.float32)
    return jnp.interp(fraction, times, values)
