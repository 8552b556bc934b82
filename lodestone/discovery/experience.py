"""Trajectories of a policy, at random by default, and what they show of the world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lodestone.discovery.knowledge import Knowledge
from lodestone.envs.base import Environment, inverse_cdf, next_step, sample_initial
from lodestone.envs.state_space import StateSpace, reachable_states
from lodestone.errors import InvalidConfig
from lodestone.planning.tables import Tables
from lodestone.types import State

ActionProbs = Callable[[State], Float[Array, " A"]]
"""A policy: probabilities of the primitive actions in a state."""


@dataclass(frozen=True)
class Recording:
    """How much is recorded."""

    trajectories: int = 100
    """How many."""
    steps: int = 1000
    """Primitive steps of each, unless the environment ends it sooner."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("trajectories", "steps"):
            if getattr(self, name) < 1:
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be at least 1.")


class Trajectories(NamedTuple):
    """N trajectories of at most T steps through numbered states."""

    space: StateSpace
    states: Int[np.ndarray, "N T+1"]
    """The state before each step and after the last; after a trajectory's end it stays the same."""
    actions: Int[np.ndarray, "N T"]
    """Meaningless after a trajectory's end."""
    lengths: Int[np.ndarray, " N"]
    """Steps until the end."""
    success: Bool[np.ndarray, " N"]
    """Whether the environment ended it, rather than the number of steps."""
    num_actions: int
    """A."""

    @property
    def num_steps(self) -> int:
        """Primitive steps of all together."""
        return int(self.lengths.sum())

    def taken(self) -> tuple[Int[np.ndarray, " M"], Int[np.ndarray, " M"], Int[np.ndarray, " M"]]:
        """State, action and next state of all steps."""
        live = np.arange(self.actions.shape[1]) < self.lengths[:, None]
        return self.states[:, :-1][live], self.actions[live], self.states[:, 1:][live]


def record(environment: Environment, recording: Recording, policy: ActionProbs | None = None) -> Trajectories:
    """Follow a policy, by default one that takes every action with equal probability, from the initial states.

    States are told apart, and numbered, by the environment's `StateSpace`. Raises `TooManyStates`.
    """
    space = reachable_states(environment)
    keys = jax.random.split(jax.random.key(recording.seed), recording.trajectories)
    found = _follow_all(environment, replace(space, states=None), keys, recording.steps, policy)
    states, actions, live, success = jax.device_get(found)
    return Trajectories(space, states, actions, live.sum(axis=1), success, environment.num_actions)


@partial(jax.jit, static_argnames=("steps", "policy"))
def _follow_all(
    environment: Environment, index: StateSpace, keys: PRNGKeyArray, steps: int, policy: ActionProbs | None
) -> tuple[Array, Array, Array, Array]:
    uniform = jnp.full(environment.num_actions, 1 / environment.num_actions, dtype=jnp.float32)
    follow = partial(_follow, environment, index, policy or (lambda state: uniform), steps)
    return jax.vmap(follow)(keys)


def _follow(
    environment: Environment, index: StateSpace, policy: ActionProbs, steps: int, key: PRNGKeyArray
) -> tuple[Array, Array, Array, Array]:
    """Numbers of the states [T+1], actions [T], whether each step was taken [T], and whether the environment ended
    it."""

    def step(carry: tuple[State, Array], key: PRNGKeyArray) -> tuple[tuple[State, Array], tuple[Array, Array, Array]]:
        state, over = carry
        for_action, for_outcome = jax.random.uniform(key, (2,))
        action = inverse_cdf(policy(state), for_action)
        next_state, _, ended = next_step(environment, for_outcome, state, action)
        next_state = jax.tree.map(lambda old, new: jnp.where(over, old, new), state, next_state)
        return (next_state, over | ended), (index.index_of(next_state), action, ~over)

    start_key, key = jax.random.split(key)
    start = sample_initial(environment, start_key)
    begin = (start, environment.terminal(start))
    (_, over), (states, actions, live) = jax.lax.scan(step, begin, jax.random.split(key, steps))
    return jnp.concatenate([index.index_of(start)[None], states]), actions, live, over


def observed(trajectories: Trajectories) -> Knowledge:
    """The world as the trajectories show it: where actions led, how often, and where episodes ended. States that were
    not seen stay in the numbering, and nothing leads there."""
    size, actions = trajectories.space.size, trajectories.num_actions
    steps, counts = np.unique(np.stack(trajectories.taken()), axis=1, return_counts=True)
    pair = steps[0].astype(np.int64) * actions + steps[1]
    first = np.searchsorted(pair, pair)
    rank = np.arange(len(pair)) - first
    outcomes = int(rank.max(initial=0)) + 1

    successors = np.repeat(np.arange(size, dtype=np.int32), actions * outcomes).reshape(size * actions, outcomes)
    probs = np.zeros((size * actions, outcomes))
    probs[:, 0] = 1.0
    totals = np.bincount(pair, counts, minlength=size * actions)
    successors[pair, rank] = steps[2]
    probs[pair, rank] = counts / totals[pair]

    terminal = np.zeros(size, dtype=bool)
    terminal[trajectories.states[trajectories.success, -1]] = True
    starts = np.bincount(trajectories.states[:, 0], minlength=size)
    shape = (size, actions, outcomes)
    tables = Tables(
        space=trajectories.space,
        successors=successors.reshape(shape),
        probs=probs.reshape(shape),
        rewards=np.zeros(shape),
        terminal=terminal,
        initial_probs=starts / starts.sum(),
    )
    return Knowledge(tables, (totals > 0).reshape(size, actions))
