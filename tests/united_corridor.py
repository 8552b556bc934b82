"""A corridor with two options on it, to test united networks on: walk to cell 2 and walk to cell 4."""

from __future__ import annotations

import jax.numpy as jnp
from corridor import Corridor

from lodestone.envs.task import Task

LENGTH = 7
CORRIDOR = Corridor(length=LENGTH, step_reward=-7.0)


def _anywhere(corridor):
    return jnp.full(corridor.length - 1, 1 / (corridor.length - 1)), jnp.arange(corridor.length - 1, dtype=jnp.int32)


def _at_2(corridor, state):
    return state == 2


def _at_4(corridor, state):
    return state == 4


def _pay_2(corridor, state, action, next_state):
    return -1.0 + 10.0 * (next_state == 2).astype(jnp.float32)


def _pay_4(corridor, state, action, next_state):
    return -1.0 + 10.0 * (next_state == 4).astype(jnp.float32)


OPTIONS = (Task(CORRIDOR, "to-2", _anywhere, _at_2, _pay_2), Task(CORRIDOR, "to-4", _anywhere, _at_4, _pay_4))
