"""The states that an environment can reach, found from its own functions and numbered.

The author of an environment writes no encoding: states are packed into words, hashed, and every match of a hash is
confirmed by comparing the states themselves, so that the numbering is exact.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, UInt32

from lodestone.envs.base import Environment
from lodestone.errors import TooManyStates
from lodestone.types import State

BATCH = 2048
"""States that one compiled call expands."""


class StateSpace(eqx.Module):
    """S numbered states, in the order in which a breadth-first search found them; the initial states come first."""

    states: State
    """All states, stacked along a leading axis of length S."""
    sorted_hashes: UInt32[Array, "S 2"]
    """Hashes of the states in ascending order, the high word first."""
    order: Int[Array, " S"]
    """The number of the state that has each sorted hash."""

    @property
    def size(self) -> int:
        """S."""
        return self.order.shape[0]

    def index_of(self, state: State) -> Int[Array, ""]:
        """The number of one state: a binary search, fit for compiled code.

        A state outside the space gets some number; `contains` tells.
        """
        high, low = _hash(state)

        def halve(_: int, bounds: tuple[Array, Array]) -> tuple[Array, Array]:
            first, last = bounds
            middle = (first + last) // 2
            word = self.sorted_hashes[middle]
            before = (word[0] < high) | ((word[0] == high) & (word[1] < low))
            return jnp.where(before, middle + 1, first), jnp.where(before, last, middle)

        bounds = (jnp.int32(0), jnp.int32(self.size - 1))
        first, _ = jax.lax.fori_loop(0, max(self.size - 1, 1).bit_length(), halve, bounds)
        return self.order[first]

    def contains(self, state: State) -> Array:
        """Whether one state is among them."""
        found = self.state(self.index_of(state))
        same = jax.tree.map(lambda a, b: jnp.all(a == b), found, state)
        return jnp.all(jnp.stack(jax.tree.leaves(same)))

    def state(self, index: Int[Array, ""]) -> State:
        """The state of a number."""
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], self.states)


class Numbers(eqx.Module):
    """The numbering of states that are numbers already."""

    size: int = eqx.field(static=True)
    """S."""

    def index_of(self, state: Int[Array, ""]) -> Int[Array, ""]:
        """The state itself."""
        return state


def _words(state: State) -> UInt32[Array, " words"]:
    """One state's bits as 32-bit words, one word per element."""
    leaves = [jnp.ravel(leaf) for leaf in jax.tree.leaves(state)]
    return jnp.concatenate(
        [
            jax.lax.bitcast_convert_type(leaf, jnp.uint32)
            if leaf.dtype in (jnp.float32, jnp.int32, jnp.uint32)
            else leaf.astype(jnp.int32).astype(jnp.uint32)
            for leaf in leaves
        ]
    )


def _hash(state: State) -> tuple[UInt32[Array, ""], UInt32[Array, ""]]:
    """A 64-bit hash in two words: each element is mixed in by multiply, xor and shift."""
    high, low = jnp.uint32(0x9E3779B9), jnp.uint32(0x85EBCA6B)
    for word in _words(state):
        high = (high ^ word) * jnp.uint32(0xCC9E2D51)
        high = high ^ (high >> 15)
        low = (low ^ word ^ high) * jnp.uint32(0x1B873593)
        low = low ^ (low >> 13)
    return high, low


def reachable_states(environment: Environment, limit: int = 5_000_000) -> StateSpace:
    """Enumerate what can be reached from the initial states; terminal states are kept and not expanded.

    Remembered per environment. Raises `TooManyStates` past `limit` states.
    """
    with jax.ensure_compile_time_eval():
        return _reachable_states(environment, limit)


@lru_cache(maxsize=16)
def _reachable_states(environment: Environment, limit: int) -> StateSpace:
    expand = jax.jit(jax.vmap(_successors, in_axes=(None, 0)))
    hash_all = jax.jit(jax.vmap(_hash))

    def successors_of(states: State) -> State:
        terminal, next_states = expand(environment, states)
        live = ~np.asarray(terminal)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[live].reshape(-1, *leaf.shape[3:]), next_states)

    def hashes_of(states: State) -> np.ndarray:
        high, low = hash_all(states)
        return np.asarray(high, dtype=np.uint64) << np.uint64(32) | np.asarray(low, dtype=np.uint64)

    initial = jax.tree.map(np.asarray, environment.initial_distribution()[1])
    known = _Known(hashes_of)
    frontier = known.add(initial)
    while _length(frontier):
        level = [_distinct(successors_of(padded), hashes_of)[0] for padded in _padded_batches(frontier)]
        frontier = known.add(jax.tree.map(lambda *leaves: np.concatenate(leaves), *level))
        if known.size > limit:
            raise TooManyStates(f"More than {limit:,} states are reachable; exact methods were limited to so many.")
    return known.finish()


