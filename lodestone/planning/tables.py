"""An environment as arrays: every reachable state, what each action leads to, and what it pays.

The tables are computed from the same functions that the training loop samples, so that the two cannot disagree.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import sparse

from lodestone.envs.base import Environment
from lodestone.envs.host import Shown
from lodestone.envs.state_space import BATCH, StateSpace, reachable_states
from lodestone.errors import LodestoneError
from lodestone.types import State

SUM_TOLERANCE = 1e-4
"""How far from 1 the probabilities that an environment or an option states may sum: they are float32."""


class Tables(NamedTuple):
    """A Markov decision process over S numbered states. The arrays are shared and read-only.

    A terminal state stays where it is for a reward of 0, whatever the action.
    """

    space: StateSpace
    """The states and their numbers."""
    successors: Int[np.ndarray, "S A K"]
    """Number of the state that each of nature's draws leads to, int32."""
    probs: Float[np.ndarray, "S A K"]
    """Probability of each draw, float64; sums to 1 over K."""
    rewards: Float[np.ndarray, "S A K"]
    """Reward of the step, float64."""
    terminal: Bool[np.ndarray, " S"]
    """Where the episode is over."""
    initial_probs: Float[np.ndarray, " S"]
    """Probability that an episode begins in each state, float64; sums to 1."""

    @property
    def num_states(self) -> int:
        """S."""
        return self.successors.shape[0]

    @property
    def num_actions(self) -> int:
        """A."""
        return self.successors.shape[1]

    def mean_rewards(self) -> Float[np.ndarray, "S A"]:
        """Expected reward of each action."""
        if self.rewards.shape[2] == 1:
            return self.rewards[:, :, 0]
        return np.einsum("sak,sak->sa", self.probs, self.rewards)

    def matrix(self) -> sparse.csr_array:
        """P, float64 [A * S, S]: row a * S + s holds the probabilities of what follows action a in state s."""
        probs, following = (array.swapaxes(0, 1).ravel() for array in (self.probs, self.successors))
        rows = self.num_actions * self.num_states
        starts = _row_starts(np.full(rows, self.probs.shape[2]))
        return sparse.csr_array((probs, following, starts), (rows, self.num_states))

    def policy_matrix(self, policy: Int[np.ndarray, " S"] | Float[np.ndarray, "S A"]) -> sparse.csr_array:
        """P of a policy, float64 [S, S], given as one action a state or as probabilities; stores no zeros."""
        states, actions, weights = _chosen(policy)
        probs = weights[:, None] * self.probs[states, actions]
        per_state = np.bincount(states, minlength=self.num_states) * self.probs.shape[2]
        following = self.successors[states, actions].ravel()
        matrix = sparse.csr_array((probs.ravel(), following, _row_starts(per_state)), (self.num_states,) * 2)
        matrix.sum_duplicates()
        matrix.eliminate_zeros()
        return matrix

    def policy_rewards(self, policy: Int[np.ndarray, " S"] | Float[np.ndarray, "S A"]) -> Float[np.ndarray, " S"]:
        """Expected reward of a step of a policy, given as one action a state or as probabilities."""
        states, actions, weights = _chosen(policy)
        rewards = np.einsum("nk,nk->n", self.probs[states, actions], self.rewards[states, actions])
        return np.bincount(states, weights * rewards, minlength=self.num_states)

    def with_step_reward(self, reward: float) -> Tables:
        """The same process where every step out of a state that is not terminal pays `reward`."""
        per_state = np.where(self.terminal, 0.0, reward)
        return self._replace(rewards=np.broadcast_to(per_state[:, None, None], self.rewards.shape))

    def initial_mean(self, values: Float[np.ndarray, " S"]) -> float:
        """Mean of `values` over the states where episodes begin; an infinite value elsewhere does no harm."""
        begins = self.initial_probs > 0
        return float(self.initial_probs[begins] @ values[begins])


def tabulate(environment: Environment) -> Tables:
    """Tables of all states that can be reached from the initial ones; remembered for the last few environments.

    Memory: 20 bytes a state, action and outcome; 12 where the world is deterministic.
    Raises `TooManyStates`, and `LodestoneError` where the environment's probabilities do not sum to 1.
    """
    return _tabulate(environment)


