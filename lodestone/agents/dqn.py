"""DQN over options (Kuzmin and Panov 2018, algorithm 2; Mnih et al. 2015).

The flat DQN is the same learner with the primitive actions as its options: a primitive is an option of one step, so
there is one code path. What options change is in the transition: its reward is the discounted sum over the option's
k steps, its discount is gamma^k, and its maximum runs over the options that may start where the option ended.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt32

from lodestone.envs.base import Environment, observation_shape
from lodestone.errors import InvalidConfig
from lodestone.learning.adam import adam_step, start_adam
from lodestone.learning.collecting import collect, no_decisions, start_actors
from lodestone.learning.loop import Algorithm, RoundLog, log_round
from lodestone.learning.networks import NetworkConfig, QNetwork, init_q_network
from lodestone.learning.policies import epsilon_greedy
from lodestone.learning.replay import Replay, add, empty_replay, sample
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.learning.targets import semi_markov_loss
from lodestone.learning.updates import run_updates
from lodestone.options.base import Options
from lodestone.options.execution import Actor, Rules
from lodestone.types import State, Transition


@dataclass(frozen=True)
class DQNConfig:
    """Settings of the learner. Lengths are in decisions unless they say otherwise."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Shape of the Q-network."""
    double: bool = True
    """Whether the online network picks the option that the target network values (double Q-learning)."""
    learning_rate: Knots = ((0.0, 1e-3), (0.6, 1e-3), (1.0, 1e-4))
    """Adam's step size over the run."""
    adam_epsilon: float = 1e-4
    """Adam's constant under the fraction."""
    max_gradient_norm: float = 10.0
    """Every weight and bias array's gradient is scaled down to this norm."""
    batch_size: int = 32
    """Transitions per update; the loss is their summed Huber loss."""
    huber_delta: float = 1.0
    """Scaled error up to which the loss is quadratic, and beyond which it is linear."""
    replay_capacity: int = 1_000_000
    """Transitions kept; no more memory is taken than the run can fill."""
    learning_starts: int = 1000
    """Decisions before the first update."""
    target_period: int = 200
    """Updates between two copies of the network to the target network."""
    epsilon: Knots = ((0.0, 1.0), (0.2, 0.2), (0.8, 0.02))
    """Probability of a random option over the run."""
    environments: int = 8
    """Copies of the environment that one seed runs side by side."""
    decisions_per_round: int = 8
    """Decisions between two rounds of updates."""
    updates_per_round: int = 8
    """Updates after each round of decisions."""
    reward_scale: float = 1.0
    """Factor on rewards inside the learner; values near 10 are learned fastest."""

    def rounds(self, decisions: int) -> int:
        """How many rounds take at least `decisions` decisions."""
        return -(-decisions // self.decisions_per_round)

    def __post_init__(self) -> None:
        check_knots("learning_rate", self.learning_rate, 0.0, 1.0)
        check_knots("epsilon", self.epsilon, 0.0, 1.0)
        for name in (
            "batch_size",
            "replay_capacity",
            "target_period",
            "environments",
            "decisions_per_round",
            "updates_per_round",
        ):
            if getattr(self, name) < 1:
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be at least 1.")
        if self.learning_starts < 0:
            raise InvalidConfig(f"learning_starts is {self.learning_starts}, but must not be negative.")
        for name in ("adam_epsilon", "huber_delta", "max_gradient_norm", "reward_scale"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be a positive number.")
        if self.decisions_per_round + self.environments - 1 > self.replay_capacity:
            raise InvalidConfig("replay_capacity must hold at least one round of decisions.")


class Learner(NamedTuple):
    """What is learned, and from what."""

    network: QNetwork
    target: QNetwork
    adam: optax.ScaleByAdamState
    replay: Replay


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    learner: Learner
    actors: Actor
    surplus: Int[Array, ""]
    """Decisions that the last round took beyond its quota; the next round takes so many fewer."""
    key: PRNGKeyArray


def loss(config: DQNConfig, network: QNetwork, target: QNetwork, batch: Transition) -> Float[Array, ""]:
    """Huber loss, summed over the batch, of Q(s, o) against the semi-Markov target."""
    scaled = batch._replace(reward=batch.reward * config.reward_scale)
    return semi_markov_loss(network, target, scaled, config.double, config.huber_delta)


def update(
    config: DQNConfig,
    environment: Environment,
    learner: Learner,
    bits: UInt32[Array, " B"],
    learning_rate: Float[Array, ""],
) -> tuple[Learner, Float[Array, ""]]:
    """One gradient step on one batch, drawn by random bits; the target network stays.

    Returns the mean loss per transition, too.
    """
    batch = sample(learner.replay, bits)
    observe = jax.vmap(environment.observe)
    batch = batch._replace(obs=observe(batch.obs), next_obs=observe(batch.next_obs))
    value, gradient = jax.value_and_grad(partial(loss, config))(learner.network, learner.target, batch)
    network, adam = adam_step(
        learner.network, gradient, learner.adam, learning_rate, config.adam_epsilon, config.max_gradient_norm
    )
    return learner._replace(network=network, adam=adam), value / config.batch_size


def option_values(network: QNetwork, environment: Environment, state: State) -> Float[Array, " O"]:
    """Q(s, .), in units of the scaled reward."""
    return network(environment.observe(state))


def dqn(config: DQNConfig, environment: Environment, options: Options, rules: Rules, decisions: int) -> Algorithm:
    """The algorithm for the training loop.

    `decisions`, the run's length, is what schedules are fractions of; it bounds the replay's memory, too.
    """
    slots = config.decisions_per_round + config.environments - 1
    capacity = max(slots, min(config.replay_capacity, decisions + slots))
    first_learning_round = config.learning_starts // config.decisions_per_round

    def init(key: PRNGKeyArray) -> Carry:
        network_key, actor_key, key = jax.random.split(key, 3)
        network = init_q_network(config.network, observation_shape(environment), options.size, network_key)
        example = jax.tree.map(lambda leaf: leaf[0], no_decisions(environment, options, 1).transition)
        learner = Learner(
            network=network,
            target=network,
            adam=start_adam(network),
            replay=empty_replay(example, capacity),
        )
        return Carry(learner, start_actors(environment, actor_key, config.environments), jnp.int32(0), key)

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        collect_key, update_key, key = jax.random.split(carry.key, 3)
        fraction = number.astype(jnp.float32) * (config.decisions_per_round / decisions)
        epsilon = piecewise_linear(config.epsilon, fraction)
        learning_rate = piecewise_linear(config.learning_rate, fraction)
        learner = carry.learner

        def choose(uniform: Float[Array, "N 2"], states: State) -> Int[Array, " N"]:
            values = jax.vmap(option_values, in_axes=(None, None, 0))(learner.network, environment, states)
            available = jax.vmap(options.initiation)(states)
            return jax.vmap(epsilon_greedy, in_axes=(0, 0, 0, None))(uniform, values, available, epsilon)

        quota = config.decisions_per_round - carry.surplus
        actors, taken = collect(environment, options, rules, collect_key, carry.actors, choose, quota, slots)
        surplus = jnp.sum(taken.valid) - quota
        learner = learner._replace(replay=add(learner.replay, taken.transition, taken.valid))

        bits = jax.random.bits(update_key, (config.updates_per_round, config.batch_size))
        learner, losses = run_updates(
            learner,
            lambda learner, index: update(config, environment, learner, bits[index], learning_rate),
            number - first_learning_round,
            config.updates_per_round,
            config.target_period,
        )
        log = log_round(taken, jnp.mean(losses))
        return Carry(learner, actors, surplus, key), log

    return Algorithm(init, run_round)
