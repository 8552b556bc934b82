"""Options written by hand: a predicate where they may start, an action in each state, a predicate where they stop."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lodestone.envs.base import Environment
from lodestone.options.base import NO_CAP, Options
from lodestone.types import State


class Script(eqx.Module):
    """One option as three functions of (environment, state), defined at the top of a module."""

    name: str = eqx.field(static=True)
    may_start: Callable[..., Bool[Array, ""]] = eqx.field(static=True)
    act: Callable[..., Int[Array, ""]] = eqx.field(static=True)
    stops: Callable[..., Bool[Array, ""]] = eqx.field(static=True)


class Scripted(Options):
    """Scripts on an environment, as a set of options."""

    environment: Environment
    scripts: tuple[Script, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(script.name for script in self.scripts)

    @property
    def max_steps(self) -> tuple[int, ...]:
        return (NO_CAP,) * len(self.scripts)

    def initiation(self, state: State) -> Bool[Array, " O"]:
        return jnp.stack([script.may_start(self.environment, state) for script in self.scripts])

    def action_probs(self, state: State) -> Float[Array, "O A"]:
        actions = jnp.stack([script.act(self.environment, state) for script in self.scripts])
        return jax.nn.one_hot(actions, self.environment.num_actions)

    def termination(self, state: State) -> Float[Array, " O"]:
        return jnp.stack([script.stops(self.environment, state) for script in self.scripts]).astype(jnp.float32)
