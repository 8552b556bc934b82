"""The mathematics of plans: what to do in the next T steps, and when to plan anew (Vezhnevets et al. 2016, STRAW).

A plan A has a row for every action, and one for the value, and a column for every step to come; a commitment c has a
number for every step to come:

    A[:, j] at time t    the logits, and the value, of step t + j
    c[j] at time t       the probability of planning anew at step t + 1 + j

Every step drops the first column of both. A new plan is the old one with a patch of K columns written into it, through
K Gaussian filters along time (the attention of DRAW, along one axis): where they lie, how far apart, and how wide they
are, the network says by three numbers, the *focus*.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

LOGARITHMS = (-5.0, 5.0)
"""Bounds of the logarithms of variances and strides: beyond them filters fall between two columns or off the plan."""

WIDEST = 2.0
"""Below it the logarithm of a commitment's variance stays: a wider bell would say the same of all steps."""


def attention(focus: Float[Array, " 3"], columns: int, width: int) -> Float[Array, "K T"]:
    """F, the K = `width` filters over T columns; each sums to 1, or to less where it lies outside the plan.

    The focus is (centre, log of the stride, log of the variance). A centre of -1 is the first column and 1 the last;
    with a stride of 1 the K filters are spread over the whole plan.
    """
    middle = (focus[0] + 1) / 2 * (columns - 1)
    stride = (columns - 1) / max(1, width - 1) * jnp.exp(jnp.clip(focus[1], *LOGARITHMS))
    centres = middle + (jnp.arange(width, dtype=jnp.float32) - (width - 1) / 2) * stride
    bells = _bells(centres, focus[2], columns)
    return bells / (jnp.sum(bells, axis=1, keepdims=True) + 1e-8)


def read(plan: Float[Array, "R T"], filters: Float[Array, "K T"]) -> Float[Array, "R K"]:
    """What the filters see of a plan."""
    return plan @ filters.T


def write(patch: Float[Array, "R K"], filters: Float[Array, "K T"]) -> Float[Array, "R T"]:
    """What is added to a plan when a patch is written through the filters."""
    return patch @ filters


def shift(plan: Float[Array, "R T"]) -> Float[Array, "R T"]:
    """A step later: without the first column; nothing is known yet about the last."""
    return jnp.pad(plan[:, 1:], ((0, 0), (0, 1)))


def shift_commitment(commitment: Float[Array, " T"]) -> Float[Array, " T"]:
    """A step later. A plan that has run out is made anew: 1 comes in at the end (the paper has 0, after which it would
    never be)."""
    return jnp.pad(commitment[1:], (0, 1), constant_values=1.0)


def commitment(
    focus: Float[Array, " 2"], columns: int, peak: float, background: float, sharpness: Float[Array, ""]
) -> Float[Array, " T"]:
    """c, high around one step: the logistic function of `background` plus one bell of height `peak`.

    The focus is (centre, log of the variance while that is small). The bell is divided by its maximum, not by its sum
    as the filters of `attention` are: so it is 1 at its centre whatever its width, and the peak can come as near to 1
    as it should. `sharpness` is a factor on the logits: near 0 everything is drawn, and the gradient passes.
    """
    # Bounded smoothly: were it flat, or clipped, no gradient would ever make it narrower again.
    log_variance = WIDEST - jax.nn.softplus(WIDEST - focus[1])
    bell = _bells((focus[:1] + 1) / 2 * (columns - 1), log_variance, columns)[0]
    return jax.nn.sigmoid(sharpness * (background + peak * bell))


def straight_through(probability: Float[Array, ""], drawn: Bool[Array, ""]) -> Float[Array, ""]:
    """The gate g, 1 where a draw with this probability says so and else 0, with the gradient of the probability."""
    return probability + jax.lax.stop_gradient(drawn.astype(probability.dtype) - probability)


def perturb(
    mean: Float[Array, " D"], log_variance: Float[Array, " D"], noise: Float[Array, " D"]
) -> Float[Array, " D"]:
    """A normal draw as a function of its mean and variance, from standard normal noise (STRAWe)."""
    return mean + jnp.exp(jnp.clip(log_variance, *LOGARITHMS) / 2) * noise


def divergence(mean: Float[Array, " D"], log_variance: Float[Array, " D"]) -> Float[Array, ""]:
    """KL of that draw's distribution from the standard normal one."""
    log_variance = jnp.clip(log_variance, *LOGARITHMS)
    return jnp.sum(jnp.square(mean) + jnp.exp(log_variance) - 1 - log_variance) / 2


def _bells(centres: Float[Array, " K"], log_variance: Float[Array, ""], columns: int) -> Float[Array, "K T"]:
    """Gaussians over the columns, 1 at their centres."""
    variance = jnp.exp(jnp.clip(log_variance, *LOGARITHMS))
    away = jnp.arange(columns, dtype=jnp.float32)[None, :] - centres[:, None]
    return jnp.exp(-jnp.square(away) / (2 * variance))