def _successors(environment: Environment, state: State) -> tuple[Array, State]:
    """Whether `state` is terminal, and its successors [A, K, ...]."""
    actions, outcomes = jnp.arange(environment.num_actions), jnp.arange(environment.num_outcomes)
    each_outcome = jax.vmap(environment.transition, in_axes=(None, None, 0))
    each_action = jax.vmap(each_outcome, in_axes=(None, 0, None))
    return environment.terminal(state), each_action(state, actions, outcomes)


class _Known:
    """The states found so far: levels in order of discovery, and their sorted hashes."""

    def __init__(self, hashes_of: Callable[[State], np.ndarray]) -> None:
        self._hashes_of = hashes_of
        self._levels: list[State] = []
        self._hashes = np.zeros(0, dtype=np.uint64)
        self._numbers = np.zeros(0, dtype=np.int32)
        self.size = 0

    def add(self, states: State) -> State:
        """Number those of `states` that are new, in their order, and return them."""
        states, hashes = _distinct(states, self._hashes_of)
        at = np.searchsorted(self._hashes, hashes)
        old = np.zeros(len(hashes), dtype=bool)
        if self.size:
            old = self._hashes[np.minimum(at, self.size - 1)] == hashes
            self._require_equal(states, old, self._numbers[at[old]])
        new_states, at, hashes = _take(states, ~old), at[~old], hashes[~old]
        order = np.argsort(hashes)
        self._numbers = np.insert(self._numbers, at[order], self.size + order.astype(np.int32))
        self._hashes = np.insert(self._hashes, at[order], hashes[order])
        self._levels.append(new_states)
        self.size += len(hashes)
        return new_states

    def _require_equal(self, states: State, old: np.ndarray, numbers: np.ndarray) -> None:
        self._levels = [jax.tree.map(lambda *leaves: np.concatenate(leaves), *self._levels)]
        _require_equal(_take(states, old), _take(self._levels[0], numbers))

    def finish(self) -> StateSpace:
        words = np.stack([self._hashes >> np.uint64(32), self._hashes & np.uint64(0xFFFFFFFF)], axis=1)
        return StateSpace(
            states=jax.tree.map(lambda *leaves: np.concatenate(leaves), *self._levels),
            sorted_hashes=jnp.asarray(words.astype(np.uint32)),
            order=jnp.asarray(self._numbers),
        )


def _distinct(states: State, hashes_of: Callable[[State], np.ndarray]) -> tuple[State, np.ndarray]:
    """The different ones among `states`, in order of first appearance, and their hashes."""
    count = _length(states)
    hashes = np.concatenate([np.zeros(0, np.uint64), *(hashes_of(padded) for padded in _padded_batches(states))])[
        :count
    ]
    _, first, back = np.unique(hashes, return_index=True, return_inverse=True)
    _require_equal(states, _take(states, first[back]))
    keep = np.sort(first)
    return _take(states, keep), hashes[keep]


def _padded_batches(states: State) -> Iterator[State]:
    """`states` in batches of `BATCH`, the last one filled up with copies, so that one compiled shape serves all."""
    count = _length(states)
    for start in range(0, count, BATCH):
        yield _take(states, np.minimum(np.arange(start, start + BATCH), count - 1))


def _length(states: State) -> int:
    return len(jax.tree.leaves(states)[0])


def _take(states: State, index: np.ndarray) -> State:
    return jax.tree.map(lambda leaf: leaf[index], states)


def _require_equal(one: State, other: State) -> None:
    """Two different states with one hash would be merged: stop instead."""
    same = jax.tree.map(lambda a, b: np.array_equal(a, b), one, other)
    if not all(jax.tree.leaves(same)):
        raise AssertionError("Two different states share a 64-bit hash; change the constants in `_hash`.")
