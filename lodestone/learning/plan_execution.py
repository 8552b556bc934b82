"""Acting by plans, in the same lock-step time as options: a plan runs as an option until the next plan is made.

Whether the next step plans anew is drawn before that step is seen, so the draw is the option's termination.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lodestone.envs.base import Environment, allowed_actions
from lodestone.learning.evaluation import Episode
from lodestone.learning.plan_network import Plan, PlanNetwork
from lodestone.learning.policies import greedy
from lodestone.options.base import NO_CAP, Options
from lodestone.options.execution import Actor, Chance, Decision, Rules, draw_chance, start_actor, tick
from lodestone.types import State

NEXT_PLAN = 0.5
"""The probability from which on a greedy policy plans anew."""


class Planned(Options):
    """What a plan says of one step, as a set of one option."""

    probs: Float[Array, " A"]
    """Of the step's action."""
    ends: Float[Array, ""]
    """Probability that the next step plans anew."""

    @property
    def names(self) -> tuple[str, ...]:
        return ("plan",)

    @property
    def max_steps(self) -> tuple[int, ...]:
        return (NO_CAP,)

    def initiation(self, state: State) -> Bool[Array, " 1"]:
        del state
        return jnp.ones(1, dtype=bool)

    def action_probs(self, state: State) -> Float[Array, "1 A"]:
        del state
        return self.probs[None]

    def termination(self, state: State) -> Float[Array, " 1"]:
        del state
        return self.ends[None]


class PlanningActor(NamedTuple):
    """One environment that plans are carried out in."""

    actor: Actor
    plan: Plan
    """As the last step left it."""


def start_planning(environment: Environment, network: PlanNetwork, key: PRNGKeyArray) -> PlanningActor:
    """At the beginning of the first episode."""
    return PlanningActor(start_actor(environment, key), network.start())


def plan_tick(
    environment: Environment,
    rules: Rules,
    network: PlanNetwork,
    chance: Chance,
    planning: PlanningActor,
    options: Planned,
    plan: Plan,
) -> tuple[PlanningActor, Decision]:
    """One primitive step by `options`, which is what `plan` says of it. A decision is a plan that has been carried out:
    it is valid where the next step plans anew, or the episode ended."""
    actor, decision = tick(environment, options, rules, chance, planning.actor, jnp.int32(0))
    over = decision.episode_ended
    fresh = jax.tree.map(lambda new, old: jnp.where(over, new, old), network.start(), plan)
    return PlanningActor(actor, fresh), decision


class PlanTrace(NamedTuple):
    """An episode by plans, step by step; entries after its end mean nothing."""

    state: State
    """Before each step."""
    next_state: State
    """After each step, the last one of the episode included."""
    anew: Bool[Array, " L"]
    """Whether the step planned anew."""
    before: Float[Array, " L"]
    """Probability with which it did."""
    action: Int[Array, " L"]
    reward: Float[Array, " L"]
    plan: Plan
    """As the step found or made it."""


def greedy_tick(
    environment: Environment, rules: Rules, network: PlanNetwork, key: PRNGKeyArray, planning: PlanningActor
) -> tuple[PlanningActor, Decision, PlanTrace]:
    """The likelier of both where it says whether to plan anew, the likeliest action, and no noise."""
    state, before = planning.actor.state, planning.plan.commitment[0]
    anew = planning.actor.deciding
    plan = network.act(environment.observe(state), planning.plan, anew, jnp.zeros(network.noise_size), jnp.float32(1))
    best = jax.nn.one_hot(greedy(plan.logits[:-1, 0], allowed_actions(environment, state)), environment.num_actions)
    options = Planned(best, (plan.commitment[0] >= NEXT_PLAN).astype(jnp.float32))
    after, decision = plan_tick(environment, rules, network, draw_chance(key), planning, options, plan)
    reward = decision.episode_return - planning.actor.episode_return
    trace = PlanTrace(state, decision.transition.next_obs, anew, before, decision.action, reward, plan)
    return after, decision, trace


def play_plans(
    environment: Environment, rules: Rules, network: PlanNetwork, key: PRNGKeyArray, max_steps: int
) -> Episode:
    """One greedy episode, of at most `max_steps` primitive steps; its decisions are its plans."""
    start_key, key = jax.random.split(key)
    return play_on(environment, rules, network, key, start_planning(environment, network, start_key), max_steps)


def play_on(
    environment: Environment,
    rules: Rules,
    network: PlanNetwork,
    key: PRNGKeyArray,
    planning: PlanningActor,
    max_steps: int,
) -> Episode:
    """The same from where an actor is."""

    def unfinished(carry: tuple) -> Array:
        _, _, episode, over = carry
        return ~over & (episode.steps < max_steps)

    def step(carry: tuple) -> tuple:
        key, planning, _, _ = carry
        key, tick_key = jax.random.split(key)
        planning, decision, _ = greedy_tick(environment, rules, network, tick_key, planning)
        episode = Episode(
            decision.episode_return, decision.episode_steps, decision.episode_decisions, decision.terminated
        )
        return key, planning, episode, decision.episode_ended

    nothing = Episode(jnp.float32(0), jnp.int32(0), jnp.int32(0), jnp.bool_(False))
    return jax.lax.while_loop(unfinished, step, (key, planning, nothing, jnp.bool_(False)))[2]


def trace_plans(
    environment: Environment, rules: Rules, network: PlanNetwork, key: PRNGKeyArray, max_steps: int
) -> PlanTrace:
    """The same episode, remembered step by step."""

    def step(carry: tuple[PlanningActor, Array], nothing: None) -> tuple[tuple[PlanningActor, Array], PlanTrace]:
        planning, key = carry
        key, tick_key = jax.random.split(key)
        after, _, trace = greedy_tick(environment, rules, network, tick_key, planning)
        return (after, key), trace

    start_key, key = jax.random.split(key)
    carry = (start_planning(environment, network, start_key), key)
    return jax.lax.scan(step, carry, None, length=max_steps)[1]
