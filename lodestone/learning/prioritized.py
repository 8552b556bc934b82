"""Prioritized replay (Schaul et al. 2016): what was learned from badly is drawn more often.

An item's priority is the error with which it was learned from last. To draw in proportion to it from everything that is
held takes a tree of sums; here B items are drawn in proportion from `CANDIDATES` times as many that are drawn
uniformly, which needs none, and comes to the same as that number grows.
"""

from __future__ import annotations

from typing import Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from lodestone.learning.replay import Replay, add, empty_replay, sample_slots

Item = TypeVar("Item", bound=PyTree)

CANDIDATES = 64
"""For each item that is drawn."""
LEAST_ERROR = 0.01
"""Added to every error, so that no item is never drawn again."""


class Prioritized(NamedTuple, Generic[Item]):
    """What is remembered of one item."""

    item: Item
    error: Float[Array, "*batch"]


class PrioritizedReplay(NamedTuple, Generic[Item]):
    """A ring of items and errors."""

    ring: Replay[Prioritized[Item]]
    highest: Float[Array, ""]
    """The largest error so far: that of items which have not been learned from."""


class Drawn(NamedTuple, Generic[Item]):
    """B items to learn from."""

    items: Item
    """Leaves have a leading axis of length B."""
    slots: Int[Array, " B"]
    """Where they are held."""
    weights: Float[Array, " B"]
    """Factors of their losses, of which the largest is 1: less for what is drawn more often than uniformly."""


def empty_prioritized(example: Item, capacity: int) -> PrioritizedReplay[Item]:
    """A replay for items of the shapes and dtypes of `example`."""
    return PrioritizedReplay(empty_replay(Prioritized(example, jnp.float32(0)), capacity), jnp.float32(1))


def remember(replay: PrioritizedReplay[Item], batch: Item, valid: Bool[Array, " M"]) -> PrioritizedReplay[Item]:
    """Append the valid ones of M items, overwriting the oldest."""
    errors = jnp.broadcast_to(replay.highest, valid.shape)
    return replay._replace(ring=add(replay.ring, Prioritized(batch, errors), valid))


def draw(
    replay: PrioritizedReplay[Item], key: PRNGKeyArray, count: int, exponent: float, correction: float
) -> Drawn[Item]:
    """B = `count` items, each in proportion to its error to the power of `exponent` (Schaul et al. 2016, equation 1);
    empty ones while there are none.

    Their weights are those of the uniform distribution over this one, to the power of `correction`, over the largest
    (section 3.4).
    """
    candidates_key, chosen_key = jax.random.split(key)
    candidates = sample_slots(replay.ring, jax.random.bits(candidates_key, (CANDIDATES * count,)))
    priorities = replay.ring.storage.error[candidates] ** exponent
    up_to = jnp.cumsum(priorities)
    # One number in each of B equal parts of the sum: fewer chance repetitions than with B numbers in all of it.
    numbers = (jnp.arange(count, dtype=jnp.float32) + jax.random.uniform(chosen_key, (count,))) / count * up_to[-1]
    chosen = jnp.minimum(jnp.searchsorted(up_to, numbers, side="right"), CANDIDATES * count - 1)
    slots, priorities = candidates[chosen], jnp.maximum(priorities[chosen], jnp.finfo(jnp.float32).tiny)
    weights = (jnp.min(priorities) / priorities) ** correction
    return Drawn(jax.tree.map(lambda leaf: leaf[slots], replay.ring.storage.item), slots, weights)


def renew(
    replay: PrioritizedReplay[Item], slots: Int[Array, " M"], errors: Float[Array, " M"]
) -> PrioritizedReplay[Item]:
    """Give the items at some slots their new errors; of a slot that comes twice, the larger one.

    A slot beyond the ring's end stands for nothing.
    """
    errors = errors + LEAST_ERROR
    storage = replay.ring.storage
    renewed = storage.error.at[slots].set(0.0, mode="drop").at[slots].max(errors, mode="drop")
    inside = slots < storage.error.shape[0]
    highest = jnp.maximum(replay.highest, jnp.max(jnp.where(inside, errors, 0.0)))
    return PrioritizedReplay(replay.ring._replace(storage=storage._replace(error=renewed)), highest)
