"""A corridor to test on: entering a cell pays its number, and the last cell ends the episode."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from lodestone.envs.base import Environment
from lodestone.options.base import NO_CAP, Options

LEFT, RIGHT = range(2)


class Corridor(Environment):
    length: int = eqx.field(static=True, default=5)
    step_reward: float = eqx.field(static=True, default=0.0)

    @property
    def action_names(self):
        return ("left", "right")

    @property
    def num_outcomes(self):
        return 1

    def initial_distribution(self):
        return jnp.ones(1), jnp.zeros(1, dtype=jnp.int32)

    def outcome_probs(self, state, action):
        return jnp.ones(1)

    def transition(self, state, action, outcome):
        return jnp.clip(state + jnp.where(action == RIGHT, 1, -1), 0, self.length - 1).astype(jnp.int32)

    def reward(self, state, action, next_state):
        return next_state.astype(jnp.float32) + self.step_reward

    def terminal(self, state):
        return state == self.length - 1

    def observe(self, state):
        return (jnp.arange(self.length) == state).astype(jnp.float32)

    def render(self, state):
        return np.zeros((1, self.length, 3), dtype=np.uint8)


class Walk(Options):
    """One option that goes right and stops in the cell `stop`, or with probability `chance` in any."""

    stop: int = eqx.field(static=True)
    chance: float = eqx.field(static=True, default=0.0)

    @property
    def names(self):
        return ("walk",)

    @property
    def max_steps(self):
        return (NO_CAP,)

    def initiation(self, state):
        return jnp.ones(1, dtype=bool)

    def action_probs(self, state):
        return jnp.array([[0.0, 1.0]])

    def termination(self, state):
        return jnp.where(state == self.stop, 1.0, self.chance)[None].astype(jnp.float32)
