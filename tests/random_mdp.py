"""Small random processes and options with dense formulas for them (test problems of SYSTEMS 1.6)."""

from __future__ import annotations

from functools import cache

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lodestone.envs.base import Environment
from lodestone.envs.random_mdp import random_dynamics
from lodestone.options.base import NO_CAP, Options
from lodestone.planning.option_models import OptionTables
from lodestone.planning.tables import Tables, tabulate

NUM_STATES, NUM_ACTIONS = 7, 3


class ArrayMDP(Environment):
    """The state is a number; nature's draw is the next state. The last `goals` states are terminal."""

    probs: Float[Array, "S A S"]
    rewards: Float[Array, "S A S"]
    goals: int = eqx.field(static=True, default=0)

    # Tables of reachable states are remembered per environment, and arrays have no hash.
    __hash__ = object.__hash__
    __eq__ = object.__eq__

    @property
    def action_names(self) -> tuple[str, ...]:
        return tuple(f"action-{action}" for action in range(self.probs.shape[1]))

    @property
    def num_outcomes(self) -> int:
        return self.probs.shape[0]

    def initial_distribution(self) -> tuple[Float[Array, " I"], Int[Array, " I"]]:
        return jnp.array([0.25, 0.5, 0.25]), jnp.array([0, 1, 0])

    def outcome_probs(self, state: Int[Array, ""], action: Int[Array, ""]) -> Float[Array, " K"]:
        return self.probs[state, action]

    def transition(self, state: Int[Array, ""], action: Int[Array, ""], outcome: Int[Array, ""]) -> Int[Array, ""]:
        del state, action
        return outcome

    def reward(self, state: Int[Array, ""], action: Int[Array, ""], next_state: Int[Array, ""]) -> Float[Array, ""]:
        return self.rewards[state, action, next_state]

    def terminal(self, state: Int[Array, ""]) -> Bool[Array, ""]:
        return state >= self.probs.shape[0] - self.goals

    def observe(self, state: Int[Array, ""]) -> Int[Array, ""]:
        return state

    def render(self, state: Int[Array, ""]) -> np.ndarray:
        raise NotImplementedError


def random_mdp(seed: int, goals: int = 0) -> ArrayMDP:
    """The dynamics of `RandomMDP`, with episodes that begin in one of two states."""
    probs, rewards = random_dynamics(seed, NUM_STATES, NUM_ACTIONS, 0.4)
    return ArrayMDP(jnp.asarray(probs, jnp.float32), jnp.asarray(rewards, jnp.float32), goals)


def random_tables(seed: int, goals: int = 0) -> Tables:
    """The tables of such a process, without the search for its states, which compiles anew for each environment."""
    tables = _tables_to_fill(goals)
    probs, rewards = random_dynamics(seed, NUM_STATES, NUM_ACTIONS, 0.4)
    live = ~tables.terminal[:, None, None]
    return tables._replace(probs=np.where(live, probs, tables.probs), rewards=np.where(live, rewards, 0.0))


@cache
def _tables_to_fill(goals: int) -> Tables:
    return tabulate(random_mdp(0, goals))


class RandomOptions(Options):
    """Tables over the states of an `ArrayMDP`, where one option may start anywhere."""

    start: Bool[Array, "S O"]
    acts: Float[Array, "S O A"]
    stops: Float[Array, "S O"]
    caps: tuple[int, ...] = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"option-{option}" for option in range(len(self.caps)))

    @property
    def max_steps(self) -> tuple[int, ...]:
        return self.caps

    def initiation(self, state: Int[Array, ""]) -> Bool[Array, " O"]:
        return self.start[state]

    def action_probs(self, state: Int[Array, ""]) -> Float[Array, "O A"]:
        return self.acts[state]

    def termination(self, state: Int[Array, ""]) -> Float[Array, " O"]:
        return self.stops[state]


def random_options(seed: int, caps: tuple[int, ...] = (NO_CAP, NO_CAP, NO_CAP)) -> RandomOptions:
    """beta ~ U(.05, .3); policies with one action in most states and a mixture in some; random initiation."""
    rng = np.random.default_rng(seed)
    shape = (NUM_STATES, len(caps))
    acts = np.eye(NUM_ACTIONS)[rng.integers(NUM_ACTIONS, size=shape)]
    mixed = rng.random(shape) < 0.3
    acts[mixed] = rng.dirichlet(np.ones(NUM_ACTIONS), size=int(mixed.sum()))
    start = rng.random(shape) < 0.6
    start[:, 0] = True
    return RandomOptions(
        jnp.asarray(start),
        jnp.asarray(acts, jnp.float32),
        jnp.asarray(rng.uniform(0.05, 0.3, size=shape), jnp.float32),
        caps,
    )


def dense(tables: Tables) -> tuple[Float[np.ndarray, "S A S"], Float[np.ndarray, "S A"]]:
    """P and r as dense arrays, with nothing after a terminal state."""
    probs = np.zeros((tables.num_states, tables.num_actions, tables.num_states))
    for state, action, outcome in np.ndindex(*tables.successors.shape):
        probs[state, action, tables.successors[state, action, outcome]] += tables.probs[state, action, outcome]
    rewards = (tables.probs * tables.rewards).sum(axis=2)
    probs[tables.terminal], rewards[tables.terminal] = 0.0, 0.0
    return probs, rewards


def simulated_model(
    tables: Tables, options: OptionTables, option: int, discount: float, reward_discount: float, horizon: int
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, "S S"]]:
    """R_o and F_o by following the distribution over states step by step, from each state as the start."""
    probs, rewards = dense(tables)
    acts = options.action_probs[option] / options.action_probs[option].sum(axis=1, keepdims=True, dtype=np.float64)
    step, pay = np.einsum("sa,sax->sx", acts, probs), np.einsum("sa,sa->s", acts, rewards)
    stops = np.where(tables.terminal, 1.0, options.termination[option].astype(np.float64))
    running, total, ended = np.eye(len(pay)), np.zeros(len(pay)), np.zeros((len(pay), len(pay)))
    for elapsed in range(min(options.max_steps[option], horizon)):
        total += reward_discount**elapsed * running @ pay
        arrived = running @ step
        stopping = np.ones_like(stops) if elapsed + 1 == options.max_steps[option] else stops
        ended += discount ** (elapsed + 1) * arrived * stopping
        running = arrived * (1.0 - stopping)
        if running.max() < 1e-15:
            break
    return total, ended
