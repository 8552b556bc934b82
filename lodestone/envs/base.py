"""What an environment is: a Markov decision process written once, as pure functions of one state.

The same functions are sampled by the training loop, enumerated by the planner, wrapped for Gymnasium and drawn as
pictures, so that none of these can disagree. There is no batch axis (callers `jax.vmap`), no clock, no random key
inside: nature's draw is the argument `outcome`. Time limits and resets belong to whoever runs the environment.
"""

from __future__ import annotations

import itertools
from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8

from lodestone.types import Observation, State


class Environment(eqx.Module):
    """The contract. Parameters are static fields, so that an environment is hashable and holds no arrays unless its
    dynamics are tables."""

    @property
    @abstractmethod
    def action_names(self) -> tuple[str, ...]:
        """Names of the primitive actions, in order."""

    @property
    @abstractmethod
    def num_outcomes(self) -> int:
        """K, how many draws nature has: 1 in a deterministic world."""

    @abstractmethod
    def initial_distribution(self) -> tuple[Float[Array, " I"], State]:
        """Probabilities, all positive, of the I states in which an episode may begin, and these states, stacked."""

    @abstractmethod
    def outcome_probs(self, state: State, action: Int[Array, ""]) -> Float[Array, " K"]:
        """Probabilities of nature's draws."""

    @abstractmethod
    def transition(self, state: State, action: Int[Array, ""], outcome: Int[Array, ""]) -> State:
        """The next state, a deterministic function of state, action and nature's draw."""

    @abstractmethod
    def reward(self, state: State, action: Int[Array, ""], next_state: State) -> Float[Array, ""]:
        """The reward of one step."""

    @abstractmethod
    def terminal(self, state: State) -> Bool[Array, ""]:
        """Whether the episode is over in this state."""

    @abstractmethod
    def observe(self, state: State) -> Observation:
        """What the agent sees."""

    @abstractmethod
    def render(self, state: State) -> UInt8[np.ndarray, "height width 3"]:
        """What a person sees (runs on the host, not compiled)."""

    @property
    def num_actions(self) -> int:
        """A, the number of primitive actions."""
        return len(self.action_names)


class OutsideEnvironment(Environment):
    """An environment that is no pure function but something outside the program, which a step asks: its states cannot
    be made, nor listed, and a step that was taken cannot be taken back."""

    @abstractmethod
    def example(self) -> State:
        """Any state, for shapes and dtypes."""

    @abstractmethod
    def begin(self, uniform: Float[Array, ""]) -> State:
        """The first state of a new copy's first episode."""

    @abstractmethod
    def begin_again(self, ended: State) -> State:
        """The first state of the episode after the one that ended in this state."""

    @abstractmethod
    def allowed(self, state: State) -> Bool[Array, " A"]:
        """The actions that may be taken."""

    @abstractmethod
    def truncated(self, state: State) -> Bool[Array, ""]:
        """Whether a limit of its own, no end, cut the episode here."""

    @abstractmethod
    def hold(self, state: State, still: Bool[Array, ""]) -> State:
        """The state from which no step is taken where `still`: what comes of it then will not be used."""

    @abstractmethod
    def remember(self, state: State) -> State:
        """What a memory needs of the state: enough to observe it."""

    @abstractmethod
    def close(self) -> None:
        """Let go of all copies: states from before are void."""


class Step(NamedTuple):
    """What one primitive step brought."""

    state: State
    reward: Float[Array, ""]
    terminated: Bool[Array, ""]


UNROLLED = 32
"""Up to so many probabilities are summed one by one, which compiles to far faster code than a cumulative sum."""


def inverse_cdf(probs: Float[Array, " K"], uniform: Float[Array, ""]) -> Int[Array, ""]:
    """The index that a uniform number in [0, 1) picks; one of probability zero is never picked.

    One number a draw, where a Gumbel draw would take K.
    """
    if probs.shape[0] <= UNROLLED:
        sums = list(itertools.accumulate(probs[index] for index in range(probs.shape[0])))
        point = uniform * sums[-1]
        # Summed in order, they never fall: those that lie below the point come before the first that does not.
        return sum((edge <= point).astype(jnp.int32) for edge in sums[:-1]) + jnp.int32(0)
    # A cumulative sum rounds out of order, so that it may rise, or fall, where nothing was added.
    edges = jnp.where(probs > 0, jnp.cumsum(probs), 0.0)
    return jnp.argmax(edges > uniform * jnp.max(edges)).astype(jnp.int32)


def sample_categorical(key: PRNGKeyArray, probs: Float[Array, " K"]) -> Int[Array, ""]:
    """An index drawn with the given probabilities."""
    return inverse_cdf(probs, jax.random.uniform(key))


def initial_state(environment: Environment, uniform: Float[Array, ""]) -> State:
    """The first state of an episode that a uniform number in [0, 1) picks."""
    if isinstance(environment, OutsideEnvironment):
        return environment.begin(uniform)
    with jax.ensure_compile_time_eval():
        probs, states = environment.initial_distribution()
    count = probs.shape[0]
    if count == 1:
        return jax.tree.map(lambda leaf: leaf[0], states)
    if not isinstance(probs, jax.core.Tracer) and np.all(np.asarray(probs) == np.asarray(probs)[0]):
        index = jnp.minimum((uniform * count).astype(jnp.int32), count - 1)
    else:
        # There may be hundreds of states to begin in: a search by halves.
        edges = jnp.cumsum(probs)
        index = jnp.searchsorted(edges, uniform * edges[-1], side="right", method="scan_unrolled")
    return jax.tree.map(lambda leaf: leaf[index], states)


def next_episode(environment: Environment, uniform: Float[Array, ""], ended: State) -> State:
    """The first state of the episode that follows one that ended in a state."""
    if isinstance(environment, OutsideEnvironment):
        return environment.begin_again(ended)
    return initial_state(environment, uniform)


def next_step(environment: Environment, uniform: Float[Array, ""], state: State, action: Int[Array, ""]) -> Step:
    """One primitive step: a uniform number in [0, 1) picks nature's draw, the state moves, the reward is paid."""
    outcome = jnp.int32(0)
    if environment.num_outcomes > 1:
        outcome = inverse_cdf(environment.outcome_probs(state, action), uniform)
    next_state = environment.transition(state, action, outcome)
    return Step(next_state, environment.reward(state, action, next_state), environment.terminal(next_state))


def sample_initial(environment: Environment, key: PRNGKeyArray) -> State:
    """The first state of an episode, at random."""
    return initial_state(environment, jax.random.uniform(key))


def sample_step(environment: Environment, key: PRNGKeyArray, state: State, action: Int[Array, ""]) -> Step:
    """One primitive step, at random."""
    return next_step(environment, jax.random.uniform(key), state, action)


def allowed_actions(environment: Environment, state: State) -> Bool[Array, " A"]:
    """The primitive actions that may be taken in a state."""
    if isinstance(environment, OutsideEnvironment):
        return environment.allowed(state)
    return jnp.ones(environment.num_actions, dtype=bool)


def remembered(environment: Environment, state: State) -> State:
    """What a memory keeps of a state."""
    return environment.remember(state) if isinstance(environment, OutsideEnvironment) else state


def example_state(environment: Environment) -> State:
    """The first of the initial states: an example for shapes and dtypes."""
    if isinstance(environment, OutsideEnvironment):
        return environment.example()
    _, states = environment.initial_distribution()
    return jax.tree.map(lambda leaf: leaf[0], states)


def observation_shape(environment: Environment) -> tuple[int, ...]:
    """Of what the agent sees."""
    return jax.eval_shape(environment.observe, example_state(environment)).shape
