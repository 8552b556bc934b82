"""Intra-option Q-learning: every step teaches every option that would have taken it (Sutton, Precup and Singh 1999,
section 6).

    U(s', o) = (1 - beta_o(s')) Q(s', o) + beta_o(s') max over available o' of Q(s', o')
    Q(s, o) <- Q(s, o) + alpha [ r + gamma U(s', o) - Q(s, o) ]        for every o with pi_o(s) = a

after each primitive step (s, a, r, s'), whichever option took it: options that never run are learned too. For an
option that draws its actions, the value after each first action is learned beside Q, and Q is their mean under the
option's policy,

    Q(s, o, a) <- Q(s, o, a) + alpha [ r + gamma U(s', o) - Q(s, o, a) ]        Q(s, o) = sum_a pi_o(a|s) Q(s, o, a)

which is exact in expectation whatever the behaviour, where a weight pi_o(a|s) / b(a|s) would need every action to be
possible under the option that runs. Of an option that does not draw the two are the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lodestone.agents.q_learning import STEPS_PER_ROUND, needed_chance
from lodestone.envs.base import Environment
from lodestone.envs.host import HostEnvironment
from lodestone.errors import InvalidConfig
from lodestone.learning.loop import Algorithm, RoundLog, log_round
from lodestone.learning.policies import choose, largest, mask_unavailable
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.options.base import Options
from lodestone.options.execution import REWARD_SWITCHES, Actor, Rules, deal, start_actor, tick, uniforms
from lodestone.options.tabular import TabularOptions, on_numbers
from lodestone.planning.enumerated import Enumerated, World, enumerated, look_up_step, num_rows, row_of
from lodestone.planning.interruption import refuse_caps
from lodestone.planning.option_models import check_available, tabulate_options
from lodestone.planning.tables import tabulate

Behaviour = Literal["options", "primitives"]


@dataclass(frozen=True)
class IntraOptionConfig:
    """Settings of the learner."""

    learning_rate: Knots = ((0.0, 0.5),)
    """alpha over the run."""
    epsilon: Knots = ((0.0, 1.0), (0.7, 0.05))
    """Probability of a random choice over the run."""
    behaviour: Behaviour = "options"
    """What is chosen from while learning. `options`: all options, each run until it stops. `primitives`: options of one
    step only, so that the others are learned without being run."""

    def __post_init__(self) -> None:
        check_knots("learning_rate", self.learning_rate, 0.0, 1.0)
        check_knots("epsilon", self.epsilon, 0.0, 1.0)
        if self.behaviour not in get_args(Behaviour):
            raise InvalidConfig(
                f"behaviour is {self.behaviour!r}, but must be one of {', '.join(get_args(Behaviour))}."
            )


class Values(NamedTuple):
    """What is learned about O options over S states."""

    table: Float[Array, "S O"]
    """Q; starts at zero, which is optimistic where steps cost. It is learned in every state, also where an option may
    not start: there it is what going on is worth, and no maximum looks at it."""
    by_action: Float[Array, "S A O"] | None
    """Q after each first action; None where no option draws its actions."""


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    values: Values
    actor: Actor
    key: PRNGKeyArray

    @property
    def table(self) -> Float[Array, "S O"]:
        """Q."""
        return self.values.table


def update(
    values: Values,
    state: Int[Array, ""],
    action: Int[Array, ""],
    weights: Float[Array, " O"],
    target: Float[Array, " O"],
    learning_rate: Float[Array, ""],
) -> tuple[Values, Float[Array, ""]]:
    """One update of all options from one step; `weights` are the options' probabilities of its action. Returns the mean
    squared error of the options that were updated, too."""
    table, by_action = values
    old = table[state] if by_action is None else by_action[state, action]
    error = jnp.where(weights > 0, target - old, 0.0)
    if by_action is not None:
        by_action = by_action.at[state, action].add(learning_rate * error)
    # Where no option draws its actions, a weight is 0 or 1.
    table = table.at[state].add(learning_rate * weights * error)
    updated = jnp.sum((weights > 0).astype(jnp.float32))
    return Values(table, by_action), jnp.sum(jnp.square(error)) / jnp.maximum(updated, 1.0)


def intra_option_q_learning(
    config: IntraOptionConfig, environment: Environment, options: Options, rules: Rules, steps: int
) -> Algorithm:
    """The algorithm for the training loop; it learns on the tables of the environment, or in a Gymnasium environment by
    the number that this shows. Schedules are fractions of `steps`.

    Raises `TooManyStates` where the tables would be too large; `InvalidConfig` for options with a cap of more than one
    step, whose values depend on how long they have run, for rules under which an option's reward is not the discounted
    sum of its steps' rewards, and for a Gymnasium environment that shows no number; `NoOptionAvailable` where the
    behaviour has nothing to choose from.
    """
    refuse_caps(options.names, options.max_steps, "learned from single steps")
    why = "learning within options takes the reward of an option to be the discounted sum of its steps' rewards"
    rules.refuse(REWARD_SWITCHES, why)
    if isinstance(environment, HostEnvironment):
        return _on_numbers(config, environment, options, rules, steps)
    tables = tabulate(environment)
    chosen_from = tabulate_options(options, tables.space)
    if config.behaviour == "primitives":
        one_step = np.array(options.max_steps) == 1
        chosen_from = chosen_from._replace(initiation=chosen_from.initiation & one_step[:, None])
    check_available(tables, chosen_from)
    world = enumerated(tables, environment.action_names)
    return _on_numbers(config, world, on_numbers(options, tables.space), rules, steps)


def _on_numbers(config: IntraOptionConfig, world: World, options: Options, rules: Rules, steps: int) -> Algorithm:
    """The same in a world of numbered states, with options on these numbers, or in a Gymnasium environment, where any
    option may draw its actions."""
    needed, rows = needed_chance(world, options), num_rows(world)
    one_step = np.array(options.max_steps) == 1
    draws, weights_of = True, None
    if isinstance(options, TabularOptions):
        probs = np.asarray(options.policy_table)
        draws = bool(((probs > 0) & (probs < 1)).any())
        weights_of = jnp.asarray(probs.swapaxes(1, 2))  # [S, A, O], so that a step needs one row

    def init(key: PRNGKeyArray) -> Carry:
        actor_key, key = jax.random.split(key)
        by_action = jnp.zeros((rows, world.num_actions, options.size)) if draws else None
        values = Values(jnp.zeros((rows, options.size)), by_action)
        return Carry(values, start_actor(world, actor_key), key)

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        """`STEPS_PER_ROUND` primitive steps, each with an update."""
        fraction = number.astype(jnp.float32) * (STEPS_PER_ROUND / steps)
        epsilon = piecewise_linear(config.epsilon, fraction)
        learning_rate = piecewise_linear(config.learning_rate, fraction)
        noise_key, key = jax.random.split(carry.key)

        def step(carry: tuple[Values, Actor], noise: Float[Array, " N"]) -> tuple[tuple[Values, Actor], tuple]:
            values, actor = carry
            state, row = actor.state, row_of(world, actor.state)
            available = options.initiation(state)
            if config.behaviour == "primitives":
                available &= jnp.asarray(one_step)
            choice = choose(noise[:2], values.table[row], available, epsilon)
            chance = deal(noise[2:], needed)
            actor, decision = tick(world, options, rules, chance, actor, choice)
            next_state = decision.transition.next_obs
            if isinstance(world, Enumerated):
                reward = look_up_step(world, chance.outcome, state, decision.action).reward  # of the step taken
            else:
                reward = next_state.reward

            next_values = values.table[row_of(world, next_state)]
            stops = jnp.where(jnp.asarray(one_step), 1.0, options.termination(next_state))
            best = largest(mask_unavailable(next_values, options.initiation(next_state)))
            arriving = (1.0 - stops) * next_values + jnp.where(stops > 0, stops * best, 0.0)
            no_future = decision.terminated if rules.bootstrap_at_limit else decision.episode_ended
            target = reward + jnp.where(no_future, 0.0, rules.discount * arriving)
            if weights_of is None:
                weights = options.action_probs(state)[:, decision.action]
            else:
                weights = weights_of[row, decision.action]
            values, loss = update(values, row, decision.action, weights, target, learning_rate)
            return (values, actor), (decision, loss)

        noise = uniforms(noise_key, (STEPS_PER_ROUND, 2 + sum(needed)))
        (values, actor), (decisions, losses) = jax.lax.scan(step, (carry.values, carry.actor), noise)
        return Carry(values, actor, key), log_round(decisions, jnp.mean(losses))

    return Algorithm(init, run_round)
