"""Options whose policies are Q-networks, as the paper pretrains them (section 4.2)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lodestone.envs.task import Task
from lodestone.options.base import NO_CAP, Options
from lodestone.types import Observation, State


class NetworkOptions(Options):
    """One option per task: greedy under its network, ended where its task ends.

    Initiation is everywhere: the networks are trained from random layouts so that they may start in any state (the
    paper's I = S); cap them, as a network can go astray where it was never trained.
    """

    tasks: tuple[Task, ...]
    """Tasks on one environment."""
    networks: Callable[[Observation], Float[Array, " A"]]
    """Observation -> action values, as one stacked module: every array has a leading axis of one entry per task."""

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(task.name for task in self.tasks)

    @property
    def max_steps(self) -> tuple[int, ...]:
        return (NO_CAP,) * len(self.tasks)

    def initiation(self, state: State) -> Bool[Array, " O"]:
        del state
        return jnp.ones(self.size, dtype=bool)

    def action_probs(self, state: State) -> Float[Array, "O A"]:
        observation = self.tasks[0].observe(state)
        values = jax.vmap(lambda network: network(observation))(self.networks)
        return jax.nn.one_hot(jnp.argmax(values, axis=1), self.tasks[0].num_actions)

    def termination(self, state: State) -> Float[Array, " O"]:
        return jnp.stack([task.terminal(state) for task in self.tasks]).astype(jnp.float32)
