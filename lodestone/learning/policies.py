"""Choosing an option from option values. The maximum and the random draw run over the available options only."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lodestone.envs.base import inverse_cdf


def mask_unavailable(values: Float[Array, " O"], available: Bool[Array, " O"]) -> Float[Array, " O"]:
    """Minus infinity where an option may not start."""
    return jnp.where(available, values, -jnp.inf)


def greedy(values: Float[Array, " O"], available: Bool[Array, " O"]) -> Int[Array, ""]:
    """The first best available option: reproducible, for evaluation."""
    return jnp.argmax(mask_unavailable(values, available)).astype(jnp.int32)


def epsilon_greedy(
    uniform: Float[Array, " 2"], values: Float[Array, " O"], available: Bool[Array, " O"], epsilon: Float[Array, ""]
) -> Int[Array, ""]:
    """With probability epsilon any available option, otherwise one of the best, by two uniform numbers in [0, 1).

    Ties are broken uniformly at random, since a first-best rule can lock an early policy into a loop.
    """
    masked = mask_unavailable(values, available)
    candidates = available & ((uniform[0] < epsilon) | (masked == jnp.max(masked)))
    return inverse_cdf(candidates.astype(jnp.float32), uniform[1])
