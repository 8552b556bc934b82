"""A world that changes while a tabular learner learns: each seed goes on in another after so many episodes of its own.

The change is part of the compiled run. A seed moves at the end of the round in which its last episode in the first
world has ended, at most a round's steps late, whatever the other seeds do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PRNGKeyArray

from lodestone.learning.loop import Algorithm, RoundLog
from lodestone.planning.enumerated import Enumerated


class Moving(NamedTuple):
    """Everything that one seed carries from round to round."""

    inner: Any
    """What the learner carries."""
    before: Any
    """What it carried when it moved; until then what it carries now."""
    world: Int[Array, ""]
    """Which of the later worlds it moves to."""
    episodes: Int[Array, ""]
    """Episodes that it has finished."""
    moved: Int[Array, ""]
    """How many they were when it moved; 0 until then."""


def changing_world(
    learner: Callable[[Enumerated], Algorithm],
    hand_over: Callable[[Any, Any], Any],
    first: Enumerated,
    later: Enumerated,
    episodes: int,
) -> Algorithm:
    """`learner(world)` learns in `first`, and after so many episodes in one of the worlds that are stacked in `later`,
    drawn at random for each seed; an episode under way is given up.

    `hand_over(old, fresh)` is what the learner carries into its new world: what it has learned from the old carry, and
    the beginning of an episode from a fresh one.
    """

    def init(key: PRNGKeyArray) -> Moving:
        world_key, key = jax.random.split(key)
        inner, nothing = learner(first).init(key), jnp.int32(0)
        return Moving(inner, inner, jax.random.randint(world_key, (), 0, len(later.ends)), nothing, nothing)

    def run_round(carry: Moving, number: Int[Array, ""]) -> tuple[Moving, RoundLog]:
        moved = carry.moved > 0
        second = jax.tree.map(lambda leaf: jnp.asarray(leaf)[carry.world], later)
        world = _where(moved, second, first)
        inner, log = learner(world).run_round(carry.inner, number)
        finished = carry.episodes + jnp.sum((log.valid & log.episode_ended).astype(jnp.int32))
        moves = ~moved & (finished >= episodes)
        begun = hand_over(inner, learner(second).init(inner.key))
        return Moving(
            inner=_where(moves, begun, inner),
            before=_where(moved, carry.before, inner),
            world=carry.world,
            episodes=finished,
            moved=jnp.where(moves, finished, carry.moved),
        ), log

    return Algorithm(init, run_round)


def _where(condition: Bool[Array, ""], if_true: Any, if_false: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), if_true, if_false)
