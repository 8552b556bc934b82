"""Task graphs: a problem taken apart into subtasks, as data (Dietterich 2000, sections 3 and 5).

A subtask says where it ends and which children it may call: other subtasks, or primitive actions. The value of calling
a child is the reward until the child ends, which is the child's own value, and the reward after it until the subtask
ends, which is the *completion*. A child may look at less than the whole state (state abstraction): what it `sees`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from graphlib import CycleError, TopologicalSorter
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lodestone.envs.base import Environment
from lodestone.envs.host import Shown
from lodestone.envs.state_space import StateSpace
from lodestone.errors import InvalidTaskGraph
from lodestone.planning.tables import Tables, state_batches, state_text
from lodestone.types import State

Predicate = Callable[[State], Bool[Array, ""]]
Feature = Callable[[State], Int[Array, "*shape"]]
"""Numbers by which states are told apart."""


@dataclass(frozen=True)
class Child:
    """A call that a subtask may make."""

    name: str
    """Of a subtask or of a primitive action."""
    when: Predicate | None = None
    """Where the call is allowed; everywhere by default. A subtask is never called where it has ended already."""
    sees: Feature | None = None
    """What the completion value depends on; by default the whole state."""
    final: bool = False
    """Whether the call's end is always the caller's end, so that nothing is left to complete and nothing is stored."""


@dataclass(frozen=True)
class Subtask:
    """A node of the graph."""

    name: str
    ends: Predicate
    """Where the subtask is over. The end of an episode ends every subtask."""
    children: tuple[Child, ...]
    """In the order in which ties are broken."""
    pseudo_reward: Callable[[State], Float[Array, ""]] | None = None
    """A reward for ending in a state, by which the subtask's own policy is chosen, and which nobody else sees."""


@dataclass(frozen=True)
class TaskGraph:
    """A directed graph without cycles, the root first."""

    subtasks: tuple[Subtask, ...]
    rewards_see: Mapping[str, Feature] = field(default_factory=dict)
    """What the expected reward of a primitive action depends on; by default the whole state."""

    def __post_init__(self) -> None:
        """Raise `InvalidTaskGraph` for a graph that makes no sense in any environment."""
        names = [subtask.name for subtask in self.subtasks]
        if not names:
            raise InvalidTaskGraph("A task graph needs at least one subtask, the root.")
        for name in names:
            if names.count(name) > 1:
                raise InvalidTaskGraph(f"Two subtasks are named {name!r}.")
        for subtask in self.subtasks:
            called = [child.name for child in subtask.children]
            if not called:
                raise InvalidTaskGraph(f"Subtask {subtask.name!r} has no children.")
            for name in called:
                if called.count(name) > 1:
                    raise InvalidTaskGraph(f"Subtask {subtask.name!r} has two children named {name!r}.")
            if subtask.pseudo_reward is not None and any(child.final for child in subtask.children):
                raise InvalidTaskGraph(
                    f"Subtask {subtask.name!r} has a pseudo-reward, which is learned as a part of completions, and so "
                    "none of its children can be final."
                )
        calls = self.calls()
        try:
            tuple(TopologicalSorter(calls).static_order())
        except CycleError as error:
            raise InvalidTaskGraph(f"Subtasks call one another in a circle: {' -> '.join(error.args[1])}.") from None
        reached, found = set[str](), {names[0]}
        while found:
            reached |= found
            found = {child for name in found for child in calls.get(name, ())} - reached
        for name in names:
            if name not in reached:
                raise InvalidTaskGraph(f"Subtask {name!r} is never called from the root, {names[0]!r}.")

    def calls(self) -> dict[str, tuple[str, ...]]:
        """The names that each subtask calls."""
        return {subtask.name: tuple(child.name for child in subtask.children) for subtask in self.subtasks}

    @property
    def levels(self) -> int:
        """D, the most subtasks that can run at a time, each called by the one before."""
        calls = self.calls()
        below: dict[str, int] = {}
        for name in TopologicalSorter(calls).static_order():
            below[name] = 1 + max(below[child] for child in calls[name]) if name in calls else 0
        return below[self.subtasks[0].name]

    def without_abstraction(self) -> TaskGraph:
        """The same graph where every value depends on the whole state."""
        subtasks = tuple(
            replace(subtask, children=tuple(replace(child, sees=None, final=False) for child in subtask.children))
            for subtask in self.subtasks
        )
        return TaskGraph(subtasks)

    def without_pseudo_rewards(self) -> TaskGraph:
        """The same graph where every subtask is judged by the environment's rewards alone."""
        return replace(self, subtasks=tuple(replace(subtask, pseudo_reward=None) for subtask in self.subtasks))


