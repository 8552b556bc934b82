"""An environment of numbered states, whose dynamics are look-ups: what a tabular learner runs on.

The same process as the environment that it was made from, state for state, at a cost that does not depend on how that
one computes its transitions.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from lodestone.envs.base import Environment, Step, inverse_cdf
from lodestone.envs.host import HostEnvironment, Shown
from lodestone.envs.state_space import Numbers, StateSpace, reachable_states
from lodestone.planning.tables import Tables, tabulate
from lodestone.types import Observation, State


class Enumerated(Environment):
    """The process of some tables; its state is the number of a state there."""

    names: tuple[str, ...] = eqx.field(static=True)
    initial_probs: Float[np.ndarray, " I"]
    initial_states: Int[np.ndarray, " I"]
    successors: Int[Array, "S A K"]
    probs: Float[Array, "S A K"]
    rewards: Float[Array, "S A K"]
    ends: Bool[Array, " S"]

    @property
    def action_names(self) -> tuple[str, ...]:
        return self.names

    @property
    def num_outcomes(self) -> int:
        return self.successors.shape[2]

    def initial_distribution(self) -> tuple[Float[Array, " I"], Int[Array, " I"]]:
        return jnp.asarray(self.initial_probs), jnp.asarray(self.initial_states)

    def outcome_probs(self, state: Int[Array, ""], action: Int[Array, ""]) -> Float[Array, " K"]:
        return self.probs[state, action]

    def transition(self, state: Int[Array, ""], action: Int[Array, ""], outcome: Int[Array, ""]) -> Int[Array, ""]:
        return self.successors[state, action, outcome]

    def reward(self, state: Int[Array, ""], action: Int[Array, ""], next_state: Int[Array, ""]) -> Float[Array, ""]:
        """All of nature's draws that lead to the same state pay the same."""
        return self.rewards[state, action, jnp.argmax(self.successors[state, action] == next_state)]

    def terminal(self, state: Int[Array, ""]) -> Bool[Array, ""]:
        return self.ends[state]

    def observe(self, state: Int[Array, ""]) -> Observation:
        return state

    def render(self, state: Int[Array, ""]) -> UInt8[np.ndarray, "height width 3"]:
        raise NotImplementedError("A numbered state has no picture; render the state of the environment behind it.")


World = Enumerated | HostEnvironment
"""What a tabular learner acts in: numbered states, or a Gymnasium environment that shows a number."""


def world_of(environment: Environment) -> World:
    """Where a tabular learner of an environment acts. Raises `TooManyStates`."""
    if isinstance(environment, HostEnvironment):
        return environment
    return enumerated(tabulate(environment), environment.action_names)


def num_rows(world: World) -> int:
    """Of a table over its states. Raises `InvalidConfig` for a Gymnasium environment that shows no number."""
    return world.ends.size if isinstance(world, Enumerated) else world.num_states


def row_of(world: World, state: State) -> Int[Array, ""]:
    """Of a state in such a table."""
    return state if isinstance(world, Enumerated) else state.seen.observation


def numbering(environment: Environment) -> StateSpace | Numbers | Shown:
    """How a tabular learner numbers the states of an environment. Raises `TooManyStates`, and `InvalidConfig` for a
    Gymnasium environment that shows no number."""
    match environment:
        case Enumerated():
            return Numbers(environment.ends.size)
        case HostEnvironment():
            return Shown(environment)
    return reachable_states(environment)


def enumerated(tables: Tables, action_names: tuple[str, ...]) -> Enumerated:
    """The process of `tables`."""
    initial = np.flatnonzero(tables.initial_probs)
    return Enumerated(
        names=action_names,
        initial_probs=tables.initial_probs[initial].astype(np.float32),
        initial_states=initial.astype(np.int32),
        successors=jnp.asarray(tables.successors),
        probs=jnp.asarray(tables.probs, dtype=jnp.float32),
        rewards=jnp.asarray(tables.rewards, dtype=jnp.float32),
        ends=jnp.asarray(tables.terminal),
    )


def look_up_step(world: Enumerated, uniform: Float[Array, ""], state: Int[Array, ""], action: Int[Array, ""]) -> Step:
    """What `next_step` does, without a search for the draw that led to the next state."""
    # One index rather than three: the compiler would first put several together in memory.
    pair = state * world.num_actions + action
    outcome = jnp.int32(0)
    if world.num_outcomes > 1:
        outcome = inverse_cdf(world.probs.reshape(-1, world.num_outcomes)[pair], uniform)
    triple = pair * world.num_outcomes + outcome
    next_state = world.successors.ravel()[triple]
    return Step(next_state, world.rewards.ravel()[triple], world.ends[next_state])
