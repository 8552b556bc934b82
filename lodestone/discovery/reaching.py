"""Options that go to a state: the way is the best that is known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from lodestone.discovery.graph import InteractionGraph, steps_to
from lodestone.discovery.knowledge import Knowledge
from lodestone.options.base import NO_CAP
from lodestone.options.subgoals import Subgoal, solve_subgoal
from lodestone.options.tabular import TabularOptions
from lodestone.planning.solve import greedy_choices


class Destination(NamedTuple):
    """Where an option goes, over S numbered states."""

    name: str
    state: int
    region: Bool[np.ndarray, " S"]
    """Where the option goes on; it stops on arrival anywhere else. The destination lies outside."""
    starts: Bool[np.ndarray, " S"]
    """Where it may start: some of the region."""


def nearest(graph: InteractionGraph, state: int, count: int | None) -> Bool[np.ndarray, " S"]:
    """The `count` states from which the fewest steps lead to one, itself not among them; all from which there is a way
    if None."""
    distance = steps_to(graph.edges, graph.vertex_of(state))
    distance[graph.vertex_of(state)] = np.inf
    order = np.argsort(distance, kind="stable")[: np.isfinite(distance).sum()][:count]
    near = np.zeros(graph.num_states, dtype=bool)
    near[graph.states[order]] = True
    return near


def options_to(knowledge: Knowledge, destinations: Sequence[Destination]) -> TabularOptions:
    """The options that go to some destinations, each by the shortest known way.

    An option solves a problem of its own, after Simsek and Barto (2008): arriving is worth 1, stopping anywhere else
    -1, and a step costs so little that arriving pays off over any distance.
    """
    tables = knowledge.tables.with_step_reward(-1.0 / knowledge.tables.num_states)
    policies = []
    for destination in destinations:
        worth = np.where(np.arange(tables.num_states) == destination.state, 1.0, -1.0)
        problem = Subgoal(destination.name, destination.region, worth, pays_reward=True)
        policies.append(greedy_choices(solve_subgoal(tables, problem, 1.0).action_values))
    return build_options(
        knowledge,
        tuple(destination.name for destination in destinations),
        starts=np.stack([destination.starts for destination in destinations], axis=1),
        goes_on=np.stack([destination.region for destination in destinations], axis=1),
        actions=np.stack(policies, axis=1),
    )


def build_options(
    knowledge: Knowledge,
    names: tuple[str, ...],
    starts: Bool[np.ndarray, "S O"],
    goes_on: Bool[np.ndarray, "S O"],
    actions: Int[np.ndarray, "S O"],
) -> TabularOptions:
    """Options that take one action a state, stop where they do not go on, and have no cap."""
    return TabularOptions(
        knowledge.tables.space,
        names,
        (NO_CAP,) * len(names),
        initiation_table=jnp.asarray(starts),
        policy_table=jnp.asarray(np.eye(knowledge.tables.num_actions, dtype=np.float32)[actions]),
        termination_table=jnp.asarray(~goes_on, dtype=jnp.float32),
    )
