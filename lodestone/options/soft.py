"""Options made of parameters, as option-critic learns them (Bacon, Harb and Precup 2017).

    pi_o(a|s) = softmax over a of theta(s, o, a) / temperature          beta_o(s) = sigmoid(vartheta(s, o))

They may start anywhere. An action that a Gymnasium environment forbids in s has no part in the softmax there.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lodestone.envs.host import Shown
from lodestone.envs.state_space import Numbers, StateSpace
from lodestone.options.base import NO_CAP, Options
from lodestone.types import State


def numbered_names(count: int) -> tuple[str, ...]:
    """Names for options that nobody has given one."""
    return tuple(f"option-{number}" for number in range(count))


class SoftOptions(Options):
    """O options over S states."""

    space: StateSpace | Numbers | Shown
    preferences: Float[Array, "S O A"]
    """theta."""
    exits: Float[Array, "S O"]
    """vartheta."""
    temperature: float = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        return numbered_names(self.exits.shape[1])

    @property
    def max_steps(self) -> tuple[int, ...]:
        return (NO_CAP,) * self.exits.shape[1]

    def initiation(self, state: State) -> Bool[Array, " O"]:
        del state
        return jnp.ones(self.size, dtype=bool)

    def action_probs(self, state: State) -> Float[Array, "O A"]:
        theta = self.preferences[self.space.index_of(state)] / self.temperature
        if isinstance(self.space, Shown):
            theta = jnp.where(self.space.environment.allowed(state), theta, jnp.finfo(jnp.float32).min)
        return jax.nn.softmax(theta)

    def termination(self, state: State) -> Float[Array, " O"]:
        return jax.nn.sigmoid(self.exits[self.space.index_of(state)])
