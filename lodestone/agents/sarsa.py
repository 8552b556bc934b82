"""Tabular SARSA on options (Rummery and Niranjan 1994; over options as in Sutton, Precup and Singh 1999).

    Q(s, o) <- Q(s, o) + alpha [ R + gamma^k Q(s', o') - Q(s, o) ]

once per option execution, where o' is the option that is chosen next: it learns what its own choices are worth, the
random ones included. All else is as in `q_learning`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lodestone.agents.q_learning import STEPS_PER_ROUND, between_rows, needed_chance
from lodestone.envs.base import Environment
from lodestone.envs.host import HostEnvironment
from lodestone.learning.loop import Algorithm, RoundLog, log_round
from lodestone.learning.policies import choose
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.options.base import Options
from lodestone.options.execution import Actor, Rules, deal, start_actor, tick, uniforms
from lodestone.options.tabular import on_numbers
from lodestone.planning.enumerated import World, enumerated, num_rows, row_of
from lodestone.planning.option_models import check_available, tabulate_options
from lodestone.planning.tables import tabulate


@dataclass(frozen=True)
class SarsaConfig:
    """Settings of the learner."""

    learning_rate: Knots = ((0.0, 0.5),)
    """alpha over the run."""
    epsilon: Knots = ((0.0, 1.0), (0.7, 0.05))
    """Probability of a random option over the run."""

    def __post_init__(self) -> None:
        check_knots("learning_rate", self.learning_rate, 0.0, 1.0)
        check_knots("epsilon", self.epsilon, 0.0, 1.0)


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    table: Float[Array, "S O"]
    """Q; starts at zero, which is optimistic where steps cost."""
    actor: Actor
    choice: Int[Array, ""]
    """The option that begins where one is due."""
    key: PRNGKeyArray


def sarsa(config: SarsaConfig, environment: Environment, options: Options, rules: Rules, steps: int) -> Algorithm:
    """The algorithm for the training loop; it learns on the tables of the environment, or in a Gymnasium environment by
    the number that this shows. Schedules are fractions of `steps`.

    Raises `TooManyStates` where the tables would be too large, `NoOptionAvailable`, and `InvalidConfig` for a Gymnasium
    environment that shows no number.
    """
    if isinstance(environment, HostEnvironment):
        return sarsa_on_numbers(config, environment, options, rules, steps)
    tables = tabulate(environment)
    check_available(tables, tabulate_options(options, tables.space))
    world = enumerated(tables, environment.action_names)
    return sarsa_on_numbers(config, world, on_numbers(options, tables.space), rules, steps)


def sarsa_on_numbers(config: SarsaConfig, world: World, options: Options, rules: Rules, steps: int) -> Algorithm:
    """The same in a world of numbered states, with options on these numbers, or in a Gymnasium environment."""
    needed, rows = needed_chance(world, options), num_rows(world)

    def init(key: PRNGKeyArray) -> Carry:
        actor_key, choice_key, key = jax.random.split(key, 3)
        table, actor = jnp.zeros((rows, options.size)), start_actor(world, actor_key)
        first = jax.random.uniform(choice_key, (2,))
        choice = choose(first, table[row_of(world, actor.state)], options.initiation(actor.state), jnp.float32(0))
        return Carry(table, actor, choice, key)

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        """`STEPS_PER_ROUND` primitive steps, each with an update if a decision ends on it."""
        fraction = number.astype(jnp.float32) * (STEPS_PER_ROUND / steps)
        epsilon = piecewise_linear(config.epsilon, fraction)
        learning_rate = piecewise_linear(config.learning_rate, fraction)
        noise_key, key = jax.random.split(carry.key)

        def step(carry: tuple[Array, Actor, Array], noise: Float[Array, " N"]) -> tuple[tuple, tuple]:
            table, actor, choice = carry
            actor, decision = tick(world, options, rules, deal(noise[4:], needed), actor, choice)
            transition = between_rows(world, decision).transition
            next_values = table[transition.next_obs]
            following = choose(noise[:2], next_values, transition.next_available, epsilon)
            target = transition.reward + transition.discount * next_values[following]
            error = jnp.where(decision.valid, target - table[transition.obs, transition.action], 0.0)
            table = table.at[transition.obs, transition.action].add(learning_rate * error)
            # After an episode's end the next one begins elsewhere.
            values = table[row_of(world, actor.state)]
            first = choose(noise[2:4], values, options.initiation(actor.state), epsilon)
            choice = jnp.where(decision.episode_ended, first, following)
            return (table, actor, choice), (decision, jnp.square(error))

        noise = uniforms(noise_key, (STEPS_PER_ROUND, 4 + sum(needed)))
        carried = (carry.table, carry.actor, carry.choice)
        (table, actor, choice), (decisions, losses) = jax.lax.scan(step, carried, noise)
        return Carry(table, actor, choice, key), log_round(decisions, jnp.mean(losses))

    return Algorithm(init, run_round)
