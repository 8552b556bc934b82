"""Each seed changes worlds after its own episodes, with what it has learned."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from corridor import Corridor
from jaxtyping import Array

from lodestone.experiments.changing_world import changing_world
from lodestone.learning.loop import Algorithm, RoundLog, train
from lodestone.planning.enumerated import Enumerated, enumerated
from lodestone.planning.tables import tabulate

EPISODES = 5


class Counts(NamedTuple):
    """A learner that learns how many rounds it has lived, and where it began."""

    learned: Array
    start: Array
    world_pays: Array
    key: Array | None


def learner(world: Enumerated) -> Algorithm:
    """In every other round, or in every third, an episode ends."""

    def init(key: Array) -> Counts:
        start = jax.random.randint(key, (), 0, 1000)
        return Counts(jnp.int32(0), start, jnp.float32(0), key)

    def run_round(carry: Counts, number: Array) -> tuple[Counts, RoundLog]:
        period = 2 + carry.start % 2
        zero, ended = jnp.int32(0), (carry.learned % period == 0)[None]
        log = RoundLog(ended, zero[None], zero[None], ended, ended, jnp.zeros(1), *[zero[None]] * 2, jnp.float32(0))
        key = jax.random.fold_in(carry.key, number)
        return carry._replace(learned=carry.learned + 1, world_pays=jnp.max(world.rewards), key=key), log

    return Algorithm(init, run_round)


def test_every_seed_moves_after_its_own_episodes_and_keeps_what_it_has_learned():
    first, second, third = (
        enumerated(tabulate(corridor), corridor.action_names)
        for corridor in (Corridor(length=4, step_reward=reward) for reward in (0.0, 10.0, 20.0))
    )
    later = jax.tree.map(lambda *leaves: np.stack(leaves), second, third)
    hand_over = lambda old, fresh: fresh._replace(learned=old.learned)  # noqa: E731
    seen = []
    for carry, chunk in train(changing_world(learner, hand_over, first, later, EPISODES), range(12), 20, 1):
        inner, before = (one._replace(key=None) for one in (carry.inner, carry.before))
        carry = jax.tree.map(lambda leaf: np.asarray(leaf)[:12], carry._replace(inner=inner, before=before))
        seen.append((chunk.log.valid[:, 0, 0], carry))
    worlds, starts = set(), {one.inner.start[0] for _, one in seen}
    assert len(starts) == 2  # before the move and after it
    for seed in range(12):
        ended = np.cumsum([valid[seed] for valid, _ in seen])
        at = int(np.argmax(ended == EPISODES))
        for number, (_, carry) in enumerate(seen):
            assert carry.episodes[seed] == ended[number]
            assert carry.moved[seed] == (EPISODES if number >= at else 0)
            assert carry.inner.learned[seed] == number + 1  # what was learned is kept
            assert carry.before.learned[seed] == min(number, at) + 1
            reward = {0: 10.0, 1: 20.0}[int(carry.world[seed])] if number > at else 0.0
            if number != at:  # a fresh carry has not lived a round
                assert carry.inner.world_pays[seed] == reward + 3
        worlds.add(int(seen[-1][1].world[seed]))
    assert worlds == {0, 1}
