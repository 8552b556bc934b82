"""Options given by where they should get: each solves a problem of its own (Sutton, Precup and Singh 1999, section 7).

While it is in its region, an option gets the reward of the process, or none; where it stops, in s', what stopping there
is worth, g(s'). With beta(s') = 1 outside the region and in terminal states and 0 elsewhere, its policy is greedy in

    Q_o(s, a) = E [ r + gamma (beta(s') g(s') + (1 - beta(s')) max over a' of Q_o(s', a')) ]
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from lodestone.envs.task import Task
from lodestone.errors import InvalidConfig
from lodestone.options.base import NO_CAP
from lodestone.options.tabular import TabularOptions
from lodestone.planning.solve import Solution, greedy_choices, value_iteration
from lodestone.planning.tables import Tables


class Subgoal(NamedTuple):
    """Where an option should get, over S numbered states."""

    name: str
    region: Bool[np.ndarray, " S"]
    """Where the option may start and where it goes on. A sub-goal lies outside."""
    values: Float[np.ndarray, " S"]
    """g: what it is worth to stop in a state; read outside the region and in terminal states only."""
    pays_reward: bool = False
    """Whether the option gets the rewards of the process, too."""


def arrival(tables: Tables, goal: Task, discount: float) -> Subgoal:
    """The sub-goal of getting where a task is over, from everywhere else: the step that arrives pays 1, nothing else
    pays."""
    holds = np.asarray(jax.vmap(goal.terminal)(tables.space.states))
    return Subgoal(goal.name, ~holds, np.where(holds, 1 / discount, 0.0))


def subproblem(tables: Tables, subgoal: Subgoal, discount: float) -> Tables:
    """The problem that the option solves, on the same numbers of states: it ends outside the region, and the step that
    ends it pays gamma g. Episodes begin anywhere in the region, with equal probability.

    Raises `InvalidConfig` where there is no state in the region, or g is not finite where it is read.
    """
    ends = tables.terminal | ~subgoal.region
    if ends.all():
        raise InvalidConfig(f"The region of the sub-goal {subgoal.name!r} has no state in which an option could run.")
    if not np.isfinite(subgoal.values[ends]).all():
        raise InvalidConfig(f"The values of the sub-goal {subgoal.name!r} must be finite where the option stops.")
    ended = ends[:, None, None]
    own = tables.rewards if subgoal.pays_reward else np.zeros_like(tables.rewards)
    at_the_end = np.where(ends, discount * subgoal.values, 0.0)[tables.successors]
    stays = np.arange(tables.num_states, dtype=tables.successors.dtype)[:, None, None]
    return tables._replace(
        successors=np.where(ended, stays, tables.successors),
        rewards=np.where(ended, 0.0, own + at_the_end),
        terminal=ends,
        initial_probs=~ends / np.sum(~ends),
    )


def solve_subgoal(tables: Tables, subgoal: Subgoal, discount: float) -> Solution:
    """Exact values of the option's problem; raises what `subproblem` and `value_iteration` raise."""
    return value_iteration(subproblem(tables, subgoal, discount), discount)


def subgoal_options(tables: Tables, subgoals: Sequence[Subgoal], discount: float) -> TabularOptions:
    """The exact option of each sub-goal. Of equally good actions the first is taken."""
    solved = [solve_subgoal(tables, subgoal, discount) for subgoal in subgoals]
    return as_options(tables, subgoals, [greedy_choices(solution.action_values) for solution in solved])


def as_options(
    tables: Tables, subgoals: Sequence[Subgoal], policies: Sequence[Int[np.ndarray, " S"]]
) -> TabularOptions:
    """The options of some sub-goals with given policies, one action a state."""
    regions = np.stack([subgoal.region & ~tables.terminal for subgoal in subgoals], axis=1)
    return TabularOptions(
        tables.space,
        tuple(subgoal.name for subgoal in subgoals),
        (NO_CAP,) * len(subgoals),
        initiation_table=jnp.asarray(regions),
        policy_table=jnp.asarray(np.eye(tables.num_actions, dtype=np.float32)[np.stack(policies, axis=1)]),
        termination_table=jnp.asarray(~regions, dtype=jnp.float32),
    )
