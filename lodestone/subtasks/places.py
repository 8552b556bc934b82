"""What may be going on in each state, laid out for a learner that looks at all calls of a state at once.

Subtasks that never run in the same state share a *place*, as a call's place is always below its caller's: of the taxi's
four ways to navigate only the one to where the passenger waits, or wants to go, can be running, and three places serve
seven subtasks. Whatever is running is known by state and place.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from lodestone.planning.tables import Tables
from lodestone.subtasks.task_graph import TaskTables, actions_below


class Places(NamedTuple):
    """The places of T subtasks over S states; P places, the root's is the last."""

    place_of: tuple[int, ...]
    """Of each subtask."""
    resident: Int[np.ndarray, "S P"]
    """The subtask that may be running in a state at a place, and has not ended there; -1 for none."""
    calls: tuple[Int[np.ndarray, "S W"], ...]
    """For each place, the edges that its resident may take, in the order of its children, filled up with -1. W is as
    many as there are in any state."""
    otherwise: tuple[bool, ...]
    """For each place, whether a resident acts by a pseudo-reward."""


def arrange(tasks: TaskTables, running: Bool[np.ndarray, "T S"]) -> Places:
    """Places for subtasks that may be running where `running` says, and never where they have ended."""
    place_of: dict[int, int] = {}
    taken: list[Bool[np.ndarray, " S"]] = []
    for subtask in tasks.bottom_up:
        children = [tasks.edges[number].child - tasks.num_actions for number in tasks.edges_of(subtask)]
        place = 1 + max((place_of[child] for child in children if child >= 0), default=-1)
        while place < len(taken) and (taken[place] & running[subtask]).any():
            place += 1
        if place == len(taken):
            taken.append(np.zeros(running.shape[1], dtype=bool))
        place_of[subtask] = place
        taken[place] = taken[place] | running[subtask]

    resident = np.full((running.shape[1], len(taken)), -1, dtype=np.int32)
    for subtask, place in place_of.items():
        resident[running[subtask], place] = subtask
    caller = np.array([edge.subtask for edge in tasks.edges])
    calls = []
    for here in resident.T:
        possible = (tasks.available & (here == caller[:, None])).T
        first = np.argsort(~possible, axis=1, kind="stable")[:, : possible.sum(axis=1).max()]
        calls.append(np.where(np.take_along_axis(possible, first, axis=1), first, -1).astype(np.int32))
    return Places(
        place_of=tuple(place_of[subtask] for subtask in range(len(tasks.ends))),
        resident=resident,
        calls=tuple(calls),
        otherwise=tuple(bool(tasks.pseudo_rewards[np.unique(here[here >= 0])].any()) for here in resident.T),
    )


def may_be_running(tasks: TaskTables, tables: Tables) -> Bool[np.ndarray, "T S"]:
    """Where each subtask may be running, and has not ended, in an episode that begins where episodes do: it was called
    there, or was running before a step of one of the actions that it, or what it calls, may take."""
    running = np.zeros_like(tasks.ends)
    running[0] = tables.initial_probs > 0
    actions = [sorted(actions_below(tasks, subtask)) for subtask in range(len(tasks.ends))]
    while True:
        found = running.copy()
        for subtask, below in enumerate(actions):
            for number in tasks.edges_of(subtask):
                if tasks.edges[number].child >= tasks.num_actions:
                    found[tasks.edges[number].child - tasks.num_actions] |= found[subtask] & tasks.available[number]
            rows = np.ix_(found[subtask], below)
            found[subtask][tables.successors[rows][tables.probs[rows] > 0]] = True
        found &= ~tasks.ends
        if (found == running).all():
            return found
        running = found
