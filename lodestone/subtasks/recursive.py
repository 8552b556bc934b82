"""The exact values of a task graph, bottom up (Dietterich 2000, section 3).

A subtask is a semi-Markov decision process whose actions are its children. With a child's value V(a, s), what it leads
to F_a(s, x) = sum_N gamma^N Pr(it ends in x after N steps) and the completion C,

    Q(i, s, a) = V(a, s) + C(i, s, a)      C(i, s, a) = sum_x F_a(s, x) V(i, x)      V(i, x) = 0 where i has ended

Each subtask is solved for itself, its children being solved already: the result is *recursively* optimal. It need not
be the best that the graph allows, as a subtask does not know what it is done for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from lodestone.errors import InvalidTaskGraph
from lodestone.planning.solve import (
    CHOICE_TOLERANCE,
    check_discount,
    ends_surely,
    factorise,
    greedy_choices,
    iterate_values,
)
from lodestone.planning.tables import Tables, state_text
from lodestone.subtasks.task_graph import TaskTables, actions_below

ABSTRACTION_TOLERANCE = 1e-6
"""How far apart values may be that are stored as one."""


class HierarchyValues(NamedTuple):
    """What a policy for each subtask is worth; T subtasks, E edges, S states."""

    values: Float[np.ndarray, "T S"]
    """V(i, s): expected reward until the subtask ends, pseudo-rewards left out; 0 where it has ended, -inf where time
    is not discounted and it may never end."""
    completions: Float[np.ndarray, "E S"]
    """C(i, s, a); 0 where the call is not allowed."""
    inner_completions: Float[np.ndarray, "E S"]
    """C~(i, s, a): the same with the caller's pseudo-reward."""
    choices: Int[np.ndarray, "T S"]
    """The edge that each subtask takes; -1 where it has ended."""


class _Model(NamedTuple):
    """What running a child to its end brings."""

    rewards: Float[np.ndarray, " S"]
    leads_to: Float[np.ndarray, "S S"] | sparse.csr_array
    """F, with the discount of the time it takes."""


def recursive_optimum(
    tasks: TaskTables, tables: Tables, discount: float = 1.0, tolerance: float = 1e-9
) -> HierarchyValues:
    """Recursively optimal values and choices; of choices equally good the first is taken, as that changes what the
    caller gets. Memory: 8 S^2 bytes a subtask.

    Raises `InvalidConfig` for a discount outside [0, 1], and `InvalidTaskGraph` where a subtask may go on when the one
    that called it has ended: exact values would then depend on the caller.
    """
    return _bottom_up(tasks, tables, discount, None, tolerance)


def evaluate_choices(
    tasks: TaskTables, tables: Tables, choices: Int[np.ndarray, "T S"], discount: float = 1.0
) -> HierarchyValues:
    """Values of given choices, an edge for each subtask and state, -1 where it has ended.

    Raises what `recursive_optimum` raises.
    """
    return _bottom_up(tasks, tables, discount, choices, CHOICE_TOLERANCE)


def polled_policy(tasks: TaskTables, choices: Int[np.ndarray, "T S"]) -> Int[np.ndarray, " S"]:
    """The primitive action of each state where every step asks anew, from the root down (Dietterich 2000, section 6);
    0 where the root has ended."""
    states = np.arange(choices.shape[1])
    children = np.array([edge.child for edge in tasks.edges])
    node = np.full(len(states), tasks.num_actions)  # the root
    while (node >= tasks.num_actions).any():
        subtask = np.maximum(node - tasks.num_actions, 0)
        edge = choices[subtask, states]
        node = np.where(node < tasks.num_actions, node, np.where(edge >= 0, children[edge], 0))
    return node


def check_abstraction(tasks: TaskTables, tables: Tables, exact: HierarchyValues) -> None:
    """Raise `InvalidTaskGraph` unless all that is stored as one value is one value, for the choices of `exact`."""
    for number, name in enumerate(tasks.edge_names):
        slots = np.where(tasks.available[number], tasks.completion_slot[number], -2)
        for what, completions in (
            ("completion", exact.completions[number]),
            ("completion with the pseudo-reward", exact.inner_completions[number]),
        ):
            _require_alike(name, what, slots, np.where(slots == -1, 0.0, completions), completions, tables)
    rewards = tables.mean_rewards()
    for action in range(tasks.num_actions):
        slots = np.where(tasks.reward_slot[action] >= 0, tasks.reward_slot[action], -2)
        _require_alike(tasks.names[action], "reward", slots, rewards[:, action], rewards[:, action], tables)


def _require_alike(
    name: str,
    what: str,
    slots: Int[np.ndarray, " S"],
    wanted: Float[np.ndarray, " S"],
    values: Float[np.ndarray, " S"],
    tables: Tables,
) -> None:
    """`wanted` is what the first state of a slot, or a call that is final, would store."""
    _, first, back = np.unique(slots, return_index=True, return_inverse=True)
    stored = wanted[first][back]
    # Infinities are alike, too, and have no difference.
    alike = (values == stored) | (np.abs(np.nan_to_num(values) - np.nan_to_num(stored)) <= ABSTRACTION_TOLERANCE)
    wrong = (slots != -2) & ~alike
    if wrong.any():
        state = int(wrong.argmax())
        here = f"{values[state]:g} in {state_text(tables.space, state)}"
        if slots[state] == -1:
            raise InvalidTaskGraph(f"{name!r} is not final: its {what} is {here}.")
        raise InvalidTaskGraph(
            f"The abstraction of {name!r} is not safe: its {what} is {here}, but is stored together with "
            f"{stored[state]:g}, that of {state_text(tables.space, int(first[back][state]))}."
        )


