"""A task on an environment: the same dynamics with another beginning, end and reward.

The "training environments" of Kuzmin and Panov (2018, section 4.2) are tasks in this sense. The three functions take
the environment as their first argument, so that they can stand at the top of a module, compare equal between two
tasks of the same kind, and read the environment's parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from lodestone.envs.base import Environment
from lodestone.types import Observation, State


class Task(Environment):
    """`environment` with its own `start`, `stop` and `pay`."""

    environment: Environment
    name: str = eqx.field(static=True)
    start: Callable[..., tuple[Float[Array, " I"], State]] = eqx.field(static=True)
    """start(environment) -> the initial distribution."""
    stop: Callable[..., Bool[Array, ""]] = eqx.field(static=True)
    """stop(environment, state) -> whether the task is over."""
    pay: Callable[..., Float[Array, ""]] = eqx.field(static=True)
    """pay(environment, state, action, next_state) -> the task's reward."""

    @property
    def action_names(self) -> tuple[str, ...]:
        return self.environment.action_names

    @property
    def num_outcomes(self) -> int:
        return self.environment.num_outcomes

    def initial_distribution(self) -> tuple[Float[Array, " I"], State]:
        return self.start(self.environment)

    def outcome_probs(self, state: State, action: Int[Array, ""]) -> Float[Array, " K"]:
        return self.environment.outcome_probs(state, action)

    def transition(self, state: State, action: Int[Array, ""], outcome: Int[Array, ""]) -> State:
        return self.environment.transition(state, action, outcome)

    def reward(self, state: State, action: Int[Array, ""], next_state: State) -> Float[Array, ""]:
        return self.pay(self.environment, state, action, next_state)

    def terminal(self, state: State) -> Bool[Array, ""]:
        return self.stop(self.environment, state)

    def observe(self, state: State) -> Observation:
        return self.environment.observe(state)

    def render(self, state: State) -> UInt8[np.ndarray, "height width 3"]:
        return self.environment.render(state)


@dataclass(frozen=True)
class Arrival:
    """A task's reward: 1 on arrival where `holds`, else 0."""

    holds: Callable[..., Bool[Array, ""]]
    """holds(environment, state)."""

    def __call__(
        self, environment: Environment, state: State, action: Int[Array, ""], next_state: State
    ) -> Float[Array, ""]:
        del state, action
        return self.holds(environment, next_state).astype(jnp.float32)


@dataclass(frozen=True)
class Looks:
    """Whether a state looks like this: its observation is the given one, number for number."""

    values: bytes
    shape: tuple[int, ...]
    dtype: str

    @property
    def observation(self) -> np.ndarray:
        """What is seen there."""
        return np.frombuffer(self.values, self.dtype).reshape(self.shape)

    def __call__(self, environment: Environment, state: State) -> Bool[Array, ""]:
        return jnp.all(environment.observe(state) == self.observation)


def looks(observation: Observation) -> Looks:
    """A goal that is given by what is seen there, for `goal`."""
    seen = np.asarray(observation)
    return Looks(seen.tobytes(), seen.shape, seen.dtype.str)


def goal(environment: Environment, name: str, holds: Callable[..., Bool[Array, ""]]) -> Task:
    """The task of getting where `holds`: it begins as the environment does and pays 1 on arrival.

    `holds(environment, state)` is a function at the top of a module, or `looks(observation)`.
    """
    return Task(environment, name, _as_before, holds, Arrival(holds))


def begun_at(environment: Environment, start: Callable[..., tuple[Float[Array, " I"], State]]) -> Task:
    """The environment as it is, but for where its episodes begin."""
    return Task(environment, "begun elsewhere", start, _as_environment_ends, _as_environment_pays)


def endless(environment: Environment) -> Task:
    """The world without its task: an episode begins as before, nothing ends it and nothing is paid."""
    return Task(environment, "endless", _as_before, _never, _nothing)


def _as_before(environment: Environment) -> tuple[Float[Array, " I"], State]:
    return environment.initial_distribution()


def _as_environment_ends(environment: Environment, state: State) -> Bool[Array, ""]:
    return environment.terminal(state)


def _as_environment_pays(
    environment: Environment, state: State, action: Int[Array, ""], next_state: State
) -> Float[Array, ""]:
    return environment.reward(state, action, next_state)


def _never(environment: Environment, state: State) -> Bool[Array, ""]:
    del environment, state
    return jnp.bool_(False)


def _nothing(environment: Environment, state: State, action: Int[Array, ""], next_state: State) -> Float[Array, ""]:
    del environment, state, action, next_state
    return jnp.float32(0)
