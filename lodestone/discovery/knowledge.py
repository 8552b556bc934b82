"""What a method of discovery may know of a world: all of it, or what trajectories have shown."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from lodestone.envs.base import Environment
from lodestone.envs.state_space import StateSpace, reachable_states
from lodestone.envs.task import endless
from lodestone.planning.tables import Tables, tabulate


class Knowledge(NamedTuple):
    """A model of a world of S numbered states. What discovery does with it is the same whether all is known or not."""

    tables: Tables
    """Where actions lead. One that was never tried is held to change nothing, which never is the best where there is
    something to gain. Rewards mean nothing: discovery is not told of a task."""
    tried: Bool[np.ndarray, "S A"]
    """Which actions are known; none where the episode is over."""

    @property
    def seen(self) -> Bool[np.ndarray, " S"]:
        """States in which an action is known, or to which a known one may lead."""
        states, actions, outcomes = np.nonzero(self.tried[:, :, None] & (self.tables.probs > 0))
        seen = np.any(self.tried, axis=1, keepdims=True)[:, 0]
        seen[self.tables.successors[states, actions, outcomes]] = True
        return seen


def everything(tables: Tables) -> Knowledge:
    """All that there is to know."""
    return Knowledge(tables, np.repeat(~tables.terminal[:, None], tables.num_actions, axis=1))


def everything_without_task(environment: Environment) -> Knowledge:
    """All that there is to know of the states that the environment can reach, where nothing ends an episode."""
    return within(everything(tabulate(endless(environment))), reachable_states(environment))


def within(knowledge: Knowledge, space: StateSpace) -> Knowledge:
    """The same for some of the states, in their own numbers. An action that may lead elsewhere counts as never tried:
    nobody who stops at the goal gets to see what lies behind it."""
    tables = knowledge.tables
    states = jax.tree.map(jnp.asarray, space.states)
    there = np.asarray(jax.jit(jax.vmap(tables.space.index_of))(states))
    number = np.full(tables.num_states, -1, dtype=np.int32)
    number[there] = np.arange(space.size, dtype=np.int32)
    successors, probs = number[tables.successors[there]], tables.probs[there]
    stays = np.any((successors < 0) & (probs > 0), axis=2, keepdims=True) | ~knowledge.tried[there][:, :, None]
    here = np.arange(space.size, dtype=np.int32)[:, None, None]
    initial = tables.initial_probs[there]
    kept = Tables(
        space=space,
        successors=np.where(stays | (successors < 0), here, successors),
        probs=np.where(stays, np.eye(probs.shape[2])[0], probs),
        rewards=np.where(stays, 0.0, tables.rewards[there]),
        terminal=tables.terminal[there],
        initial_probs=initial / initial.sum(),
    )
    return Knowledge(kept, knowledge.tried[there] & ~stays[:, :, 0])
