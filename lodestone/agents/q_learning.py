"""Tabular Q-learning on options (Kuzmin and Panov 2018, algorithm 1; Sutton, Precup and Singh 1999).

    Q(s, o) <- Q(s, o) + alpha [ R + gamma^k max over available o' of Q(s', o') - Q(s, o) ]

once per option execution. With the primitive actions as the only options it is Q-learning.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lodestone.envs.base import Environment
from lodestone.envs.host import HostEnvironment
from lodestone.learning.loop import Algorithm, RoundLog, log_round
from lodestone.learning.policies import choose, largest, mask_unavailable, one_for_two
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.options.base import Options
from lodestone.options.execution import Actor, Chance, Decision, Rules, deal, start_actor, tick, uniforms
from lodestone.options.tabular import TabularOptions, on_numbers
from lodestone.planning.enumerated import World, enumerated, num_rows, row_of
from lodestone.planning.option_models import check_available, tabulate_options
from lodestone.planning.tables import tabulate

STEPS_PER_ROUND = 32
"""Primitive steps between two looks at the schedules."""


@dataclass(frozen=True)
class QLearningConfig:
    """Settings of the learner."""

    learning_rate: Knots = ((0.0, 0.5),)
    """alpha over the run."""
    epsilon: Knots = ((0.0, 1.0), (0.7, 0.05))
    """Probability of a random option over the run."""

    def __post_init__(self) -> None:
        check_knots("learning_rate", self.learning_rate, 0.0, 1.0)
        check_knots("epsilon", self.epsilon, 0.0, 1.0)


class Learned(NamedTuple):
    """What is learned."""

    table: Float[Array, "S O"]
    """Q; starts at zero as in the paper, which is optimistic where steps cost. Minus infinity where an option may not
    start, so that no maximum has to look that up."""
    best: Float[Array, " S"]
    """The maximum of each row, kept beside it: an update changes one row and asks for the maximum of another."""


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    learned: Learned
    actor: Actor
    key: PRNGKeyArray

    @property
    def table(self) -> Float[Array, "S O"]:
        """Q."""
        return self.learned.table


def update(
    learned: Learned, values: Float[Array, " O"], decision: Decision, learning_rate: Float[Array, ""], may_cut: bool
) -> tuple[Learned, Float[Array, ""]]:
    """One update from one decision between numbered states; none where the decision is not valid. Returns the squared
    error, too.

    `values` is the row of the state where the option began. `may_cut`: whether a limit may cut an option, which alone
    is then available in the next state, or only the environment knows what is; elsewhere the table says it.
    """
    transition, (table, best) = decision.transition, learned
    option, next_value = transition.action, best[transition.next_obs]
    if may_cut:
        next_value = largest(mask_unavailable(table[transition.next_obs], transition.next_available))
    target = transition.reward + jnp.where(transition.discount > 0, transition.discount * next_value, 0.0)
    error = jnp.where(decision.valid, target - values[option], 0.0)
    value = values[option] + learning_rate * error
    best = best.at[transition.obs].set(largest(jnp.where(jnp.arange(values.size) == option, value, values)))
    # One index rather than two: the compiler would first put them together in memory.
    table = table.ravel().at[transition.obs * values.size + option].set(value).reshape(table.shape)
    return Learned(table, best), jnp.square(error)


def needed_chance(world: World, options: Options) -> tuple[bool, ...]:
    """For each field of `Chance`, whether a tick needs it: drawing them takes a good part of a learner's time."""
    if not isinstance(options, TabularOptions) or isinstance(world, HostEnvironment):
        return (True,) * len(Chance._fields)

    def draws(probs: Array) -> bool:
        if isinstance(probs, jax.core.Tracer):  # of a world that is known only when the program runs
            return True
        return bool(((np.asarray(probs) > 0) & (np.asarray(probs) < 1)).any())

    needed = {
        "action": draws(options.policy_table),
        "termination": draws(options.termination_table),
        "outcome": draws(world.probs),
        "restart": len(world.initial_states) > 1,
    }
    return tuple(needed[field] for field in Chance._fields)


def between_rows(world: World, decision: Decision) -> Decision:
    """A decision whose states are rows of a table."""
    transition = decision.transition
    rows = {name: row_of(world, getattr(transition, name)) for name in ("obs", "next_obs")}
    return decision._replace(transition=transition._replace(**rows))


def q_learning(
    config: QLearningConfig, environment: Environment, options: Options, rules: Rules, steps: int
) -> Algorithm:
    """The algorithm for the training loop; it learns on the tables of the environment, or in a Gymnasium environment by
    the number that this shows. Schedules are fractions of `steps`.

    Raises `TooManyStates` where the tables would be too large, `NoOptionAvailable`, and `InvalidConfig` for a Gymnasium
    environment that shows no number.
    """
    if isinstance(environment, HostEnvironment):
        return q_learning_on_numbers(config, environment, options, rules, steps)
    tables = tabulate(environment)
    check_available(tables, tabulate_options(options, tables.space))
    world = enumerated(tables, environment.action_names)
    return q_learning_on_numbers(config, world, on_numbers(options, tables.space), rules, steps)


def q_learning_on_numbers(
    config: QLearningConfig, world: World, options: Options, rules: Rules, steps: int
) -> Algorithm:
    """The same in a world of numbered states, with options on these numbers, or in a Gymnasium environment."""
    needed, rows = needed_chance(world, options), num_rows(world)
    known = options.initiation_table if isinstance(options, TabularOptions) else None
    may_cut = known is None or rules.step_limit is not None

    def init(key: PRNGKeyArray) -> Carry:
        actor_key, key = jax.random.split(key)
        table = jnp.zeros((rows, options.size)) if known is None else jnp.where(known, 0.0, -jnp.inf)
        learned = Learned(table, jnp.zeros(rows))
        return Carry(learned, start_actor(world, actor_key), key)

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        """`STEPS_PER_ROUND` primitive steps, each with an update if a decision ends on it."""
        fraction = number.astype(jnp.float32) * (STEPS_PER_ROUND / steps)
        epsilon = piecewise_linear(config.epsilon, fraction)
        learning_rate = piecewise_linear(config.learning_rate, fraction)
        noise_key, key = jax.random.split(carry.key)

        def step(carry: tuple[Learned, Actor], noise: Float[Array, " N"]) -> tuple[tuple[Learned, Actor], tuple]:
            learned, actor = carry
            # The row serves the choice, if there is one to make, and the update, if the option ends on this step.
            state, start = row_of(world, actor.state), row_of(world, actor.start)
            values = learned.table[jnp.where(actor.deciding, state, start)]
            uniform = jnp.stack(one_for_two(noise[0], epsilon))
            available = options.initiation(actor.state) if known is None else values > -jnp.inf
            choice = choose(uniform, values, available, epsilon)
            actor, decision = tick(world, options, rules, deal(noise[1:], needed), actor, choice)
            decision = between_rows(world, decision)
            learned, loss = update(learned, values, decision, learning_rate, may_cut)
            return (learned, actor), (decision, loss)

        # Random numbers are drawn for all steps together: one by one they would take longer than the steps.
        noise = uniforms(noise_key, (STEPS_PER_ROUND, 1 + sum(needed)))
        (learned, actor), (decisions, losses) = jax.lax.scan(step, (carry.learned, carry.actor), noise)
        return Carry(learned, actor, key), log_round(decisions, jnp.mean(losses))

    return Algorithm(init, run_round)
