"""Choosing an option from option values. The maximum and the random draw run over the available options only."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray


def mask_unavailable(values: Float[Array, " O"], available: Bool[Array, " O"]) -> Float[Array, " O"]:
    """Minus infinity where an option may not start."""
    return jnp.where(available, values, -jnp.inf)


def greedy(values: Float[Array, " O"], available: Bool[Array, " O"]) -> Int[Array, ""]:
    """The first best available option: reproducible, for evaluation."""
    return jnp.argmax(mask_unavailable(values, available)).astype(jnp.int32)


def epsilon_greedy(
    key: PRNGKeyArray, values: Float[Array, " O"], available: Bool[Array, " O"], epsilon: Float[Array, ""]
) -> Int[Array, ""]:
    """With probability epsilon any available option, otherwise one of the best; ties are broken uniformly at random,
    since a first-best rule can lock an early policy into a loop."""
    explore_key, pick_key = jax.random.split(key)
    masked = mask_unavailable(values, available)
    explores = jax.random.uniform(explore_key) < epsilon
    candidates = available & (explores | (masked == jnp.max(masked)))
    tickets = jax.random.uniform(pick_key, values.shape)
    return jnp.argmax(jnp.where(candidates, tickets, -1.0)).astype(jnp.int32)
