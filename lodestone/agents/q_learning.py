"""Tabular Q-learning on options (Kuzmin and Panov 2018, algorithm 1; Sutton, Precup and Singh 1999).

    Q(s, o) <- Q(s, o) + alpha [ R + gamma^k max over available o' of Q(s', o') - Q(s, o) ]

once per option execution. With the primitive actions as the only options it is Q-learning.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from lodestone.envs.base import Environment
from lodestone.envs.state_space import StateSpace, reachable_states
from lodestone.learning.collecting import start_actors, tick_all
from lodestone.learning.loop import Algorithm, RoundLog, log_round
from lodestone.learning.policies import epsilon_greedy
from lodestone.learning.schedules import Knots, check_knots, piecewise_linear
from lodestone.learning.targets import semi_markov_target
from lodestone.options.base import Options
from lodestone.options.execution import Actor, Decision, Rules
from lodestone.types import State


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
    """Q; starts at zero as in the paper, which is optimistic where steps cost."""
    actors: Actor
    """One actor, with a leading axis of one."""
    key: PRNGKeyArray


def update(
    table: Float[Array, "S O"], space: StateSpace, decision: Decision, learning_rate: Float[Array, ""]
) -> tuple[Float[Array, "S O"], Float[Array, ""]]:
    """One update from one decision; none where the decision is not valid. Returns the squared error, too."""
    transition = decision.transition
    state, next_state = space.index_of(transition.obs), space.index_of(transition.next_obs)
    target = semi_markov_target(transition.reward, transition.discount, table[next_state], transition.next_available)
    error = jnp.where(decision.valid, target - table[state, transition.action], 0.0)
    return table.at[state, transition.action].add(learning_rate * error), jnp.square(error)


def q_learning(
    config: QLearningConfig, environment: Environment, options: Options, rules: Rules, steps: int
) -> Algorithm:
    """The algorithm for the training loop. A round is one primitive step; schedules are fractions of `steps`.

    Raises `TooManyStates` where the table would be too large.
    """
    space = reachable_states(environment)

    def init(key: PRNGKeyArray) -> Carry:
        actor_key, key = jax.random.split(key)
        table = jnp.zeros((space.size, options.size))
        return Carry(table, start_actors(environment, actor_key, 1), key)

    def run_round(carry: Carry, number: Int[Array, ""]) -> tuple[Carry, RoundLog]:
        fraction = number.astype(jnp.float32) / jnp.float32(steps)
        tick_key, key = jax.random.split(carry.key)
        epsilon = piecewise_linear(config.epsilon, fraction)

        def choose(uniform: Float[Array, "1 2"], states: State) -> Int[Array, " 1"]:
            state = jax.tree.map(lambda leaf: leaf[0], states)
            values = carry.table[space.index_of(state)]
            return epsilon_greedy(uniform[0], values, options.initiation(state), epsilon)[None]

        actors, decisions = tick_all(environment, options, rules, tick_key, carry.actors, choose)
        decision = jax.tree.map(lambda leaf: leaf[0], decisions)
        learning_rate = piecewise_linear(config.learning_rate, fraction)
        table, loss = update(carry.table, space, decision, learning_rate)
        return Carry(table, actors, key), log_round(decisions, loss)

    return Algorithm(init, run_round)
