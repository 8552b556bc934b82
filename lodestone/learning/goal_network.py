"""The two levels of h-DQN as one network: the meta-controller's values of goals, the controller's values of actions.

A controller is told of a goal by its number: each goal has a head of its own. Without hidden layers on one-hot
observations, where nothing is shared, the network is a table of one number a state and goal, and one a state, goal and
action.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from lodestone.envs.base import allowed_actions
from lodestone.envs.task import Task
from lodestone.errors import InvalidConfig
from lodestone.learning.networks import NetworkConfig, QNetwork, Trunk
from lodestone.learning.policies import greedy
from lodestone.learning.united_network import Shared, each_head, init_trunk_and_heads, stack_heads
from lodestone.options.base import Options
from lodestone.types import Observation, State


class GoalNetwork(eqx.Module):
    """Observation -> Q2 of the G goals, and Q1 of the A actions under each goal."""

    trunk: Trunk | None
    """None where nothing is shared."""
    meta: QNetwork
    """Features -> values of the G goals. Features are the trunk's, or the observation where there is none."""
    controller: QNetwork
    """Features -> values of the A actions; arrays have a leading axis of G heads."""

    def goal_values(self, observation: Observation) -> Float[Array, " G"]:
        """Q2(s, .)."""
        return self.meta(self._features(observation))

    def action_values(self, observation: Observation) -> Float[Array, "G A"]:
        """Q1(s, .; g) of every goal g."""
        return each_head(self.controller, self._features(observation))

    def _features(self, observation: Observation) -> Array:
        return observation if self.trunk is None else self.trunk(observation)


def init_goal_network(
    config: NetworkConfig,
    shared: Shared,
    observation_shape: tuple[int, ...],
    num_actions: int,
    num_goals: int,
    key: PRNGKeyArray,
) -> GoalNetwork:
    """A network with Glorot-uniform weights and zero biases.

    Raises `InvalidConfig` if convolutions are asked for where observations are no pictures, and `UnknownName`.
    """
    outputs = [num_goals, *[num_actions] * num_goals]
    trunk, (meta, *controllers) = init_trunk_and_heads(config, shared, observation_shape, outputs, key)
    return GoalNetwork(trunk, meta, stack_heads(controllers))


class GoalOptions(Options):
    """Goals as options: each is pursued by the controller until it holds.

    A goal that holds already may not be chosen; where all of them hold, any may, and is pursued for at least a step.
    """

    goals: tuple[Task, ...]
    """Tasks on one environment."""
    network: GoalNetwork
    epsilon: Float[Array, " G"]
    """Probability of a random action under each goal."""
    cap: int = eqx.field(static=True)
    """Steps after which a goal is given up; `NO_CAP` for never."""

    def __check_init__(self) -> None:
        if self.cap < 1:
            raise InvalidConfig(f"A goal's step cap is {self.cap}, but a goal is pursued for at least one step.")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(goal.name for goal in self.goals)

    @property
    def max_steps(self) -> tuple[int, ...]:
        return (self.cap,) * len(self.goals)

    def initiation(self, state: State) -> Bool[Array, " G"]:
        holds = self._holds(state)
        return ~holds | jnp.all(holds)

    def action_probs(self, state: State) -> Float[Array, "G A"]:
        values = self.network.action_values(self.goals[0].observe(state))
        allowed = allowed_actions(self.goals[0].environment, state)
        best = jax.vmap(greedy, in_axes=(0, None))(values, allowed)
        epsilon, may = self.epsilon[:, None], allowed[None].astype(jnp.float32)
        return (1 - epsilon) * jax.nn.one_hot(best, allowed.size) + epsilon * may / jnp.sum(may)

    def termination(self, state: State) -> Float[Array, " G"]:
        return self._holds(state).astype(jnp.float32)

    def _holds(self, state: State) -> Bool[Array, " G"]:
        return jnp.stack([goal.terminal(state) for goal in self.goals])
