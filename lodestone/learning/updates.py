"""The updates after a round of experience, with a target network that follows now and then."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Int, PyTree


class HasTarget(Protocol):
    """A named tuple of what is learned, and from what."""

    @property
    def network(self) -> PyTree: ...

    @property
    def target(self) -> PyTree:
        """The network as it was some updates ago, which the targets of learning bootstrap from."""

    @property
    def adam(self) -> optax.ScaleByAdamState: ...

    @property
    def _replace(self) -> Callable[..., Any]: ...


LearnerT = TypeVar("LearnerT", bound=HasTarget)
Found = TypeVar("Found", bound=PyTree)


def run_updates(
    learner: LearnerT,
    update: Callable[[LearnerT, Int[Array, ""]], tuple[LearnerT, Found]],
    rounds_before: Int[Array, ""],
    per_round: int,
    target_period: int,
) -> tuple[LearnerT, Found]:
    """`per_round` updates, or none where `rounds_before`, of rounds with updates, is negative: learning has not begun.

    `update` takes the learner and the update's number within the round, changes the network and Adam's moments alone,
    and returns what it found, too: its loss, for one. The target becomes the network after every `target_period`
    updates. Returns the learner, and what was found, stacked along a leading axis of length `per_round`: zeros without
    updates.
    """
    # These two numbers are the same for all seeds, so that under vmap the branch below stays a branch.
    updates = jnp.where(rounds_before >= 0, per_round, 0)
    updates_before = rounds_before * per_round

    def one(number: Int[Array, ""], state: tuple) -> tuple:
        network, target, adam, found = state
        current, new = update(learner._replace(network=network, target=target, adam=adam), number)
        due = (updates_before + number + 1) % target_period == 0
        target = jax.lax.cond(due, lambda: current.network, lambda: target)
        found = jax.tree.map(lambda all_, leaf: all_.at[number].set(leaf), found, new)
        return current.network, target, current.adam, found

    shapes = jax.eval_shape(update, learner, jnp.int32(0))[1]
    nothing = jax.tree.map(lambda leaf: jnp.zeros((per_round, *leaf.shape), leaf.dtype), shapes)
    # The memory of experience is not carried: a vmapped loop would copy it.
    state = (learner.network, learner.target, learner.adam, nothing)
    network, target, adam, found = jax.lax.fori_loop(0, updates, one, state)
    return learner._replace(network=network, target=target, adam=adam), found
