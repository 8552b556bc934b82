"""The replay against a naive list."""

from __future__ import annotations

from collections import deque

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lodestone.envs.magnet_arm import MagnetArm
from lodestone.learning.collecting import no_decisions
from lodestone.learning.replay import add, empty_replay, sample
from lodestone.options.base import Primitives, Union
from lodestone.options.catalogue import scripted_options
from lodestone.types import Transition

OPTIONS = 3
add_compiled = jax.jit(add)


def transitions(numbers: list[int]) -> Transition:
    """Transitions that carry their number in every field."""
    number = jnp.asarray(numbers, dtype=jnp.int32)
    real = number.astype(jnp.float32)
    mask = (number[:, None] + jnp.arange(OPTIONS)[None, :]) % 2 == 0
    return Transition(number, number % OPTIONS, real, real / 2, number + 1, mask)


@given(st.lists(st.lists(st.booleans(), min_size=4, max_size=4), min_size=1, max_size=12))
def test_holds_the_last_valid_transitions_in_order(blocks):
    replay = empty_replay(jax.tree.map(lambda leaf: leaf[0], transitions([0])), 7)
    expected: deque[int] = deque(maxlen=7)
    for index, valid in enumerate(blocks):
        numbers = [4 * index + slot for slot in range(4)]
        replay = add_compiled(replay, transitions(numbers), jnp.asarray(valid))
        expected.extend(number for number, keep in zip(numbers, valid, strict=True) if keep)
    assert int(replay.size) == len(expected)
    held = np.asarray(replay.storage.obs)
    order = [(int(replay.cursor) - len(expected) + position) % 7 for position in range(len(expected))]
    assert [int(held[slot]) for slot in order] == list(expected)
    for slot in order:
        whole = jax.tree.map(lambda leaf, slot=slot: leaf[slot], replay.storage)
        wanted = jax.tree.map(lambda leaf: leaf[0], transitions([int(held[slot])]))
        jax.tree.map(np.testing.assert_array_equal, whole, wanted)


def test_samples_uniformly_from_what_is_held():
    replay = empty_replay(jax.tree.map(lambda leaf: leaf[0], transitions([0])), 100)
    replay = add(replay, transitions([10, 11, 12, 13, 14]), jnp.array([True, False, True, True, True]))
    drawn = np.asarray(sample(replay, jax.random.bits(jax.random.key(0), (8000,))).obs)
    values, counts = np.unique(drawn, return_counts=True)
    assert values.tolist() == [10, 12, 13, 14]
    assert np.abs(counts - 2000).max() < 4 * np.sqrt(8000 * 0.25 * 0.75)


def test_a_million_transitions_of_the_larger_arm_take_less_than_100_megabytes():
    arm = MagnetArm(rows=6, columns=4, bricks=4, tower_height=4)
    options = Union((Primitives(arm.action_names), scripted_options(arm, ("go-down", "lift"))))
    example = jax.eval_shape(lambda: jax.tree.map(lambda leaf: leaf[0], no_decisions(arm, options, 1).transition))
    shapes = jax.eval_shape(lambda one: empty_replay(one, 1_000_000), example)
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))
    assert size < 100e6