class Edge(NamedTuple):
    """A call, as numbers."""

    subtask: int
    child: int
    """A primitive action if below A, else A more than a subtask."""


class TaskTables(NamedTuple):
    """A task graph over S numbered states: T subtasks, A primitive actions, E edges.

    Values are stored in one flat array; `completion_slot` and `reward_slot` say where, and states that are seen alike
    share a slot.
    """

    names: tuple[str, ...]
    """Of the A actions, then of the T subtasks."""
    num_actions: int
    edges: tuple[Edge, ...]
    """Subtask by subtask, each in the order of its children."""
    bottom_up: tuple[int, ...]
    """The subtasks, children before those who call them; the root is last."""
    ends: Bool[np.ndarray, "T S"]
    available: Bool[np.ndarray, "E S"]
    pseudo_rewards: Float[np.ndarray, "T S"]
    """0 where the subtask surely goes on."""
    completion_slot: Int[np.ndarray, "E S"]
    """-1 where nothing is stored, because the completion is 0."""
    reward_slot: Int[np.ndarray, "A S"]
    num_slots: int
    """Values that are stored."""

    @property
    def edge_names(self) -> tuple[str, ...]:
        """Caller and called, such as `get/pickup`."""
        return tuple(f"{self.names[self.num_actions + edge.subtask]}/{self.names[edge.child]}" for edge in self.edges)

    def edges_of(self, subtask: int) -> tuple[int, ...]:
        """Numbers of a subtask's edges."""
        return tuple(number for number, edge in enumerate(self.edges) if edge.subtask == subtask)


def tabulate_tasks(graph: TaskGraph, environment: Environment, tables: Tables | Shown) -> TaskTables:
    """The graph's predicates in every state of `tables`, which must be those of `environment`, or for every number that
    a Gymnasium environment shows: an episode may end with any of them, or with none, and a subtask may have ended where
    `ends` says nothing.

    Raises `InvalidTaskGraph` where a child is neither a subtask nor an action, or where a subtask goes on and none of
    its children may be called.
    """
    actions = environment.action_names
    subtasks = tuple(subtask.name for subtask in graph.subtasks)
    for name in subtasks:
        if name in actions:
            raise InvalidTaskGraph(f"Subtask {name!r} has the name of a primitive action.")
    names = (*actions, *subtasks)
    for subtask in graph.subtasks:
        for child in subtask.children:
            if child.name not in names:
                raise InvalidTaskGraph(
                    f"Subtask {subtask.name!r} calls {child.name!r}, but there is no subtask or action of that name; "
                    f"actions are: {', '.join(actions)}."
                )
    for name in graph.rewards_see:
        if name not in actions:
            raise InvalidTaskGraph(f"There is no action {name!r} whose reward could depend on less than the state.")

    space: StateSpace | Shown
    if isinstance(tables, Shown):
        space, terminal = tables, np.zeros(tables.size, dtype=bool)
    else:
        space, terminal = tables.space, tables.terminal
    everywhere = _answers(graph, space)
    ends = np.stack([everywhere[subtask.ends].astype(bool) | terminal for subtask in graph.subtasks])
    pseudo_rewards = np.zeros(ends.shape)
    for number, subtask in enumerate(graph.subtasks):
        if subtask.pseudo_reward is not None:
            may_end = ends[number] | isinstance(tables, Shown)
            pseudo_rewards[number] = np.where(may_end, everywhere[subtask.pseudo_reward], 0.0)

    edges, available, slots, next_slot = [], [], [], 0
    for number, subtask in enumerate(graph.subtasks):
        for child in subtask.children:
            edge = Edge(number, names.index(child.name))
            allowed = ~ends[number]
            if child.when is not None:
                allowed = allowed & everywhere[child.when].astype(bool)
            if edge.child >= len(actions):
                allowed = allowed & ~ends[edge.child - len(actions)]
            slot = np.full(space.size, -1)
            if not child.final:
                slot[allowed] = next_slot + _classes(everywhere[child.sees] if child.sees else None, allowed)
                next_slot = max(next_slot, int(slot.max()) + 1)
            edges.append(edge)
            available.append(allowed)
            slots.append(slot)
        stuck = ~ends[number] & ~np.any(available[-len(subtask.children) :], axis=0)
        if stuck.any():
            raise InvalidTaskGraph(
                f"Subtask {subtask.name!r} goes on in {state_text(space, int(stuck.argmax()))}, but may call "
                "none of its children there."
            )
    live, reward_slots = ~terminal, []
    for name in actions:
        slot = np.full(space.size, -1)
        sees = graph.rewards_see.get(name)
        slot[live] = next_slot + _classes(everywhere[sees] if sees else None, live)
        next_slot = max(next_slot, int(slot.max()) + 1)
        reward_slots.append(slot)

    order = TopologicalSorter(graph.calls()).static_order()
    return TaskTables(
        names=names,
        num_actions=len(actions),
        edges=tuple(edges),
        bottom_up=tuple(subtasks.index(name) for name in order if name in subtasks),
        ends=ends,
        available=np.stack(available),
        pseudo_rewards=pseudo_rewards,
        completion_slot=np.stack(slots).astype(np.int32),
        reward_slot=np.stack(reward_slots).astype(np.int32),
        num_slots=next_slot,
    )


