"""The values of all calls of a state, from what is stored about them: V(i, s) = max over a of V(a, s) + C(i, s, a)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lodestone.subtasks.places import Places
from lodestone.subtasks.task_graph import TaskTables, first_actions


class Known(NamedTuple):
    """What is known about the resident of one place in a state; its calls are those of `Places.calls`."""

    value: Float[Array, ""]
    """V, pseudo-rewards left out: that of the call with the largest Q~, the first of equals."""
    inner_value: Float[Array, ""]
    """max Q~."""
    inner_calls: list[Float[Array, ""]]
    """Q~ of every call; -inf where there is none."""
    best: Int[Array, ""]
    """Which call has the largest Q~."""


Evaluate = Callable[
    [Float[Array, " slots"], Float[Array, " slots"], Bool[Array, "S A"] | None, Int[Array, ""]], list[Known]
]
"""(values, inner values, allowed actions, state) -> what is known about each place. The slots are those of
`TaskTables`; inner values are only looked at where a subtask has a pseudo-reward. Where actions are forbidden, there is
no call that leads to such actions only, as long as its caller has another; None where all are allowed."""


def evaluator(tasks: TaskTables, places: Places) -> Evaluate:
    """The function that evaluates a state, from the primitive actions up."""
    looked_up = [_looked_up(tasks, places, edges) for edges in places.calls]
    # What is looked up by the state is one row.
    rows = jnp.asarray(np.concatenate([column for columns in looked_up for column in columns], axis=1), dtype=jnp.int32)
    cuts = np.cumsum([column.shape[1] for columns in looked_up for column in columns])[:-1]
    callers = np.array([edge.subtask for edge in tasks.edges])

    def is_open(allowed: Bool[Array, " A"], state: Int[Array, ""]) -> Bool[Array, " E"]:
        firsts = jnp.asarray(first_actions(tasks))[state]
        leads = (firsts & jnp.broadcast_to(allowed, firsts.shape)).any(axis=1)
        leading = jnp.zeros(len(tasks.ends), dtype=bool).at[callers].max(leads)
        return leads | ~leading[callers]

    def evaluate(
        values: Float[Array, " slots"],
        inner_values: Float[Array, " slots"],
        allowed: Bool[Array, "S A"] | None,
        state: Int[Array, ""],
    ) -> list[Known]:
        known: list[Known] = []
        opened = None if allowed is None else is_open(allowed[state], state)
        row = iter(jnp.split(rows[state], cuts))
        # One number at a time rather than arrays of calls: the compiler makes one loop over seeds of it all.
        for place, columns in enumerate(looked_up):
            slots, reward_slots, child_places = next(row), next(row), next(row)
            value, inner_value, best, inner_calls = jnp.float32(0), jnp.float32(-jnp.inf), jnp.int32(0), []
            for number, possible in enumerate(columns.child_place.T):
                below = jnp.float32(0)
                for child_place in np.unique(possible):
                    child = values[reward_slots[number]] if child_place < 0 else known[child_place].value
                    below = jnp.where(child_places[number] == child_place, child, below)
                slot = slots[number]
                completion = inner_completion = jnp.where(slot >= 0, values[slot], 0.0)
                if places.otherwise[place]:
                    inner_completion = jnp.where(slot >= 0, inner_values[slot], 0.0)
                there = slot != FORBIDDEN
                if opened is not None:
                    there &= opened[jnp.asarray(places.calls[place])[state, number]]
                inner = jnp.where(there, below + inner_completion, -jnp.inf)
                better = inner > inner_value
                inner_value = jnp.where(better, inner, inner_value)
                value = jnp.where(better, below + completion, value)
                best = jnp.where(better, number, best)
                inner_calls.append(inner)
            known.append(Known(value, inner_value, inner_calls, best))
        return known

    return evaluate


FORBIDDEN = -2
"""In place of a slot: there is no such call."""


class _LookedUp(NamedTuple):
    """About the W calls of one place."""

    slot: Int[np.ndarray, "S W"]
    """Where the completion is stored; -1 where it is 0."""
    reward_slot: Int[np.ndarray, "S W"]
    """Where the reward of a primitive action is stored."""
    child_place: Int[np.ndarray, "S W"]
    """The place of a subtask; -1 for a primitive action."""


def _looked_up(tasks: TaskTables, places: Places, edges: Int[np.ndarray, "S W"]) -> _LookedUp:
    states = np.arange(len(edges))[:, None]
    child = np.array([edge.child for edge in tasks.edges])[edges]
    place = np.array([*[-1] * tasks.num_actions, *places.place_of])[child]
    there = edges >= 0
    return _LookedUp(
        slot=np.where(there, tasks.completion_slot[edges, states], FORBIDDEN),
        reward_slot=tasks.reward_slot[np.minimum(child, tasks.num_actions - 1), states],
        # Where there is no call, whatever others have: the fewer there are, the less has to be asked.
        child_place=np.where(there, place, np.where(there, place, -1).max(axis=0)),
    )
