"""The training loop on an algorithm that only counts."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from lodestone.learning.loop import Algorithm, Begun, RoundLog, carried, train


def counting() -> Algorithm:
    """Carries a random number, and adds the number of each round to ten times what it has."""
    no, zero, real = jnp.zeros(1, bool), jnp.zeros(1, jnp.int32), jnp.zeros(1)

    def run_round(carry, number):
        log = RoundLog(no, zero, zero, no, no, real, zero, zero, number.astype(jnp.float32))
        return {"count": 10 * carry["count"] + number, "key": carry["key"]}, log

    return Algorithm(lambda key: {"count": jax.random.randint(key, (), 1, 9), "key": key}, run_round)


def test_training_goes_on_where_it_was():
    seeds = (4, 5, 6)
    whole = [(np.array(carry["count"]), chunk.rounds) for carry, chunk in train(counting(), seeds, 7, 2)]
    assert [rounds for _, rounds in whole] == [2, 4, 6, 7]
    keys = jnp.stack([jax.random.key(seed) for seed in seeds])
    begun = Begun({"count": jnp.asarray(whole[1][0]), "key": keys}, rounds=4, seconds=1000.0)
    again = list(train(counting(), seeds, 7, 2, begun=begun))
    assert [chunk.rounds for _, chunk in again] == [6, 7]
    assert [chunk.log.loss[0].tolist() for _, chunk in again] == [[4.0, 5.0], [6.0]]
    np.testing.assert_array_equal(again[-1][0]["count"], whole[-1][0])
    assert 1000.0 < again[0][1].seconds < again[1][1].seconds


def test_what_is_carried_is_known_before():
    for carry, _ in train(counting(), (1, 2), 1, 1):
        shapes = jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), carried(counting(), (1, 2)))
        assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), carry) == shapes