def first_actions(tasks: TaskTables) -> Bool[np.ndarray, "S E A"]:
    """The primitive actions that may come next after each call in each state."""
    comes = dict(enumerate(np.eye(tasks.num_actions, dtype=bool)))
    firsts = np.zeros((tasks.ends.shape[1], len(tasks.edges), tasks.num_actions), dtype=bool)
    for subtask in tasks.bottom_up:
        edges = list(tasks.edges_of(subtask))
        for edge in edges:
            firsts[:, edge] = tasks.available[edge][:, None] & comes[tasks.edges[edge].child]
        comes[tasks.num_actions + subtask] = np.logical_or.reduce(firsts[:, edges], axis=1)
    return firsts


def actions_below(tasks: TaskTables, subtask: int) -> set[int]:
    """The primitive actions that a subtask, or what it calls, may take."""
    children = {edge.child for edge in tasks.edges if edge.subtask == subtask}
    actions = {child for child in children if child < tasks.num_actions}
    return actions.union(*(actions_below(tasks, child - tasks.num_actions) for child in children - actions))


def _answers(graph: TaskGraph, space: StateSpace | Shown) -> dict[Callable[[State], Array], np.ndarray]:
    """What each of the graph's functions answers in every state; all of them are one compilation."""
    asked = list(graph.rewards_see.values())
    for subtask in graph.subtasks:
        asked += [subtask.ends, *([subtask.pseudo_reward] if subtask.pseudo_reward else [])]
        asked += [ask for child in subtask.children for ask in (child.when, child.sees) if ask]
    asked = list(dict.fromkeys(asked))

    @jax.jit
    def ask_batch(states: State) -> list[Array]:
        return [jax.vmap(ask)(states) for ask in asked]

    batches = []
    for rows, states in state_batches(space):
        batches.append([np.asarray(answer)[: rows.stop - rows.start] for answer in ask_batch(states)])
    return {ask: np.concatenate(parts) for ask, parts in zip(asked, zip(*batches, strict=True), strict=True)}


def _classes(seen: np.ndarray | None, where: Bool[np.ndarray, " S"]) -> Int[np.ndarray, " N"]:
    """Numbers from 0 of the N states of `where`, alike for those where the same is seen; None for the whole state."""
    if seen is None:
        return np.arange(int(where.sum()))
    return np.unique(seen.reshape(len(where), -1)[where], axis=0, return_inverse=True)[1].reshape(-1)