@lru_cache(maxsize=4)
def _tabulate(environment: Environment) -> Tables:
    space = reachable_states(environment)
    # The batches hold the states: only the hashes go along to the device.
    index = replace(space, states=None)
    shape = (space.size, environment.num_actions, environment.num_outcomes)
    successors = np.empty(shape, dtype=np.int32)
    rewards = np.empty(shape, dtype=np.float64)
    terminal = np.empty(space.size, dtype=bool)
    deterministic = environment.num_outcomes == 1
    probs = np.broadcast_to(1.0, shape) if deterministic else np.empty(shape, dtype=np.float64)
    for rows, states in state_batches(space):
        count = rows.stop - rows.start
        batch = jax.device_get(_expand(environment, index, states))
        successors[rows], rewards[rows], terminal[rows] = (leaf[:count] for leaf in batch)
        if not deterministic:
            probs[rows] = jax.device_get(_outcome_probs(environment, states))[:count]

    successors[terminal] = np.flatnonzero(terminal)[:, None, None]
    rewards[terminal] = 0.0
    if not deterministic:
        probs[terminal] = np.eye(shape[2])[0]
        probs = normalised(probs, "The probabilities of nature's draws")

    initial_probs, initial_states = environment.initial_distribution()
    numbers = np.asarray(jax.vmap(index.index_of)(jax.tree.map(jnp.asarray, initial_states)))
    initial = np.bincount(numbers, np.asarray(initial_probs, dtype=np.float64), minlength=space.size)
    initial = normalised(initial, "The probabilities of the initial states")
    tables = Tables(space, successors, probs, rewards, terminal, initial)
    for array in tables[1:]:
        array.setflags(write=False)
    return tables


def state_batches(space: StateSpace | Shown) -> Iterator[tuple[slice, State]]:
    """All states in batches of `BATCH`, each with the numbers it holds; the last one is filled up with copies of the
    last state, so that one compiled shape serves all."""
    for start in range(0, space.size, BATCH):
        numbers = np.minimum(np.arange(start, start + BATCH), space.size - 1)
        yield slice(start, min(start + BATCH, space.size)), _take(space.states, numbers)


def state_text(space: StateSpace | Shown, number: int) -> str:
    """A state for a person to read, such as `bricks=[1, 1], row=0`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(_take(space.states, number))
    names = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in leaves]
    values = [str(np.asarray(leaf).tolist()) for _, leaf in leaves]
    return ", ".join(f"{name}={value}" if name else value for name, value in zip(names, values, strict=True))


def normalised(probs: Float[np.ndarray, "*shape N"], what: str) -> Float[np.ndarray, "*shape N"]:
    """`probs` scaled to sum to 1 in float64; raises `LodestoneError` where they are not probabilities."""
    sums = probs.sum(axis=-1, keepdims=True)
    if not (np.all(np.abs(sums - 1.0) <= SUM_TOLERANCE) and np.all(probs >= 0.0)):
        raise LodestoneError(f"{what} must not be negative and must sum to 1, but somewhere they do not.")
    return probs / sums


@jax.jit
def _expand(environment: Environment, index: StateSpace, states: State) -> tuple[Array, Array, Array]:
    """Successors [B, A, K], rewards [B, A, K] and terminal [B] of a batch of states."""

    def step(state: State, action: Array, outcome: Array) -> tuple[Array, Array]:
        next_state = environment.transition(state, action, outcome)
        return index.index_of(next_state), environment.reward(state, action, next_state)

    actions, outcomes = jnp.arange(environment.num_actions), jnp.arange(environment.num_outcomes)
    each_outcome = jax.vmap(step, in_axes=(None, None, 0))
    each_action = jax.vmap(each_outcome, in_axes=(None, 0, None))
    successors, rewards = jax.vmap(each_action, in_axes=(0, None, None))(states, actions, outcomes)
    return successors, rewards, jax.vmap(environment.terminal)(states)


@jax.jit
def _outcome_probs(environment: Environment, states: State) -> Float[Array, "B A K"]:
    each_action = jax.vmap(environment.outcome_probs, in_axes=(None, 0))
    return jax.vmap(each_action, in_axes=(0, None))(states, jnp.arange(environment.num_actions))


def _chosen(
    policy: Int[np.ndarray, " S"] | Float[np.ndarray, "S A"],
) -> tuple[Int[np.ndarray, " N"], Int[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """States, actions and probabilities of the pairs that a policy takes, in the order of the states."""
    if policy.ndim == 1:
        return np.arange(len(policy)), policy, np.ones(len(policy))
    states, actions = np.nonzero(policy)
    return states, actions, policy[states, actions].astype(np.float64)


def _row_starts(lengths: Int[np.ndarray, " N"]) -> Int[np.ndarray, " N+1"]:
    """Where each row of a compressed matrix begins; int32, as the columns are, where that is wide enough."""
    starts = np.concatenate([[0], np.cumsum(lengths)])
    return starts.astype(np.int32) if starts[-1] <= np.iinfo(np.int32).max else starts


def _take(states: State, numbers: Int[np.ndarray, " N"] | int) -> State:
    return jax.tree.map(lambda leaf: leaf[numbers], states)
