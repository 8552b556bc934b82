"""The semi-Markov target, shared by every learner of option values."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lodestone.learning.policies import greedy, mask_unavailable


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
