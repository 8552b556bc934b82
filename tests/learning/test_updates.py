"""The loop of updates against the same written in Python."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import pytest
from jaxtyping import Array, Float, Int

from lodestone.learning.updates import run_updates


class Learner(NamedTuple):
    network: Float[Array, ""]
    target: Float[Array, ""]
    adam: Int[Array, ""]


def update(learner: Learner, number: Int[Array, ""]) -> tuple[Learner, Float[Array, ""]]:
    network = learner.network * 3 + number.astype(jnp.float32) + 10 * learner.target
    return learner._replace(network=network, adam=learner.adam + 1), network


@pytest.mark.parametrize("rounds_before", [-2, 0, 1, 2, 3])
def test_the_target_follows_after_every_so_many_updates_of_the_whole_run(rounds_before: int) -> None:
    per_round, period = 4, 3
    learner = Learner(jnp.float32(1), jnp.float32(0.5), jnp.int32(0))
    after, found = jax.jit(lambda before: run_updates(learner, update, before, per_round, period))(rounds_before)
    network, target, losses = 1.0, 0.5, []
    for number in range(per_round if rounds_before >= 0 else 0):
        network = network * 3 + number + 10 * target
        losses.append(network)
        if (rounds_before * per_round + number + 1) % period == 0:
            target = network
    assert (after.network, after.target, after.adam) == (network, target, len(losses))
    assert found.tolist() == (losses or [0.0] * per_round)
