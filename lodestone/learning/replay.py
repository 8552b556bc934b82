"""A dense ring of experience. Where the environment is functional it holds states; pictures are drawn at sampling."""

from __future__ import annotations

from typing import Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PyTree, UInt32

Item = TypeVar("Item", bound=PyTree)
"""What is remembered: a transition, or any other pytree of arrays."""


class Replay(NamedTuple, Generic[Item]):
    """The last `capacity` items."""

    storage: Item
    """Leaves have a leading axis of length `capacity`."""
    cursor: Int[Array, ""]
    """Where the next item goes."""
    size: Int[Array, ""]
    """How many items are held."""


def empty_replay(example: Item, capacity: int) -> Replay[Item]:
    """A replay for items of the shapes and dtypes of `example`."""
    storage = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), example)
    return Replay(storage, jnp.int32(0), jnp.int32(0))


def add(replay: Replay[Item], batch: Item, valid: Bool[Array, " M"]) -> Replay[Item]:
    """Append the valid ones of M items (M at most the capacity), in order, overwriting the oldest."""
    capacity = jax.tree.leaves(replay.storage)[0].shape[0]
    rank = jnp.cumsum(valid.astype(jnp.int32)) - 1
    slot = jnp.where(valid, (replay.cursor + rank) % capacity, capacity)  # out of range: dropped
    storage = jax.tree.map(lambda old, new: old.at[slot].set(new, mode="drop"), replay.storage, batch)
    count = rank[-1] + 1
    return Replay(storage, (replay.cursor + count) % capacity, jnp.minimum(replay.size + count, capacity))


def sample_slots(replay: Replay, bits: UInt32[Array, " B"]) -> Int[Array, " B"]:
    """Where B items are held that are drawn uniformly with replacement, by random bits; 0 while there are none.

    The remainder favours no item by more than one part in 2^32 / size.
    """
    return (bits % jnp.maximum(replay.size, 1).astype(jnp.uint32)).astype(jnp.int32)


def sample(replay: Replay[Item], bits: UInt32[Array, " B"]) -> Item:
    """B items drawn uniformly with replacement, by random bits; empty ones while there are none."""
    slots = sample_slots(replay, bits)
    return jax.tree.map(lambda leaf: leaf[slots], replay.storage)