def _bottom_up(
    tasks: TaskTables,
    tables: Tables,
    discount: float,
    choices: Int[np.ndarray, "T S"] | None,
    tolerance: float,
) -> HierarchyValues:
    check_discount(discount)
    _require_nested_ends(tasks, tables)
    rewards, matrix, size = tables.mean_rewards(), discount * tables.matrix(), tables.num_states
    models: dict[int, _Model] = {
        action: _Model(rewards[:, action], matrix[action * size : (action + 1) * size])
        for action in range(tasks.num_actions)
    }
    found = HierarchyValues(
        values=np.zeros((len(tasks.ends), size)),
        completions=np.zeros((len(tasks.edges), size)),
        inner_completions=np.zeros((len(tasks.edges), size)),
        choices=np.full((len(tasks.ends), size), -1),
    )
    for subtask in tasks.bottom_up:
        edges = tasks.edges_of(subtask)
        children = [models[tasks.edges[edge].child] for edge in edges]
        ends, live = tasks.ends[subtask], ~tasks.ends[subtask]
        allowed = tasks.available[list(edges)] & np.stack([np.isfinite(child.rewards) for child in children])
        if choices is None:
            best = _best(tasks, subtask, children, allowed, discount, tolerance)
        else:
            best = np.searchsorted(edges, choices[subtask])
        chosen = np.where(live & allowed.any(axis=0), best, -1)
        model = _run(children, chosen, ends, discount)
        models[tasks.num_actions + subtask] = model
        found.values[subtask] = np.where(ends, 0.0, model.rewards)
        found.choices[subtask] = np.where(live, np.asarray(edges)[best], -1)
        pseudo_rewards = tasks.pseudo_rewards[subtask]
        inner_values = np.where(ends, pseudo_rewards, model.rewards + model.leads_to @ pseudo_rewards)
        for edge, child in zip(edges, children, strict=True):
            for completions, following in (
                (found.completions, found.values[subtask]),
                (found.inner_completions, inner_values),
            ):
                completions[edge] = np.where(tasks.available[edge], _expect(child.leads_to, following), 0.0)
    return found


def _best(
    tasks: TaskTables,
    subtask: int,
    children: list[_Model],
    allowed: Bool[np.ndarray, "N S"],
    discount: float,
    tolerance: float,
) -> Int[np.ndarray, " S"]:
    """The best child of each state, pseudo-rewards counted."""

    def backup(values: Float[np.ndarray, " S"]) -> Float[np.ndarray, "N S"]:
        return np.stack([child.leads_to @ values for child in children])

    rewards = np.stack([child.rewards for child in children]) + backup(tasks.pseudo_rewards[subtask])
    _, values, _ = iterate_values(backup, rewards, allowed, tasks.ends[subtask], discount, tolerance)
    return greedy_choices(values.T)


def _run(
    children: list[_Model], chosen: Int[np.ndarray, " S"], ends: Bool[np.ndarray, " S"], discount: float
) -> _Model:
    """What a subtask brings that calls `chosen` (a position among its children, -1 for none) until it ends."""
    size = len(chosen)
    step, rewards = np.zeros((size, size)), np.full(size, -np.inf)
    for position, child in enumerate(children):
        rows = chosen == position
        picked = child.leads_to[rows]
        step[rows] = picked.toarray() if sparse.issparse(picked) else picked
        rewards[rows] = child.rewards[rows]
    going_on, ending = step * ~ends, step * ends
    sure = chosen >= 0
    if discount == 1:
        sure &= ends_surely(sparse.csr_array(going_on), ending.sum(axis=1) > 0)
    # A state that surely ends is followed by such states only, so the others can be left out.
    inside = np.flatnonzero(sure)
    # What has no chance must come out as exactly 0: else it would be taken for a risk.
    factors = factorise(sparse.csr_array(going_on[np.ix_(inside, inside)]))
    total, leads_to = np.full(size, -np.inf), np.zeros((size, size))
    total[inside] = factors.solve(rewards[inside])
    leads_to[inside] = factors.solve(ending[inside])
    return _Model(total, leads_to)


def _expect(
    leads_to: Float[np.ndarray, "S S"] | sparse.csr_array, values: Float[np.ndarray, " S"]
) -> Float[np.ndarray, " S"]:
    """F v, where an infinite loss that has no chance does no harm."""
    lost = np.isneginf(values)
    expected = leads_to @ np.where(lost, 0.0, values)
    return np.where(leads_to @ lost.astype(np.float64) > 0, -np.inf, expected)


def _require_nested_ends(tasks: TaskTables, tables: Tables) -> None:
    for number, edge in enumerate(tasks.edges):
        child = edge.child - tasks.num_actions
        if child < 0:
            continue
        actions = sorted(actions_below(tasks, child))
        reached = found = tasks.available[number]
        while found.any():
            following = np.zeros_like(reached)
            possible = tables.probs[np.ix_(found, actions)] > 0
            following[tables.successors[np.ix_(found, actions)][possible]] = True
            found = following & ~reached & ~tasks.ends[child]
            reached = reached | found
        outlived = reached & tasks.ends[edge.subtask]
        if outlived.any():
            caller = tasks.names[tasks.num_actions + edge.subtask]
            raise InvalidTaskGraph(
                f"Subtask {tasks.names[edge.child]!r} may go on when {caller!r}, which called it, has ended: in "
                f"{state_text(tables.space, int(outlived.argmax()))}. Let it end there, too."
            )
