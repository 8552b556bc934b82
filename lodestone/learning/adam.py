"""One step of Adam (Kingma and Ba 2015) on a network's arrays, each gradient clipped by its own norm."""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PyTree

Network = TypeVar("Network", bound=PyTree)


def start_adam(network: PyTree) -> optax.ScaleByAdamState:
    """No moments yet."""
    return optax.scale_by_adam().init(network)


def adam_step(
    network: Network,
    gradient: Network,
    adam: optax.ScaleByAdamState,
    learning_rate: Float[Array, ""],
    epsilon: float,
    max_gradient_norm: float,
) -> tuple[Network, optax.ScaleByAdamState]:
    """The network after one step, and Adam's moments; `epsilon` is the constant under Adam's fraction."""
    gradient = jax.tree.map(lambda leaf: _clip(leaf, max_gradient_norm), gradient)
    with jax.numpy_dtype_promotion("standard"):  # optax raises a float to an integer power, which strictness forbids
        direction, adam = optax.scale_by_adam(eps=epsilon).update(gradient, adam)
    return jax.tree.map(lambda old, step: old - learning_rate * step, network, direction), adam


def _clip(gradient: Array, max_norm: float) -> Array:
    norm = jnp.sqrt(jnp.sum(jnp.square(gradient)))
    return gradient * jnp.minimum(1.0, max_norm / jnp.maximum(norm, 1e-12))
