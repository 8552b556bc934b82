"""The semi-Markov target, and the loss against it, shared by every learner of option values."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

from lodestone.learning.policies import greedy, mask_unavailable
from lodestone.types import Observation, Transition

Values = Callable[[Observation], Float[Array, " O"]]
"""Observation -> option values."""


def semi_markov_loss(
    values: Values, target: Values, batch: Transition, double: bool, huber_delta: float
) -> Float[Array, ""]:
    """Huber loss, summed over the batch, of Q(s, o) against the semi-Markov target, which has no gradient.

    `batch` holds observations; `double` lets `values` pick the option that `target` values.
    """
    next_values = jax.vmap(target)(batch.next_obs)
    if double:
        preferences = jax.vmap(values)(batch.next_obs)
        targets = jax.vmap(double_semi_markov_target)(
            batch.reward, batch.discount, next_values, preferences, batch.next_available
        )
    else:
        targets = jax.vmap(semi_markov_target)(batch.reward, batch.discount, next_values, batch.next_available)
    chosen = jnp.take_along_axis(jax.vmap(values)(batch.obs), batch.action[:, None], axis=1)[:, 0]
    return jnp.sum(optax.huber_loss(chosen, jax.lax.stop_gradient(targets), delta=huber_delta))


def semi_markov_target(
    reward: Float[Array, ""],
    discount: Float[Array, ""],
    next_values: Float[Array, " O"],
    next_available: Bool[Array, " O"],
) -> Float[Array, ""]:
    """R + gamma^k max over available o' of Q(s', o'); R alone where the discount is 0, even if nothing is available."""
    return _target(reward, discount, jnp.max(mask_unavailable(next_values, next_available)))


def double_semi_markov_target(
    reward: Float[Array, ""],
    discount: Float[Array, ""],
    next_values: Float[Array, " O"],
    next_preferences: Float[Array, " O"],
    next_available: Bool[Array, " O"],
) -> Float[Array, ""]:
    """The same with the maximising option picked by other values than those that bootstrap (van Hasselt 2016)."""
    return _target(reward, discount, next_values[greedy(next_preferences, next_available)])


def _target(reward: Float[Array, ""], discount: Float[Array, ""], best: Float[Array, ""]) -> Float[Array, ""]:
    return reward + jnp.where(discount > 0, discount * best, 0.0)
