"""Tabular Q-learning on options (Kuzmin and Panov 2018, algorithm 1; Sutton, Precup and Singh 1999).

    Q(s, o) <- Q(s, o) + alpha [ R + gamma^k max over available o' of Q(s', o') - Q(s, o) ]

once per option execution. With the primitive actions as the only options it is Q-learning.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from itertools import accumulate
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from lodestone.envs.base import UNROLLED, Environment
from lodestone.learning.loop import Algorithm, RoundLog, log_round
from lodestone.learning.policies import epsilon_greedy, mask_unavailable
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.options.base import Options
from lodestone.options.execution import Actor, Chance, Decision, Rules, deal, start_actor, tick, uniforms
from lodestone.options.tabular import TabularOptions, on_numbers
from lodestone.planning.enumerated import Enumerated, enumerated
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


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    table: Float[Array, "S O"]
    """Q; starts at zero as in the paper, which is optimistic where steps cost. Minus infinity where an option may not
    start, so that no maximum has to look that up."""
    actor: Actor
    key: PRNGKeyArray


def update(
    table: Float[Array, "S O"], decision: Decision, learning_rate: Float[Array, ""], may_cut: bool
) -> tuple[Float[Array, "S O"], Float[Array, ""]]:
    """One update from one decision between numbered states; none where the decision is not valid. Returns the squared
    error, too.

    `may_cut`: whether a limit may cut an option, which alone is then available in the next state; elsewhere the table
    says what is available.
    """
    transition = decision.transition
    next_values = table[transition.next_obs]
    if may_cut:
        next_values = mask_unavailable(next_values, transition.next_available)
    target = transition.reward + jnp.where(transition.discount > 0, transition.discount * largest(next_values), 0.0)
    # One index rather than two: the compiler would first put them together in memory.
    values, pair = table.ravel(), transition.obs * table.shape[1] + transition.action
    error = jnp.where(decision.valid, target - values[pair], 0.0)
    return values.at[pair].add(learning_rate * error).reshape(table.shape), jnp.square(error)


def largest(row: Float[Array, " O"]) -> Float[Array, ""]:
    """The maximum of a row. A short one is gone through entry by entry: where many seeds learn side by side that is one
    loop over them, and a reduction is several."""
    return _largest(list(row)) if row.size <= UNROLLED else jnp.max(row)


def choose(
    uniform: Float[Array, " 2"], values: Float[Array, " O"], available: Bool[Array, " O"], epsilon: Float[Array, ""]
) -> Int[Array, ""]:
    """What `epsilon_greedy` chooses, entry by entry as in `largest`."""
    if values.size > UNROLLED:
        return epsilon_greedy(uniform, values, available, epsilon)
    return choose_among(uniform[0], uniform[1], list(mask_unavailable(values, available)), epsilon)


def choose_among(
    explores: Float[Array, ""], picks: Float[Array, ""], values: list[Float[Array, ""]], epsilon: Float[Array, ""]
) -> Int[Array, ""]:
    """The same for a few values that are no array; -inf where there is nothing to choose."""
    least = jnp.where(explores < epsilon, jnp.finfo(jnp.float32).min, _largest(values))
    counts = list(accumulate(jnp.where(value >= least, 1.0, 0.0) for value in values))
    return sum((count <= picks * counts[-1]).astype(jnp.int32) for count in counts[:-1]) + jnp.int32(0)


def _largest(values: list[Float[Array, ""]]) -> Float[Array, ""]:
    return reduce(lambda one, other: jnp.where(one > other, one, other), values)


def needed_chance(world: Enumerated, options: TabularOptions) -> tuple[bool, ...]:
    """For each field of `Chance`, whether a tick needs it: drawing them takes a good part of a learner's time."""

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


def q_learning(
    config: QLearningConfig, environment: Environment, options: Options, rules: Rules, steps: int
) -> Algorithm:
    """The algorithm for the training loop; it learns on the tables of the environment. Schedules are fractions of
    `steps`.

    Raises `TooManyStates` where the tables would be too large, and `NoOptionAvailable`.
    """
    tables = tabulate(environment)
    check_available(tables, tabulate_options(options, tables.space))
    world = enumerated(tables, environment.action_names)
    return q_learning_on_numbers(config, world, on_numbers(options, tables.space), rules, steps)


def q_learning_on_numbers(
    config: QLearningConfig, world: Enumerated, options: TabularOptions, rules: Rules, steps: int
) -> Algorithm:
    """The same in a world of numbered states, with options on these numbers."""
    needed = needed_chance(world, options)

    def init(key: PRNGKeyArray) -> Carry:
        actor_key, key = jax.random.split(key)
        table = jnp.where(options.initiation_table, 0.0, -jnp.inf)
        return Carry(table, start_actor(world, actor_key), key)

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        """`STEPS_PER_ROUND` primitive steps, each with an update if a decision ends on it."""
        fraction = number.astype(jnp.float32) * (STEPS_PER_ROUND / steps)
        epsilon = piecewise_linear(config.epsilon, fraction)
        learning_rate = piecewise_linear(config.learning_rate, fraction)
        noise_key, key = jax.random.split(carry.key)

        def step(carry: tuple[Array, Actor], noise: Float[Array, " N"]) -> tuple[tuple[Array, Actor], tuple]:
            table, actor = carry
            values = table[actor.state]
            choice = choose(noise[:2], values, values > -jnp.inf, epsilon)
            actor, decision = tick(world, options, rules, deal(noise[2:], needed), actor, choice)
            table, loss = update(table, decision, learning_rate, may_cut=rules.step_limit is not None)
            return (table, actor), (decision, loss)

        # Random numbers are drawn for all steps together: one by one they would take longer than the steps.
        noise = uniforms(noise_key, (STEPS_PER_ROUND, 2 + sum(needed)))
        (table, actor), (decisions, losses) = jax.lax.scan(step, (carry.table, carry.actor), noise)
        return Carry(table, actor, key), log_round(decisions, jnp.mean(losses))

    return Algorithm(init, run_round)
