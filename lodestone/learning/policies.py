"""Choosing an option from option values. The maximum and the random draw run over the available options only."""

from __future__ import annotations

from functools import reduce
from itertools import accumulate

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lodestone.envs.base import UNROLLED, inverse_cdf


def mask_unavailable(values: Float[Array, " O"], available: Bool[Array, " O"]) -> Float[Array, " O"]:
    """Minus infinity where an option may not start."""
    return jnp.where(available, values, -jnp.inf)


def forbid(preferences: Float[Array, "*O A"], allowed: Bool[Array, " A"]) -> Float[Array, "*O A"]:
    """Preferences whose softmax leaves actions that are not allowed no probability: a number still, not minus infinity,
    as probability times logarithm has to be one."""
    return jnp.where(allowed, preferences, -1e9)


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


def largest(row: Float[Array, " O"]) -> Float[Array, ""]:
    """The maximum of a row. A short one is gone through entry by entry: where many seeds learn side by side that is one
    loop over them, and a reduction is several."""
    return _largest(list(row)) if row.size <= UNROLLED else jnp.max(row)


def choose(
    uniform: Float[Array, " 2"], values: Float[Array, " O"], available: Bool[Array, " O"], epsilon: Float[Array, ""]
) -> Int[Array, ""]:
    """What `epsilon_greedy` chooses, entry by entry as in `largest`."""
    if values.size > UNROLLED:
        return epsilon_greedy(uniform, values, available, epsilon)
    return choose_among(uniform[0], uniform[1], list(mask_unavailable(values, available)), epsilon)


def choose_among(
    explores: Float[Array, ""], picks: Float[Array, ""], values: list[Float[Array, ""]], epsilon: Float[Array, ""]
) -> Int[Array, ""]:
    """The same for a few values that are no array; -inf where there is nothing to choose."""
    least = jnp.where(explores < epsilon, jnp.finfo(jnp.float32).min, _largest(values))
    counts = list(accumulate(jnp.where(value >= least, 1.0, 0.0) for value in values))
    return sum((count <= picks * counts[-1]).astype(jnp.int32) for count in counts[:-1]) + jnp.int32(0)


def one_for_two(uniform: Float[Array, ""], epsilon: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """A number to compare with epsilon and one to pick with, both uniform in [0, 1), out of one such number: on either
    side of epsilon it is uniform again."""
    explores = uniform < epsilon
    return uniform, jnp.where(explores, uniform, uniform - epsilon) / jnp.where(explores, epsilon, 1.0 - epsilon)


def _largest(values: list[Float[Array, ""]]) -> Float[Array, ""]:
    return reduce(lambda one, other: jnp.where(one > other, one, other), values)
