"""Models of options learned from primitive steps (Sutton, Precup and Singh 1999, section 5).

    R_o(s)    <- R_o(s)    + alpha [ r + gamma (1 - beta_o(s')) R_o(s') - R_o(s) ]
    F_o(s, x) <- F_o(s, x) + alpha [ gamma ((1 - beta_o(s')) F_o(s', x) + beta_o(s') 1{x = s'}) - F_o(s, x) ]

for every x and every option with pi_o(s) = a, after each primitive step (s, a, r, s'). The steps are those of actions
drawn evenly. An option that draws its actions learns from a step in proportion to pi_o(a|s): as all actions are
equally likely, the fixed point is the exact model (`lodestone.planning.option_models`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lodestone.agents.q_learning import STEPS_PER_ROUND, needed_chance
from lodestone.envs.base import Environment
from lodestone.learning.loop import Algorithm, RoundLog, log_round
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.options.base import Options, Primitives
from lodestone.options.execution import Actor, Rules, deal, start_actor, tick
from lodestone.options.tabular import on_numbers
from lodestone.planning.enumerated import enumerated
from lodestone.planning.interruption import refuse_caps
from lodestone.planning.tables import tabulate


@dataclass(frozen=True)
class ModelLearningConfig:
    """Settings of the learner."""

    learning_rate: Knots = ((0.0, 0.5), (0.5, 0.05), (1.0, 0.01))
    """alpha over the run."""

    def __post_init__(self) -> None:
        check_knots("learning_rate", self.learning_rate, 0.0, 1.0)


class Models(NamedTuple):
    """What is learned about O options over S states."""

    rewards: Float[Array, "S O"]
    """R_o(s)."""
    ends: Float[Array, "S O X"]
    """F_o(s, x), where x is a state, too."""


class Carry(NamedTuple):
    """Everything that one seed carries from round to round."""

    models: Models
    actor: Actor
    key: PRNGKeyArray


def update(
    models: Models,
    state: Int[Array, ""],
    reward: Float[Array, ""],
    next_state: Int[Array, ""],
    stops: Float[Array, " O"],
    rates: Float[Array, " O"],
    discount: float,
) -> tuple[Models, Float[Array, ""]]:
    """One update of all options from one step; `stops` are their chances to stop on arrival, `rates` their learning
    rates. Returns the mean squared error of the rewards, too."""
    goes_on = 1.0 - stops
    reward_error = reward + discount * goes_on * models.rewards[next_state] - models.rewards[state]
    ended_here = stops[:, None] * jax.nn.one_hot(next_state, models.ends.shape[2])[None, :]
    ended = discount * (goes_on[:, None] * models.ends[next_state] + ended_here)
    updated = Models(
        rewards=models.rewards.at[state].add(rates * reward_error),
        ends=models.ends.at[state].add(rates[:, None] * (ended - models.ends[state])),
    )
    return updated, jnp.mean(jnp.square(reward_error))


def option_model_learning(
    config: ModelLearningConfig, environment: Environment, options: Options, rules: Rules, steps: int
) -> Algorithm:
    """The algorithm for the training loop; it learns on the tables of the environment. Schedules are fractions of
    `steps`. Of the rules it takes the discount and the limits of an episode. Memory: 4 O S^2 bytes a seed.

    Raises `TooManyStates` where the tables would be too large, and `InvalidConfig` for options with a cap of more than
    one step, whose models depend on how long they have run.
    """
    refuse_caps(options.names, options.max_steps, "learned from single steps")
    tables = tabulate(environment)
    world = enumerated(tables, environment.action_names)
    numbered = on_numbers(options, tables.space)
    actions = on_numbers(Primitives(environment.action_names), tables.space)
    needed = needed_chance(world, actions)
    one_step = jnp.asarray([cap == 1 for cap in options.max_steps])

    def init(key: PRNGKeyArray) -> Carry:
        actor_key, key = jax.random.split(key)
        shape = (tables.num_states, options.size)
        models = Models(jnp.zeros(shape), jnp.zeros((*shape, tables.num_states)))
        return Carry(models, start_actor(world, actor_key), key)

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        """`STEPS_PER_ROUND` primitive steps, each with an update."""
        learning_rate = piecewise_linear(config.learning_rate, number.astype(jnp.float32) * (STEPS_PER_ROUND / steps))
        action_key, noise_key, key = jax.random.split(carry.key, 3)

        def step(
            carry: tuple[Models, Actor], draws: tuple[Int[Array, ""], Float[Array, " N"]]
        ) -> tuple[tuple[Models, Actor], tuple]:
            (models, actor), (action, noise) = carry, draws
            state = actor.state
            actor, decision = tick(world, actions, rules, deal(noise, needed), actor, action)
            next_state = decision.transition.next_obs
            reward = world.reward(state, action, next_state)
            stops = jnp.where(one_step | decision.terminated, 1.0, numbered.termination(next_state))
            rates = learning_rate * numbered.action_probs(state)[:, action]
            models, loss = update(models, state, reward, next_state, stops, rates, rules.discount)
            return (models, actor), (decision, loss)

        draws = (
            jax.random.randint(action_key, (STEPS_PER_ROUND,), 0, actions.size),
            jax.random.uniform(noise_key, (STEPS_PER_ROUND, sum(needed))),
        )
        (models, actor), (decisions, losses) = jax.lax.scan(step, (carry.models, carry.actor), draws)
        return Carry(models, actor, key), log_round(decisions, jnp.mean(losses))

    return Algorithm(init, run_round)
