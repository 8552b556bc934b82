"""Option-critic with a network, on-policy, in many environments at once (Bacon et al. 2017; Harb et al. 2018).

What `option_critic` has in tables are here heads on one trunk: Q(s, o), pi_o(.|s) = softmax(theta / temperature) and
beta_o(s) = sigmoid(vartheta). A round takes some steps in every environment with the network as it is; then it climbs
the same gradients, from every step (s, a, r, s') of the running option o:

    critic        G - Q(s, o)                         on Q(s, o)
    policy        [G - Q(s, o)] log pi_o(a|s)         + entropy of pi_o(.|s), weighted
    termination   -[Q(s', o) - V(s') + xi] beta_o(s')

G is a lambda-return of the steps that follow. Where it looks no further it takes what arriving in s' is worth,

    U(s', o) = (1 - beta_o(s')) Q(s', o) + beta_o(s') [V(s') - xi],      V = (1 - epsilon) max Q + epsilon mean Q,

before the coin is tossed that ends the option; where it looks further, the choice of another option costs xi. V is the
value of the policy over options that acts, and so G goes on through the ends of options: it stays a sample of what
Q(s, o) is. Nothing is worth anything after an end of the environment, and everything is after a limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lodestone.agents.option_critic import chosen_value, refuse_rules
from lodestone.envs.base import Environment, remembered
from lodestone.errors import InvalidConfig
from lodestone.learning.adam import adam_step, start_adam
from lodestone.learning.collecting import start_actors, tick_all
from lodestone.learning.loop import Algorithm, RoundLog, log_round
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.option_network import (
    OptionNetwork,
    SoftNetworkOptions,
    init_option_network,
    shown_shape,
)
from lodestone.learning.policies import epsilon_greedy
from lodestone.learning.returns import lambda_returns
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.options.execution import Actor, Decision, Rules
from lodestone.types import State


@dataclass(frozen=True)
class DeepOptionCriticConfig:
    """Settings of the learner. One option makes it a plain actor-critic: its termination changes nothing."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Shape of the trunk; the heads are linear in what comes out of it."""
    num_options: int = 4
    """How many options there are."""
    temperature: float = 1.0
    """Of the options' policies."""
    termination_trains_trunk: bool = False
    """Whether the terminations' gradient goes on into the trunk; in the authors' code it does not."""
    decay: float = 0.9
    """lambda: 0 for targets of one step, 1 for targets as long as the round."""
    entropy: Knots = ((0.0, 0.3), (1.0, 0.01))
    """Weight of the policies' entropy over the run, beside scaled rewards: it has to last until a reward is found."""
    deliberation_cost: float = 0.0
    """xi: what the end of an option costs where the episode goes on, in units of the environment's reward."""
    epsilon: Knots = ((0.0, 0.1),)
    """Probability of a random option over the run."""
    learning_rate: Knots = ((0.0, 1e-3), (0.6, 1e-3), (1.0, 1e-4))
    """Adam's step size over the run."""
    adam_epsilon: float = 1e-4
    """Adam's constant under the fraction."""
    max_gradient_norm: float = 10.0
    """Every weight and bias array's gradient is scaled down to this norm."""
    environments: int = 32
    """Copies of the environment that one seed runs side by side."""
    ticks_per_round: int = 8
    """Steps of every environment between two updates."""
    reward_scale: float = 1.0
    """Factor on rewards inside the learner; values near 10 are learned fastest."""

    @property
    def steps_per_round(self) -> int:
        """Of all environments."""
        return self.ticks_per_round * self.environments

    def rounds(self, steps: int) -> int:
        """How many rounds take at least `steps` steps."""
        return -(-steps // self.steps_per_round)

    def __post_init__(self) -> None:
        for name in ("num_options", "environments", "ticks_per_round"):
            if getattr(self, name) < 1:
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be at least 1.")
        for name in ("temperature", "adam_epsilon", "max_gradient_norm", "reward_scale"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be a positive number.")
        if not 0.0 <= self.decay <= 1.0:
            raise InvalidConfig(f"decay is {self.decay}, but must be from 0 to 1.")
        if not math.isfinite(self.deliberation_cost):
            raise InvalidConfig(f"deliberation_cost is {self.deliberation_cost}, but must be a finite number.")
        check_knots("entropy", self.entropy, 0.0, math.inf)
        for name in ("learning_rate", "epsilon"):
            check_knots(name, getattr(self, name), 0.0, 1.0)


class Steps(NamedTuple):
    """Primitive steps as they were taken: T ticks in N environments."""

    state: State
    option: Int[Array, "T N"]
    """The one that ran."""
    action: Int[Array, "T N"]
    next_state: State
    """Before any restart."""
    terminated: Bool[Array, "T N"]
    cut: Bool[Array, "T N"]
    """Whether the episode ended, by the environment or at a limit."""
    stopped: Bool[Array, "T N"]
    """Whether the option ended."""


class Scheduled(NamedTuple):
    """What changes over the run."""

    learning_rate: Float[Array, ""]
    entropy: Float[Array, ""]
    epsilon: Float[Array, ""]


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    network: OptionNetwork
    adam: optax.ScaleByAdamState
    actors: Actor
    key: PRNGKeyArray


def arriving_value(
    values: Float[Array, " O"],
    stop: Float[Array, ""],
    option: Int[Array, ""],
    epsilon: Float[Array, ""],
    cost: float,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """U of a running option that arrives where options have these values, and its advantage over a choice anew."""
    anew = chosen_value(values, epsilon) - cost
    advantage = values[option] - anew
    return anew + (1 - stop) * advantage, advantage


def loss(
    config: DeepOptionCriticConfig,
    environment: Environment,
    discount: float,
    network: OptionNetwork,
    steps: Steps,
    now: Scheduled,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """What falls along the gradients above, as a mean over steps; and the critic's mean squared error."""
    cost = config.reward_scale * config.deliberation_cost
    options = SoftNetworkOptions(environment, network, config.temperature)

    def here(state: State, option: Array, action: Array) -> tuple[Array, Array, Array]:
        features = options.features(state)
        log_probs = options.log_probs(state, features)[option]
        return network.values(features)[option], log_probs[action], -jnp.sum(jnp.exp(log_probs) * log_probs)

    def there(state: State, option: Array) -> tuple[Array, Array, Array]:
        features = options.features(state)
        values = jax.lax.stop_gradient(network.values(features))
        if not config.termination_trains_trunk:
            features = jax.lax.stop_gradient(features)
        stop = jax.nn.sigmoid(network.exits(features)[option])
        return stop, *arriving_value(values, stop, option, now.epsilon, cost)

    reward = config.reward_scale * _each(environment.reward)(steps.state, steps.action, steps.next_state)
    values, log_probs, entropies = _each(here)(steps.state, steps.option, steps.action)
    stops, arriving, advantages = _each(there)(steps.next_state, steps.option)
    discounts = jnp.where(steps.terminated, 0.0, discount)
    # Looking further, a return sees whether the option has ended.
    goes_on = jnp.where(steps.cut, 0.0, config.decay).at[-1].set(0.0)
    paid = reward - goes_on * discounts * jnp.where(steps.stopped, cost, 0.0)
    returns = jax.vmap(lambda_returns, in_axes=(1, 1, 1, 1, None), out_axes=1)(
        paid, discounts, arriving, steps.cut, config.decay
    )
    errors = jax.lax.stop_gradient(returns) - values
    of_critic = jnp.mean(jnp.square(errors))
    of_policy = jnp.mean(jax.lax.stop_gradient(errors) * log_probs)
    of_terminations = jnp.mean(jnp.where(steps.terminated, 0.0, stops * advantages))
    return 0.5 * of_critic - of_policy + of_terminations - now.entropy * jnp.mean(entropies), of_critic


def _each(function: Callable) -> Callable:
    """Of T steps in N environments."""
    return jax.vmap(jax.vmap(function))


def deep_option_critic(config: DeepOptionCriticConfig, environment: Environment, rules: Rules, steps: int) -> Algorithm:
    """The algorithm for the training loop. Schedules are fractions of `steps`.

    Raises `InvalidConfig` for rules under which an option's reward is not the discounted sum of its steps' rewards or a
    limit is an end.
    """
    refuse_rules(rules)
    rounds = config.rounds(steps)
    everything = jnp.ones(config.num_options, dtype=bool)

    def init(key: PRNGKeyArray) -> Carry:
        network_key, actor_key, key = jax.random.split(key, 3)
        network = init_option_network(
            config.network, shown_shape(environment), config.num_options, environment.num_actions, network_key
        )
        actors = start_actors(environment, actor_key, config.environments)
        return Carry(network, start_adam(network), actors, key)

    def take_steps(carry: Carry, key: PRNGKeyArray, epsilon: Array) -> tuple[Actor, tuple[Decision, Steps]]:
        options = SoftNetworkOptions(environment, carry.network, config.temperature)

        def choose(uniform: Float[Array, "N 2"], states: State) -> Int[Array, " N"]:
            values = jax.vmap(options.values)(states)
            return jax.vmap(epsilon_greedy, in_axes=(0, 0, None, None))(uniform, values, everything, epsilon)

        def step(actors: Actor, tick_key: PRNGKeyArray) -> tuple[Actor, tuple[Decision, Steps]]:
            after, decision = tick_all(environment, options, rules, tick_key, actors, choose)
            taken = Steps(
                state=remembered(environment, actors.state),
                option=decision.transition.action,
                action=decision.action,
                next_state=decision.transition.next_obs,
                terminated=decision.terminated,
                cut=decision.episode_ended,
                stopped=decision.valid,
            )
            return after, (decision, taken)

        return jax.lax.scan(step, carry.actors, jax.random.split(key, config.ticks_per_round))

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        """`ticks_per_round` steps of every environment, then one step along the gradients."""
        fraction = number.astype(jnp.float32) / rounds
        now = Scheduled(
            *(piecewise_linear(knots, fraction) for knots in (config.learning_rate, config.entropy, config.epsilon))
        )
        steps_key, key = jax.random.split(carry.key)
        actors, (decisions, taken) = take_steps(carry, steps_key, now.epsilon)

        def of_network(network: OptionNetwork) -> tuple[Array, Array]:
            return loss(config, environment, rules.discount, network, taken, now)

        (_, error), gradient = jax.value_and_grad(of_network, has_aux=True)(carry.network)
        network, adam = adam_step(
            carry.network, gradient, carry.adam, now.learning_rate, config.adam_epsilon, config.max_gradient_norm
        )
        decisions = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), decisions)
        return Carry(network, adam, actors, key), log_round(decisions, error)

    return Algorithm(init, run_round)
