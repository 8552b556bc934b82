"""What option-critic learns, as one network: the values of options, their policies and their terminations on one trunk.

Without hidden layers on one-hot observations the network is the tables of the tabular learner, and a number for each
column of them besides.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num, PRNGKeyArray

from lodestone.envs.base import Environment, allowed_actions, example_state
from lodestone.envs.state_space import reachable_states
from lodestone.learning.networks import Linear, NetworkConfig, Trunk, build_layers, draw_weights, weight_shapes
from lodestone.learning.policies import forbid
from lodestone.options.base import NO_CAP, Options
from lodestone.options.soft import numbered_names
from lodestone.types import State


class OptionNetwork(eqx.Module):
    """Observation -> what is learned about O options over A actions."""

    trunk: Trunk
    values: Linear
    """Features -> Q of the O options."""
    preferences: Linear
    """Features -> theta of the O x A pairs of option and action, option by option."""
    exits: Linear
    """Features -> vartheta of the O options."""

    @property
    def num_options(self) -> int:
        """O; also of networks with leading axes."""
        return self.values.bias.shape[-1]

    def theta(self, features: Float[Array, " F"]) -> Float[Array, "O A"]:
        """Preferences of every option."""
        return self.preferences(features).reshape(self.num_options, -1)


def init_option_network(
    config: NetworkConfig, observation_shape: tuple[int, ...], num_options: int, num_actions: int, key: PRNGKeyArray
) -> OptionNetwork:
    """A trunk with Glorot-uniform weights under heads of zeros: as on tables, no option is preferred at the start, all
    of them act at random, and end with probability a half.

    Raises `InvalidConfig` if convolutions are asked for where observations are no pictures.
    """
    *shapes, (features, _) = weight_shapes(config, observation_shape, 1)
    weights = draw_weights(key, shapes) if shapes else []
    trunk = Trunk(*build_layers(config, weights), config.pooling)

    def head(outputs: int) -> Linear:
        return Linear(jnp.zeros((features, outputs)), jnp.zeros(outputs))

    return OptionNetwork(trunk, head(num_options), head(num_options * num_actions), head(num_options))


def sight(environment: Environment) -> Callable[[State], Num[Array, "..."]]:
    """What a network is shown of a state: the observation, or a one-hot vector where that is a whole number.

    Raises `TooManyStates` where these numbers cannot be counted.
    """
    seen = jax.eval_shape(lambda state: environment.observe(state), example_state(environment))
    if seen.shape or not jnp.issubdtype(seen.dtype, jnp.integer):
        return environment.observe
    with jax.ensure_compile_time_eval():
        count = int(jnp.max(jax.vmap(environment.observe)(reachable_states(environment).states))) + 1
    return lambda state: jax.nn.one_hot(environment.observe(state), count)


def shown_shape(environment: Environment) -> tuple[int, ...]:
    """Of what `sight` shows."""
    return jax.eval_shape(sight(environment), example_state(environment)).shape


class SoftNetworkOptions(Options):
    """The options of a network; they may start anywhere."""

    environment: Environment
    network: OptionNetwork
    temperature: float = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        return numbered_names(self.network.num_options)

    @property
    def max_steps(self) -> tuple[int, ...]:
        return (NO_CAP,) * self.network.num_options

    def initiation(self, state: State) -> Bool[Array, " O"]:
        del state
        return jnp.ones(self.size, dtype=bool)

    def action_probs(self, state: State) -> Float[Array, "O A"]:
        return jnp.exp(self.log_probs(state, self.features(state)))

    def termination(self, state: State) -> Float[Array, " O"]:
        return jax.nn.sigmoid(self.network.exits(self.features(state)))

    def values(self, state: State) -> Float[Array, " O"]:
        """Q(s, .), as it is learned."""
        return self.network.values(self.features(state))

    def features(self, state: State) -> Float[Array, " F"]:
        """What the heads work on."""
        return self.network.trunk(sight(self.environment)(state))

    def log_probs(self, state: State, features: Float[Array, " F"]) -> Float[Array, "O A"]:
        """Logarithms of the actions' probabilities under each option."""
        theta = self.network.theta(features) / self.temperature
        return jax.nn.log_softmax(forbid(theta, allowed_actions(self.environment, state)))
