"""What an option is, and sets of options.

An option (Sutton, Precup and Singh 1999) is a triple: where it may start, what it does, where it stops. A *set* of
options is one object with O options and three functions of a state, each with a leading option axis. Primitive
actions are options too. Functions take one state; callers `jax.vmap`.

Two rules hold everywhere: an option runs at least one step, so `termination` is asked on arrival and never where the
option was just chosen; and a maximum or a random draw over options runs over `initiation` only.
"""

from __future__ import annotations

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lodestone.envs.base import Environment, OutsideEnvironment
from lodestone.errors import InvalidConfig
from lodestone.types import State

NO_CAP = np.iinfo(np.int32).max
"""`max_steps` of an option that only its own termination ends."""


class Options(eqx.Module):
    """The contract of a set of O options over A primitive actions."""

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the O options, in order."""

    @property
    @abstractmethod
    def max_steps(self) -> tuple[int, ...]:
        """The step at which each option is stopped whatever its termination says; `NO_CAP` for never.

        A cap makes termination depend on the time the option has run: the option is then semi-Markov.
        """

    @abstractmethod
    def initiation(self, state: State) -> Bool[Array, " O"]:
        """Which options may start in `state`."""

    @abstractmethod
    def action_probs(self, state: State) -> Float[Array, "O A"]:
        """Each option's policy: probabilities of the primitive actions."""

    @abstractmethod
    def termination(self, state: State) -> Float[Array, " O"]:
        """Probability that each option stops on arrival in `state`."""

    @property
    def size(self) -> int:
        """O, the number of options."""
        return len(self.names)


class Primitives(Options):
    """The primitive actions as options of one step, allowed everywhere."""

    action_names: tuple[str, ...] = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        return self.action_names

    @property
    def max_steps(self) -> tuple[int, ...]:
        return (1,) * len(self.action_names)

    def initiation(self, state: State) -> Bool[Array, " O"]:
        del state
        return jnp.ones(self.size, dtype=bool)

    def action_probs(self, state: State) -> Float[Array, "O A"]:
        del state
        return jnp.eye(self.size, dtype=jnp.float32)

    def termination(self, state: State) -> Float[Array, " O"]:
        del state
        return jnp.ones(self.size, dtype=jnp.float32)


class AllowedPrimitives(Primitives):
    """The primitive actions of an environment that does not allow all of them everywhere."""

    environment: OutsideEnvironment

    def initiation(self, state: State) -> Bool[Array, " O"]:
        return self.environment.allowed(state)


def primitives(environment: Environment) -> Primitives:
    """The primitive actions of an environment as options."""
    if isinstance(environment, OutsideEnvironment):
        return AllowedPrimitives(environment.action_names, environment)
    return Primitives(environment.action_names)


class Union(Options):
    """Several sets one after the other, as one set."""

    parts: tuple[Options, ...]

    def __check_init__(self) -> None:
        if not self.parts:
            raise InvalidConfig("A set of options needs at least one option.")
        if len(set(self.names)) != len(self.names):
            raise InvalidConfig(f"Options need different names, but these were given: {', '.join(self.names)}.")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for part in self.parts for name in part.names)

    @property
    def max_steps(self) -> tuple[int, ...]:
        return tuple(cap for part in self.parts for cap in part.max_steps)

    def initiation(self, state: State) -> Bool[Array, " O"]:
        return jnp.concatenate([part.initiation(state) for part in self.parts])

    def action_probs(self, state: State) -> Float[Array, "O A"]:
        return jnp.concatenate([part.action_probs(state) for part in self.parts])

    def termination(self, state: State) -> Float[Array, " O"]:
        return jnp.concatenate([part.termination(state) for part in self.parts])


class Capped(Options):
    """A set whose options are stopped after `cap` steps at the latest."""

    options: Options
    cap: int = eqx.field(static=True)

    def __check_init__(self) -> None:
        if self.cap < 1:
            raise InvalidConfig(f"An option's step cap is {self.cap}, but an option runs at least one step.")

    @property
    def names(self) -> tuple[str, ...]:
        return self.options.names

    @property
    def max_steps(self) -> tuple[int, ...]:
        return tuple(min(cap, self.cap) for cap in self.options.max_steps)

    def initiation(self, state: State) -> Bool[Array, " O"]:
        return self.options.initiation(state)

    def action_probs(self, state: State) -> Float[Array, "O A"]:
        return self.options.action_probs(state)

    def termination(self, state: State) -> Float[Array, " O"]:
        return self.options.termination(state)
