"""Taking decisions in N environments of one seed until a quota is met."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lodestone.envs.base import Environment, OutsideEnvironment, example_state, remembered
from lodestone.options.base import Options
from lodestone.options.execution import Actor, Decision, Rules, draw_chance, start_actor, tick
from lodestone.types import State, Transition

Choose = Callable[[Float[Array, "N 2"], State], Int[Array, " N"]]
"""choose(uniform numbers, states [N, ...]) -> an option for each environment; ignored where one is still running."""


def start_actors(environment: Environment, key: PRNGKeyArray, count: int) -> Actor:
    """N actors, each at the beginning of an episode."""
    return jax.vmap(start_actor, in_axes=(None, 0))(environment, jax.random.split(key, count))


def tick_all(
    environment: Environment, options: Options, rules: Rules, key: PRNGKeyArray, actors: Actor, choose: Choose
) -> tuple[Actor, Decision]:
    """One primitive step in each of N environments."""
    count = actors.option.shape[0]
    keys = jax.random.split(key, count + 1)
    choices = choose(jax.random.uniform(keys[count], (count, 2)), actors.state)
    chance = jax.vmap(draw_chance)(keys[:count])
    return jax.vmap(tick, in_axes=(None, None, None, 0, 0, 0))(environment, options, rules, chance, actors, choices)


def collect(
    environment: Environment,
    options: Options,
    rules: Rules,
    key: PRNGKeyArray,
    actors: Actor,
    choose: Choose,
    quota: Int[Array, ""],
    capacity: int,
) -> tuple[Actor, Decision]:
    """Tick until `quota` decisions have ended; returns [capacity] decisions, the first ones valid.

    Several options may end on the last tick, so `capacity` must be at least quota + N - 1. The decisions wait here,
    outside the replay, because a vmapped loop copies everything it carries whenever one seed is done before another.
    """

    def unfinished(carry: tuple) -> Array:
        _, _, count, _ = carry
        return count < quota

    def step(carry: tuple) -> tuple:
        actors, waiting, count, ticks = carry
        tick_key = jax.random.fold_in(key, ticks)
        if isinstance(environment, OutsideEnvironment):  # where seeds are vmapped, this runs until the last is done
            held = jax.vmap(environment.hold, in_axes=(0, None))(actors.state, ~unfinished(carry))
            actors = actors._replace(state=held)
        actors, decisions = tick_all(environment, options, rules, tick_key, actors, choose)
        rank = jnp.cumsum(decisions.valid.astype(jnp.int32)) + count
        slot = jnp.where(decisions.valid, rank - 1, capacity)  # out of range: dropped
        waiting = jax.tree.map(lambda old, new: old.at[slot].set(new, mode="drop"), waiting, decisions)
        return actors, waiting, rank[-1], ticks + 1

    waiting = no_decisions(environment, options, capacity)
    start = (actors, waiting, jnp.int32(0), jnp.int32(0))
    actors, waiting, _, _ = jax.lax.while_loop(unfinished, step, start)
    return actors, waiting


def no_decisions(environment: Environment, options: Options, capacity: int) -> Decision:
    """[capacity] decisions, none of them valid."""
    state = remembered(environment, example_state(environment))
    zero, real = jnp.int32(0), jnp.float32(0)
    available = jnp.zeros(options.size, dtype=bool)
    example = Decision(
        valid=jnp.bool_(False),
        action=zero,
        transition=Transition(state, zero, real, real, state, available),
        steps=zero,
        episode_ended=jnp.bool_(False),
        terminated=jnp.bool_(False),
        episode_return=real,
        episode_steps=zero,
        episode_decisions=zero,
    )
    return jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape), leaf.dtype), example)
