"""A dense ring of transitions. Where the environment is functional it holds states; pictures are drawn at sampling."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32

from lodestone.types import Transition


class Replay(NamedTuple):
    """The last `capacity` transitions."""

    storage: Transition
    """Leaves have a leading axis of length `capacity`."""
    cursor: Int[Array, ""]
    """Where the next transition goes."""
    size: Int[Array, ""]
    """How many transitions are held."""


def empty_replay(example: Transition, capacity: int) -> Replay:
    """A replay for transitions of the shapes and dtypes of `example`."""
    storage = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), example)
    return Replay(storage, jnp.int32(0), jnp.int32(0))


def add(replay: Replay, batch: Transition, valid: Bool[Array, " M"]) -> Replay:
    """Append the valid ones of M transitions (M at most the capacity), in order, overwriting the oldest."""
    capacity = replay.storage.action.shape[0]
    rank = jnp.cumsum(valid.astype(jnp.int32)) - 1
    slot = jnp.where(valid, (replay.cursor + rank) % capacity, capacity)  # out of range: dropped
    storage = jax.tree.map(lambda old, new: old.at[slot].set(new, mode="drop"), replay.storage, batch)
    count = rank[-1] + 1
    return Replay(storage, (replay.cursor + count) % capacity, jnp.minimum(replay.size + count, capacity))


def sample(replay: Replay, bits: UInt32[Array, " B"]) -> Transition:
    """B transitions drawn uniformly with replacement, by random bits. The replay must not be empty.

    The remainder favours no transition by more than one part in 2^32 / size.
    """
    index = (bits % replay.size.astype(jnp.uint32)).astype(jnp.int32)
    return jax.tree.map(lambda leaf: leaf[index], replay.storage)
