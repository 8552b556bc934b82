"""STRAW and STRAWe (Vezhnevets et al. 2016): plans of many steps, and when to make the next, by an actor-critic.

A plan has the logits of the actions, and the value, of this step and of those to come; carried out until the commitment
says so, it is an option of its own. `learning.plans` has the mathematics, `learning.plan_network` the network. Every
round N environments take L steps each, and then one gradient step is taken on the mean over these N L steps of

    L_t = - log pi(a_t) Adv_t - eta H(pi) + (weight / 2) (G_t - V_t)^2 + alpha g_t KL_t + lambda c^t[0]

where pi = softmax(A^t[:, 0]) over the actions that are allowed, V_t is the last row of the same column, g_t says
whether step t planned anew, KL_t is the divergence of STRAWe's noisy code, c^t[0] the probability of planning anew at
the next step, and G_t the lambda-return. Adv_t is G_t - V_t without a gradient. The gradient runs back through the
plans of the L steps to the round's first one, which is taken as it was left. The draws of g_t are those of the steps
that were taken, and pass the gradient straight through.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lodestone.envs.base import Environment, allowed_actions, observation_shape
from lodestone.errors import InvalidConfig
from lodestone.learning.adam import adam_step, start_adam
from lodestone.learning.loop import Algorithm, RoundLog, log_round
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.plan_execution import Planned, PlanningActor, plan_tick, start_planning
from lodestone.learning.plan_network import Plan, PlanConfig, PlanNetwork, init_plan_network
from lodestone.learning.plans import shift
from lodestone.learning.policies import forbid
from lodestone.learning.returns import lambda_returns
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.options.execution import REWARD_SWITCHES, Chance, Decision, Rules
from lodestone.types import Observation


@dataclass(frozen=True)
class StrawConfig:
    """Settings of the learner. Lengths are in primitive steps."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Shape of what plans are made from: the last hidden layer is the features, and as wide as the code."""
    plan: PlanConfig = field(default_factory=PlanConfig)
    """Shape of the plans."""
    commitment_cost: Knots = ((0.0, 0.0), (0.5, 0.0), (0.7, 0.06))
    """lambda over the run: cost of the probability of planning anew, in scaled reward. What is done is learned first,
    and then to do it with few plans."""
    noise_cost: float = 0.001
    """alpha: cost of the divergence of a noisy code; of no meaning without noise."""
    entropy: Knots = ((0.0, 0.006), (1.0, 0.0))
    """eta over the run, beside scaled rewards."""
    value_weight: float = 1.0
    """Weight of the squared error of the values."""
    decay: float = 0.95
    """lambda of the returns: 0 looks one step ahead, 1 to the end of the round or of the episode."""
    sharpness: Knots = ((0.0, 0.3), (0.75, 0.3), (0.95, 1.0))
    """Over the run, factor on the logits of commitments: soft ones try both, and let their gradient through."""
    learning_rate: Knots = ((0.0, 1e-3), (1.0, 1e-4))
    """Adam's step size over the run."""
    adam_epsilon: float = 1e-5
    """Adam's constant under the fraction."""
    max_gradient_norm: float = 0.5
    """Every weight and bias array's gradient is scaled down to this norm."""
    environments: int = 16
    """N, copies of the environment that one seed runs side by side."""
    rollout: int = 16
    """L, steps of every environment between two updates; so far back the gradient runs."""
    reward_scale: float = 1.0
    """Factor on rewards inside the learner; values near 1 are learned fastest. Large ones drive the bounded code to its
    bounds before any reward is found, where all states look the same."""

    @property
    def steps_per_round(self) -> int:
        """Of all environments."""
        return self.rollout * self.environments

    def rounds(self, steps: int) -> int:
        """How many rounds take at least `steps` steps."""
        return -(-steps // self.steps_per_round)

    def __post_init__(self) -> None:
        for name in ("learning_rate", "sharpness"):
            check_knots(name, getattr(self, name), 0.0, 1.0)
        for name in ("entropy", "commitment_cost"):
            check_knots(name, getattr(self, name), 0.0, math.inf)
        for name in ("environments", "rollout"):
            if getattr(self, name) < 1:
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be at least 1.")
        for name in ("noise_cost", "value_weight"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be a number of at least 0.")
        if not 0 <= self.decay <= 1:
            raise InvalidConfig(f"decay is {self.decay}, but must be from 0 to 1.")
        for name in ("adam_epsilon", "max_gradient_norm", "reward_scale"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be a positive number.")


class Taken(NamedTuple):
    """L steps that one environment took, in order."""

    seen: Observation
    allowed: Bool[Array, "L A"]
    anew: Bool[Array, " L"]
    """Whether the step planned anew, as it was drawn."""
    noise: Float[Array, "L D"]
    action: Int[Array, " L"]
    reward: Float[Array, " L"]
    """Scaled."""
    discount: Float[Array, " L"]
    """gamma, or 0 where the environment ended the episode."""
    led_to: Observation
    """What was seen where the step led to, before any restart."""
    cut: Bool[Array, " L"]
    """Whether the episode ended there: the next step begins another one."""


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    network: PlanNetwork
    adam: optax.ScaleByAdamState
    actors: PlanningActor
    """Leaves have a leading axis of N environments."""
    key: PRNGKeyArray


class Told(NamedTuple):
    """What the network says of L steps that were taken."""

    log_prob: Float[Array, " L"]
    """Of the actions."""
    entropy: Float[Array, " L"]
    value: Float[Array, " L"]
    target: Float[Array, " L"]
    """The lambda-return, without a gradient."""
    apart: Float[Array, " L"]
    """Divergence of the noisy code, 0 where no plan was made."""
    commitment: Float[Array, " L"]
    """c^t[0]."""


def value_anew(network: PlanNetwork, sharpness: Float[Array, ""], plan: Plan, seen: Observation) -> Float[Array, ""]:
    """What the step after a plan is worth, by a plan made there: where the story breaks off, no other one follows."""
    added, _, _ = network.renew(network.trunk(seen), plan, jnp.zeros(network.noise_size), sharpness)
    return shift(plan.logits)[-1, 0] + added[-1, 0]


def retell(network: PlanNetwork, sharpness: Float[Array, ""], decay: float, plan: Plan, taken: Taken) -> Told:
    """One environment's L steps once more, to differentiate: with their actions, draws and noise, from the plan that
    the steps before had left."""

    def step(plan: Plan, now: tuple) -> tuple[Plan, tuple[Plan, Array]]:
        features, anew, noise, cut = now
        plan, apart = network.step(features, plan, anew, noise, sharpness)
        left = jax.tree.map(lambda new, old: jnp.where(cut, new, old), network.start(), plan)
        return left, (plan, apart)

    features = jax.vmap(network.trunk)(taken.seen)
    _, (plans, apart) = jax.lax.scan(step, plan, (features, taken.anew, taken.noise, taken.cut))
    columns = plans.logits[:, :, 0]
    value = columns[:, -1]
    onward = jax.vmap(partial(value_anew, network, sharpness))(plans, taken.led_to)
    next_value = jnp.where(taken.cut, onward, jnp.append(value[1:], onward[-1]))
    target = lambda_returns(taken.reward, taken.discount, next_value, taken.cut, decay)
    log_probs = jax.nn.log_softmax(forbid(columns[:, :-1], taken.allowed))
    return Told(
        log_prob=jnp.take_along_axis(log_probs, taken.action[:, None], axis=1)[:, 0],
        entropy=-jnp.sum(jnp.exp(log_probs) * log_probs, axis=1),
        value=value,
        target=jax.lax.stop_gradient(target),
        apart=apart,
        commitment=plans.commitment[:, 0],
    )


def loss(
    config: StrawConfig, entropy: Float[Array, ""], commitment_cost: Float[Array, ""], told: Told
) -> Float[Array, ""]:
    """The mean loss of N L steps, at weights that change over the run."""
    missed = told.target - told.value
    advantage = jax.lax.stop_gradient(missed)
    return jnp.mean(
        -told.log_prob * advantage
        - entropy * told.entropy
        + config.value_weight / 2 * jnp.square(missed)
        + config.noise_cost * told.apart
        + commitment_cost * told.commitment
    )


def collect(
    config: StrawConfig,
    environment: Environment,
    rules: Rules,
    network: PlanNetwork,
    sharpness: Float[Array, ""],
    actors: PlanningActor,
    key: PRNGKeyArray,
) -> tuple[PlanningActor, Decision, Taken]:
    """The round's steps; leaves of decisions and of steps have axes for time and environment."""

    chance_key, noise_key = jax.random.split(key)
    shape = (config.rollout, config.environments)
    chances = Chance(*(jax.random.uniform(chance_key, (len(Chance._fields), *shape))))
    noises = jax.random.normal(noise_key, (*shape, network.noise_size))

    def act(
        planning: PlanningActor, chance: Chance, noise: Float[Array, " D"]
    ) -> tuple[PlanningActor, Decision, Taken]:
        """One step of one environment."""
        state, anew = planning.actor.state, planning.actor.deciding
        seen, allowed = environment.observe(state), allowed_actions(environment, state)
        plan = network.act(seen, planning.plan, anew, noise, sharpness)
        options = Planned(jax.nn.softmax(forbid(plan.logits[:-1, 0], allowed)), plan.commitment[0])
        after, decision = plan_tick(environment, rules, network, chance, planning, options, plan)
        led_to = decision.transition.next_obs
        taken = Taken(
            seen=seen,
            allowed=allowed,
            anew=anew,
            noise=noise,
            action=decision.action,
            reward=config.reward_scale * environment.reward(state, decision.action, led_to),
            discount=jnp.where(decision.terminated, 0.0, rules.discount),
            led_to=environment.observe(led_to),
            cut=decision.episode_ended,
        )
        return after, decision, taken

    def step(
        actors: PlanningActor, drawn: tuple[Chance, Float[Array, "N D"]]
    ) -> tuple[PlanningActor, tuple[Decision, Taken]]:
        actors, decision, taken = jax.vmap(act)(actors, *drawn)
        return actors, (decision, taken)

    actors, (decisions, taken) = jax.lax.scan(step, actors, (chances, noises))
    return actors, decisions, taken


def straw(config: StrawConfig, environment: Environment, rules: Rules, steps: int) -> Algorithm:
    """The algorithm for the training loop. `steps`, the run's length, is what schedules are fractions of.

    Raises `InvalidConfig` for rules under which an option's reward is not the discounted sum of its steps' rewards or a
    limit is an end.
    """
    why = "STRAW takes each step's reward as it comes and a limit for no end"
    rules.refuse((*REWARD_SWITCHES, "bootstrap_at_limit"), why)
    rounds = config.rounds(steps)

    def init(key: PRNGKeyArray) -> Carry:
        network_key, actor_key, key = jax.random.split(key, 3)
        seen, rows = observation_shape(environment), environment.num_actions + 1
        network = init_plan_network(config.network, config.plan, seen, rows, network_key)
        keys = jax.random.split(actor_key, config.environments)
        actors = jax.vmap(partial(start_planning, environment, network))(keys)
        return Carry(network, start_adam(network), actors, key)

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        collect_key, key = jax.random.split(carry.key)
        fraction = number.astype(jnp.float32) / rounds
        sharpness, entropy, commitment_cost, learning_rate = (
            piecewise_linear(knots, fraction)
            for knots in (config.sharpness, config.entropy, config.commitment_cost, config.learning_rate)
        )
        actors, decisions, taken = collect(
            config, environment, rules, carry.network, sharpness, carry.actors, collect_key
        )

        def of_all(network: PlanNetwork) -> Float[Array, ""]:
            one = partial(retell, network, sharpness, config.decay)
            return loss(config, entropy, commitment_cost, jax.vmap(one, in_axes=(0, 1))(carry.actors.plan, taken))

        value, gradient = jax.value_and_grad(of_all)(carry.network)
        network, adam = adam_step(
            carry.network, gradient, carry.adam, learning_rate, config.adam_epsilon, config.max_gradient_norm
        )
        in_order = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), decisions)
        return Carry(network, adam, actors, key), log_round(in_order, value)

    return Algorithm(init, run_round)
