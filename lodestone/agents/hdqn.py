"""h-DQN (Kulkarni et al. 2016): a meta-controller chooses goals, a controller reaches them, a critic pays it for that.

A goal is a task: where it holds the pursuit is over, and the task's reward is the critic's. Each level has its replay.

    controller, from every step:   Q1(s, a; g) <- r_g + gamma (1 - done_g) max over a' of Q1(s', a'; g)
    meta-controller, every goal:   Q2(s, g)    <- F + gamma^k max over available g' of Q2(s', g')

done_g is that the goal holds in s', or the environment ends there; F is the environment's discounted reward over the k
steps of the pursuit, the last one included, and s the state where the goal was chosen. So a goal is an option whose
policy is learned, and the meta-controller is a learner over options like any other.

In the first part of the run goals are drawn at random and the controller alone learns; then both do. How much a goal's
pursuit explores falls with the run, or sooner where the goal is reached.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from lodestone.envs.base import Environment, allowed_actions, example_state, observation_shape, remembered
from lodestone.envs.task import Task
from lodestone.errors import InvalidConfig, check_name
from lodestone.learning.adam import adam_step, start_adam
from lodestone.learning.collecting import no_decisions, start_actors, tick_all
from lodestone.learning.goal_network import GoalNetwork, GoalOptions, init_goal_network
from lodestone.learning.loop import Algorithm, RoundLog, log_round
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.policies import epsilon_greedy
from lodestone.learning.replay import Replay, add, empty_replay, sample
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.learning.targets import Values, semi_markov_loss
from lodestone.learning.united_network import Shared
from lodestone.learning.updates import run_updates
from lodestone.options.base import NO_CAP
from lodestone.options.execution import Actor, Decision, Rules
from lodestone.types import State, Transition


@dataclass(frozen=True)
class HDQNConfig:
    """Settings of the learner. Lengths are in primitive steps, unless they say otherwise."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Shape of every head together with what lies below it. Without any layers, on one-hot observations: tables."""
    shared: Shared = "nothing"
    """What the meta-controller and the controller's goals share; `nothing` makes each a network of its own."""
    max_goal_steps: int | None = 50
    """Steps after which a goal is given up; None for never, as in the paper."""
    repeat_goals: bool = True
    """Whether a goal that was given up may be chosen again at once. False is the authors' memory; a goal that was
    reached cannot be chosen where it holds anyway."""
    controller_first: float = 0.2
    """Part of the run, from 0 to 1, in which goals are random and the controller alone learns."""
    double: bool = True
    """Whether the online network picks what the target network values (double Q-learning)."""
    learning_rate: Knots = ((0.0, 1e-3), (0.6, 1e-3), (1.0, 1e-5))
    """Adam's step size over the run."""
    adam_epsilon: float = 1e-4
    """Adam's constant under the fraction."""
    max_gradient_norm: float = 1000.0
    """Every weight and bias array's gradient is scaled down to this norm."""
    batch_size: int = 32
    """Steps, and goals, per update; the loss is the summed Huber loss of both."""
    huber_delta: float = 20.0
    """Scaled error up to which the losses are quadratic, and beyond which they are linear."""
    replay_capacity: int = 1_000_000
    """Steps that are remembered; no more memory is taken than the run can fill."""
    goal_replay_capacity: int = 50_000
    """Pursuits of goals that are remembered: the older, the less they are what the controller does now."""
    learning_starts: int = 1000
    """Steps before the first update."""
    target_period: int = 200
    """Updates between two copies of the network to the target network."""
    epsilon: Knots = ((0.0, 1.0), (0.5, 0.1))
    """Over the run, the probability of a random action under a goal that is never reached. A goal that is reached has
    the probability with which it is not, if that is smaller, but never less than the last value here."""
    success_window: int = 100
    """Pursuits of each goal by which its success is judged."""
    goal_epsilon: Knots = ((0.0, 1.0), (0.5, 0.1))
    """Probability of a random goal over the part of the run in which both levels learn."""
    environments: int = 8
    """Copies of the environment that one seed runs side by side."""
    ticks_per_round: int = 2
    """Steps of every environment between two rounds of updates."""
    updates_per_round: int = 8
    """Updates after each round."""
    reward_scale: float = 1.0
    """Factor on the environment's rewards inside the learner; values near 10 are learned fastest."""
    critic_scale: float = 10.0
    """Factor on the critic's rewards."""

    @property
    def goal_cap(self) -> int:
        """`max_goal_steps` as options have it."""
        return NO_CAP if self.max_goal_steps is None else self.max_goal_steps

    @property
    def steps_per_round(self) -> int:
        """Of all environments."""
        return self.ticks_per_round * self.environments

    def rounds(self, steps: int) -> int:
        """How many rounds take at least `steps` steps."""
        return -(-steps // self.steps_per_round)

    def __post_init__(self) -> None:
        check_name("part to share", self.shared, get_args(Shared))
        for name in ("learning_rate", "epsilon", "goal_epsilon"):
            check_knots(name, getattr(self, name), 0.0, 1.0)
        for name in (
            "batch_size",
            "replay_capacity",
            "goal_replay_capacity",
            "target_period",
            "success_window",
            "environments",
            "ticks_per_round",
            "updates_per_round",
        ):
            if getattr(self, name) < 1:
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be at least 1.")
        if self.goal_cap < 1:
            raise InvalidConfig(f"max_goal_steps is {self.max_goal_steps}, but must be at least 1.")
        if self.learning_starts < 0:
            raise InvalidConfig(f"learning_starts is {self.learning_starts}, but must not be negative.")
        if not 0 <= self.controller_first <= 1:
            raise InvalidConfig(f"controller_first is {self.controller_first}, but must be from 0 to 1.")
        for name in ("adam_epsilon", "huber_delta", "max_gradient_norm", "reward_scale", "critic_scale"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be a positive number.")
        for name in ("replay_capacity", "goal_replay_capacity", "success_window"):
            if getattr(self, name) < self.steps_per_round:
                raise InvalidConfig(f"{name} must hold at least one round of {self.steps_per_round} steps.")


class Pursued(NamedTuple):
    """One primitive step under a goal. What the critic pays for it, and whether it ends the pursuit, the goal says."""

    state: State
    goal: Int[Array, "*batch"]
    action: Int[Array, "*batch"]
    next_state: State


class Learner(NamedTuple):
    """What is learned, and from what."""

    network: GoalNetwork
    target: GoalNetwork
    adam: optax.ScaleByAdamState
    steps: Replay[Pursued]
    """The controller's."""
    pursuits: Replay[Transition]
    """The meta-controller's: from the state where a goal was chosen to the one where its pursuit ended."""


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    learner: Learner
    actors: Actor
    outcomes: Replay[Bool[Array, ""]]
    """Whether the last pursuits of each goal reached it; leaves have a leading axis of G goals."""
    key: PRNGKeyArray


def exploration(knots: Knots, fraction: Float[Array, ""], outcomes: Replay[Bool[Array, ""]]) -> Float[Array, " G"]:
    """Probability of a random action under each goal, after a fraction of the run and the last pursuits' outcomes."""
    reached = jnp.sum(outcomes.storage, axis=1, dtype=jnp.float32)
    failure = 1 - reached / jnp.maximum(outcomes.size, 1).astype(jnp.float32)
    return jnp.minimum(piecewise_linear(knots, fraction), jnp.maximum(failure, knots[-1][1]))


def without_repeat(available: Bool[Array, " G"], last: Int[Array, ""]) -> Bool[Array, " G"]:
    """The available goals but the last one, unless it is the only one."""
    others = available & (jnp.arange(available.size) != last)
    return jnp.where(jnp.any(others), others, available)


def controller_batch(
    environment: Environment, goals: Sequence[Task], discount: float, scale: float, steps: Pursued
) -> Transition:
    """What B steps under goals teach the controller; an observation comes with the goal's number."""

    def one(step: Pursued) -> Transition:
        rewards = jnp.stack([goal.reward(step.state, step.action, step.next_state) for goal in goals])
        holds = jnp.stack([goal.terminal(step.next_state) for goal in goals])
        done = holds[step.goal] | environment.terminal(step.next_state)
        return Transition(
            obs=(environment.observe(step.state), step.goal),
            action=step.action,
            reward=scale * rewards[step.goal],
            discount=jnp.where(done, 0.0, discount),
            next_obs=(environment.observe(step.next_state), step.goal),
            next_available=allowed_actions(environment, step.next_state),
        )

    return jax.vmap(one)(steps)


def loss(
    config: HDQNConfig,
    environment: Environment,
    goals: Sequence[Task],
    discount: float,
    network: GoalNetwork,
    target: GoalNetwork,
    steps: Pursued,
    pursuits: Transition,
    both: Bool[Array, ""],
) -> Float[Array, ""]:
    """The controller's loss over B steps and, where `both` learn, the meta-controller's over B pursuits."""

    def under_goal(one: GoalNetwork) -> Values:
        return lambda seen: one.action_values(seen[0])[seen[1]]

    of_level = partial(semi_markov_loss, double=config.double, huber_delta=config.huber_delta)
    taught = controller_batch(environment, goals, discount, config.critic_scale, steps)
    of_controller = of_level(under_goal(network), under_goal(target), taught)

    observe = jax.vmap(environment.observe)
    pursuits = pursuits._replace(
        obs=observe(pursuits.obs), next_obs=observe(pursuits.next_obs), reward=config.reward_scale * pursuits.reward
    )
    of_meta = of_level(network.goal_values, target.goal_values, pursuits)
    return of_controller + jnp.where(both, of_meta, 0.0)


def update(
    config: HDQNConfig,
    environment: Environment,
    goals: Sequence[Task],
    discount: float,
    learner: Learner,
    bits: UInt32[Array, "2 B"],
    learning_rate: Float[Array, ""],
    both: Bool[Array, ""],
) -> tuple[Learner, Float[Array, ""]]:
    """One gradient step on a batch of steps and one of pursuits, drawn by random bits; the target network stays.

    Returns the loss per item of a batch, too.
    """
    steps, pursuits = sample(learner.steps, bits[0]), sample(learner.pursuits, bits[1])
    value, gradient = jax.value_and_grad(partial(loss, config, environment, goals, discount))(
        learner.network, learner.target, steps, pursuits, both & (learner.pursuits.size > 0)
    )
    network, adam = adam_step(
        learner.network, gradient, learner.adam, learning_rate, config.adam_epsilon, config.max_gradient_norm
    )
    return learner._replace(network=network, adam=adam), value / config.batch_size


def hdqn(config: HDQNConfig, environment: Environment, goals: Sequence[Task], rules: Rules, steps: int) -> Algorithm:
    """The algorithm for the training loop: every goal is a task on `environment`.

    `steps`, the run's length, is what schedules are fractions of; it bounds the replays' memory, too.
    """
    goals = tuple(goals)
    rounds = config.rounds(steps)
    most = rounds * config.steps_per_round
    first_joint_round = round(config.controller_first * rounds)
    first_learning_round = config.rounds(config.learning_starts)

    def init(key: PRNGKeyArray) -> Carry:
        network_key, actor_key, key = jax.random.split(key, 3)
        state = remembered(environment, example_state(environment))
        seen, actions = observation_shape(environment), environment.num_actions
        network = init_goal_network(config.network, config.shared, seen, actions, len(goals), network_key)
        as_options = GoalOptions(goals, network, jnp.zeros(len(goals)), config.goal_cap)
        pursuit = jax.tree.map(lambda leaf: leaf[0], no_decisions(environment, as_options, 1).transition)
        step = Pursued(state, jnp.int32(0), jnp.int32(0), state)
        learner = Learner(
            network=network,
            target=network,
            adam=start_adam(network),
            steps=empty_replay(step, min(config.replay_capacity, most)),
            pursuits=empty_replay(pursuit, min(config.goal_replay_capacity, most)),
        )
        nothing = empty_replay(jnp.bool_(False), config.success_window)
        outcomes = jax.tree.map(lambda leaf: jnp.stack([leaf] * len(goals)), nothing)
        return Carry(learner, start_actors(environment, actor_key, config.environments), outcomes, key)

    def collect(
        key: PRNGKeyArray, actors: Actor, options: GoalOptions, goal_epsilon: Float[Array, ""]
    ) -> tuple[Actor, Decision, Pursued]:
        """The round's ticks: what they settled, and every step, in order of time."""

        def step(actors: Actor, tick_key: PRNGKeyArray) -> tuple[Actor, tuple[Decision, Pursued]]:
            def choose(uniform: Float[Array, "N 2"], states: State) -> Int[Array, " N"]:
                values = jax.vmap(lambda state: options.network.goal_values(environment.observe(state)))(states)
                available = jax.vmap(options.initiation)(states)
                if not config.repeat_goals:
                    begins = (actors.episode_steps == 0)[:, None]
                    available = jnp.where(begins, available, jax.vmap(without_repeat)(available, actors.option))
                return jax.vmap(epsilon_greedy, in_axes=(0, 0, 0, None))(uniform, values, available, goal_epsilon)

            after, decisions = tick_all(environment, options, rules, tick_key, actors, choose)
            moved = decisions.transition
            if not config.repeat_goals:
                allowed = jax.vmap(without_repeat)(moved.next_available, moved.action)
                decisions = decisions._replace(transition=moved._replace(next_available=allowed))
            before = jax.vmap(partial(remembered, environment))(actors.state)
            return after, (decisions, Pursued(before, moved.action, decisions.action, moved.next_obs))

        actors, brought = jax.lax.scan(step, actors, jax.random.split(key, config.ticks_per_round))
        decisions, pursued = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), brought)
        return actors, decisions, pursued

    def remember(outcomes: Replay, options: GoalOptions, decisions: Decision) -> Replay:
        """The outcomes with those of the pursuits that ended."""
        chosen = decisions.transition.action
        holds = jax.vmap(options.termination)(decisions.transition.next_obs) > 0.5
        reached = jnp.take_along_axis(holds, chosen[:, None], axis=1)[:, 0]
        of_goal = decisions.valid[None] & (chosen[None] == jnp.arange(len(goals), dtype=jnp.int32)[:, None])
        return jax.vmap(add, in_axes=(0, None, 0))(outcomes, reached, of_goal)

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        collect_key, update_key, key = jax.random.split(carry.key, 3)
        fraction = number.astype(jnp.float32) / rounds
        jointly = (number - first_joint_round).astype(jnp.float32) / max(1, rounds - first_joint_round)
        both = number >= first_joint_round
        goal_epsilon = jnp.where(both, piecewise_linear(config.goal_epsilon, jointly), 1.0)
        learning_rate = piecewise_linear(config.learning_rate, fraction)
        learner = carry.learner
        options = GoalOptions(
            goals, learner.network, exploration(config.epsilon, fraction, carry.outcomes), config.goal_cap
        )
        actors, decisions, pursued = collect(collect_key, carry.actors, options, goal_epsilon)
        learner = learner._replace(
            steps=add(learner.steps, pursued, jnp.ones(config.steps_per_round, dtype=bool)),
            pursuits=add(learner.pursuits, decisions.transition, decisions.valid),
        )

        bits = jax.random.bits(update_key, (config.updates_per_round, 2, config.batch_size))

        def learn(learner: Learner, index: Int[Array, ""]) -> tuple[Learner, Float[Array, ""]]:
            return update(config, environment, goals, rules.discount, learner, bits[index], learning_rate, both)

        learner, losses = run_updates(
            learner, learn, number - first_learning_round, config.updates_per_round, config.target_period
        )
        log = log_round(decisions, jnp.mean(losses))
        return Carry(learner, actors, remember(carry.outcomes, options, decisions), key), log

    return Algorithm(init, run_round)
