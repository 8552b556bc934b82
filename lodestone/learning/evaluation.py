"""Playing episodes with a fixed policy over options, greedily or as given."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lodestone.envs.base import Environment
from lodestone.learning.policies import greedy
from lodestone.options.base import Options
from lodestone.options.execution import Actor, Rules, draw_chance, start_actor, tick
from lodestone.types import State

Values = Callable[[State], Float[Array, " O"]]
"""values(state) -> Q(s, .), whose best available option is played."""


class Episode(NamedTuple):
    """How one episode went."""

    total_reward: Float[Array, ""]
    """The return: undiscounted sum of rewards."""
    steps: Int[Array, ""]
    decisions: Int[Array, ""]
    success: Bool[Array, ""]
    """Whether the environment ended it, rather than a limit."""


class Trace(NamedTuple):
    """An episode tick by tick; entries after its end repeat nothing meaningful (`live` is false)."""

    live: Bool[Array, " T"]
    state: State
    """Before each step."""
    next_state: State
    """After each step, the last one of the episode included."""
    option: Int[Array, " T"]
    chosen: Bool[Array, " T"]
    """Whether the option was chosen at this step rather than continued."""
    action: Int[Array, " T"]
    """The primitive action taken."""
    values: Float[Array, "T O"]
    available: Bool[Array, "T O"]
    reward: Float[Array, " T"]
    """The step's primitive reward."""
    termination: Float[Array, "T O"]
    """Probability that each option, had it run until the state before the step, would stop there."""


def play_episode(
    environment: Environment, options: Options, rules: Rules, values: Values, key: PRNGKeyArray, max_steps: int
) -> Episode:
    """One greedy episode, of at most `max_steps` primitive steps."""

    def unfinished(carry: tuple) -> Array:
        _, _, episode, over = carry
        return ~over & (episode.steps < max_steps)

    def step(carry: tuple) -> tuple:
        key, actor, _, _ = carry
        key, tick_key = jax.random.split(key)
        choice = greedy(values(actor.state), options.initiation(actor.state))
        actor, decision = tick(environment, options, rules, draw_chance(tick_key), actor, choice)
        episode = Episode(
            decision.episode_return, decision.episode_steps, decision.episode_decisions, decision.terminated
        )
        return key, actor, episode, decision.episode_ended

    start_key, key = jax.random.split(key)
    actor = start_actor(environment, start_key)
    nothing = Episode(jnp.float32(0), jnp.int32(0), jnp.int32(0), jnp.bool_(False))
    return jax.lax.while_loop(unfinished, step, (key, actor, nothing, jnp.bool_(False)))[2]


def trace_episode(
    environment: Environment, options: Options, rules: Rules, values: Values, key: PRNGKeyArray, max_steps: int
) -> Trace:
    """One greedy episode, remembered step by step."""

    def step(carry: tuple[Actor, Array, Array], _: None) -> tuple[tuple[Actor, Array, Array], Trace]:
        actor, live, key = carry
        key, tick_key = jax.random.split(key)
        state_values, available = values(actor.state), options.initiation(actor.state)
        next_actor, decision = tick(
            environment, options, rules, draw_chance(tick_key), actor, greedy(state_values, available)
        )
        trace = Trace(
            live=live,
            state=actor.state,
            next_state=decision.transition.next_obs,
            option=decision.transition.action,
            chosen=actor.deciding,
            action=decision.action,
            values=state_values,
            available=available,
            reward=decision.episode_return - actor.episode_return,
            termination=options.termination(actor.state),
        )
        return (next_actor, live & ~decision.episode_ended, key), trace

    start_key, key = jax.random.split(key)
    carry = (start_actor(environment, start_key), jnp.bool_(True), key)
    return jax.lax.scan(step, carry, None, length=max_steps)[1]
