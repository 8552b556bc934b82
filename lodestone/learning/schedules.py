"""Piecewise-linear schedules over the number of decisions taken."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lodestone.errors import InvalidConfig

Knots = tuple[tuple[int, float], ...]
"""(decisions, value) pairs in ascending order; constant before the first and after the last."""


def check_knots(name: str, knots: Knots, low: float, high: float) -> None:
    """Raise `InvalidConfig` unless the knots ascend and every value is a finite number from `low` to `high`."""
    times = [time for time, _ in knots]
    if not knots or times != sorted(times) or times[0] < 0:
        raise InvalidConfig(f"{name} needs (decisions, value) pairs in ascending order from 0 on, but is {knots}.")
    for _, value in knots:
        if not (math.isfinite(value) and low <= value <= high):
            raise InvalidConfig(f"{name} has the value {value}, but must stay from {low:g} to {high:g}.")


def piecewise_linear(knots: Knots, decisions: Int[Array, ""]) -> Float[Array, ""]:
    """The schedule's value after so many decisions."""
    times = jnp.asarray([time for time, _ in knots], dtype=jnp.float32)
    values = jnp.asarray([value for _, value in knots], dtype=jnp.float32)
    return jnp.interp(decisions.astype(jnp.float32), times, values)
