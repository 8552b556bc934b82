"""Where the machines of a hierarchy next choose or act, in every numbered state of an environment.

What takes no time, calls, returns and branches, is resolved here. A place is a *pair* of a state and a configuration,
given as state * C + configuration; -1 is the end of the episode.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from lodestone.envs.base import Environment
from lodestone.envs.host import Shown
from lodestone.envs.state_space import StateSpace
from lodestone.errors import InvalidMachine, TooManyStates
from lodestone.machines.configurations import END, Configurations, check, configurations, takes_time
from lodestone.machines.machine import Action, Branch, Choice, Hierarchy, Predicate, pairs
from lodestone.planning.tables import state_batches, state_text
from lodestone.types import State

MAX_PAIRS = 200_000_000
"""Environment states times configurations, reachable or not: four bytes each while the joint states are found."""


class Machines(NamedTuple):
    """The configurations over S states, as arrays: C configurations, F edges at most, P lists of answers."""

    configurations: Configurations
    space: StateSpace | Shown
    terminal: Bool[np.ndarray, " S"]
    """Where the episode is over, whatever the machines do."""
    following: Int[np.ndarray, "C F"]
    """What follows along each edge; `END` also where there is no such edge."""
    passes: Bool[np.ndarray, " C"]
    """Which take no time and leave no choice."""
    is_choice: Bool[np.ndarray, " C"]
    action: Int[np.ndarray, " C"]
    """The primitive action; -1 for what takes none."""
    branch: Int[np.ndarray, " C"]
    """The row of `answers` that a branch goes by; -1 for what is none."""
    condition: Int[np.ndarray, "C F"]
    """The row of `answers` that tells whether an edge of a choice may be taken; -1 where it always may, and -2 where
    there is no such edge."""
    answers: Int[np.ndarray, "P S"]
    """In each state of the environment, the edge of a branch, or -1 if it has none; or whether a predicate holds."""

    def text(self, state: int, configuration: int) -> str:
        """A pair for a person to read."""
        return f"{self.configurations.text(int(configuration))} where {state_text(self.space, int(state))}"


class Choices(NamedTuple):
    """What N choices leave open; the fields are those of `JointProcess`."""

    edges: Int[np.ndarray, "N U"]
    available: Bool[np.ndarray, "N U"]
    names: tuple[str, ...]
    name: Int[np.ndarray, "N U"]


def machines_over(
    environment: Environment, hierarchy: Hierarchy, space: StateSpace | Shown, terminal: Bool[np.ndarray, " S"]
) -> Machines:
    """The hierarchy in these states, which must be those of the environment.

    Raises `InvalidMachine` as `lodestone.machines.configurations.check` does, and `TooManyStates`.
    """
    check(hierarchy, environment)
    found = configurations(hierarchy)
    if space.size * found.size > MAX_PAIRS:
        raise TooManyStates(
            f"{space.size:,} states times {found.size:,} configurations are more than {MAX_PAIRS:,}, which is "
            "as many as joint states are looked for among."
        )

    width = max(map(len, found.followers))
    following = np.full((found.size, width), END)
    branch, condition = np.full(found.size, -1), np.full((found.size, width), -2)
    rows: dict[tuple[Predicate, tuple[int, ...] | None], int] = {}
    for number, vertex in enumerate(found.vertices):
        following[number, : len(found.followers[number])] = found.followers[number]
        if isinstance(vertex, Branch):
            labels = tuple(int(label) for label, _ in pairs(vertex.edges))
            branch[number] = rows.setdefault((vertex.on, labels), len(rows))
        if isinstance(vertex, Choice):
            conditions = dict(pairs(vertex.only_if))
            for edge, (name, _) in enumerate(pairs(vertex.edges)):
                needed = conditions.get(name)
                condition[number, edge] = -1 if needed is None else rows.setdefault((needed, None), len(rows))

    asked = {predicate: _ask_everywhere(environment, space, predicate) for predicate in {key[0] for key in rows}}
    answers = np.zeros((max(len(rows), 1), space.size), dtype=np.int32)
    for (predicate, edge_labels), row in rows.items():
        if edge_labels is None:
            answers[row] = asked[predicate] != 0
        else:
            answers[row] = -1
            for edge, label in enumerate(edge_labels):
                answers[row][asked[predicate] == label] = edge
    is_choice = np.array([isinstance(vertex, Choice) for vertex in found.vertices])
    passes = np.array([not takes_time(vertex) for vertex in found.vertices]) & ~is_choice
    action = np.array(
        [
            environment.action_names.index(vertex.action) if isinstance(vertex, Action) and takes_time(vertex) else -1
            for vertex in found.vertices
        ]
    )
    return Machines(found, space, terminal, following, passes, is_choice, action, branch, condition, answers)


def reach(
    machines: Machines,
    begins: Int[np.ndarray, " I"],
    after_action: Callable[[Int[np.ndarray, " B"], Int[np.ndarray, " B"]], Int[np.ndarray, "..."]],
) -> Int[np.ndarray, " J"]:
    """The pairs that can be reached from those that episodes begin at, the choices first, each kind in the order of the
    search; `after_action(state, configuration)` are the pairs that some actions may lead to."""
    size = machines.configurations.size
    known = np.zeros(machines.space.size * size, dtype=bool)
    levels: list[Int[np.ndarray, " B"]] = [np.zeros(0, np.int64)]
    frontier = begins
    while True:
        frontier = np.unique(frontier[frontier >= 0])
        frontier = frontier[~known[frontier]]
        if not len(frontier):
            break
        known[frontier] = True
        levels.append(frontier)
        state, configuration = np.divmod(frontier, size)
        choosing = machines.is_choice[configuration]
        chosen = after_choice(machines, state[choosing], configuration[choosing])
        acted = after_action(state[~choosing], configuration[~choosing])
        frontier = np.concatenate([chosen.ravel(), acted.ravel()])
    pair = np.concatenate(levels)
    return pair[np.argsort(~machines.is_choice[pair % size], kind="stable")]


def numbers_of(machines: Machines, pair: Int[np.ndarray, " J"]) -> Int[np.ndarray, " pairs"]:
    """The number of each pair among these; the end, -1, is the last of all, and has the number J."""
    number = np.full(machines.space.size * machines.configurations.size + 1, len(pair), dtype=np.int32)
    number[pair] = np.arange(len(pair))
    return number


def choices_of(
    machines: Machines, state: Int[np.ndarray, " N"], configuration: Int[np.ndarray, " N"], number: Int[np.ndarray, "*"]
) -> Choices:
    """What these choices leave open. Raises `InvalidMachine` where no edge of one may be taken."""
    edges = number[after_choice(machines, state, configuration)]
    conditions = machines.condition[configuration, : edges.shape[1]]
    held = machines.answers[np.maximum(conditions, 0), state[:, None]] > 0
    available = (conditions == -1) | ((conditions >= 0) & held)
    if not available.any(axis=1).all():
        stuck = int(np.argmin(available.any(axis=1)))
        raise InvalidMachine(f"No edge may be taken in {machines.text(state[stuck], configuration[stuck])}.")

    vertices = machines.configurations.vertices
    names = dict.fromkeys(name for vertex in vertices if isinstance(vertex, Choice) for name, _ in pairs(vertex.edges))
    position = {name: index for index, name in enumerate(names)}
    name_of = np.zeros_like(machines.following)
    for each, vertex in enumerate(vertices):
        if isinstance(vertex, Choice):
            name_of[each, : len(vertex.edges)] = [position[name] for name, _ in pairs(vertex.edges)]
    name = name_of[configuration, : edges.shape[1]].astype(np.int32)
    return Choices(edges, available, tuple(names), name)


def after_choice(
    machines: Machines, state: Int[np.ndarray, " B"], configuration: Int[np.ndarray, " B"]
) -> Int[np.ndarray, "B U"]:
    """Pair that every edge of some choices leads to; -1 for the end, where it may not be taken or does not exist."""
    widths = (machines.condition > -2).sum(axis=1)[machines.is_choice]
    width = int(max(widths, default=1))
    conditions = machines.condition[configuration, :width]
    taken = (conditions == -1) | (machines.answers[np.maximum(conditions, 0), state[:, None]] > 0) & (conditions >= 0)
    following = np.where(taken, machines.following[configuration, :width], END)
    states = np.broadcast_to(state[:, None], following.shape)
    return land(machines, states.ravel(), following.ravel()).reshape(following.shape)


def land(
    machines: Machines, state: Int[np.ndarray, " B"], configuration: Int[np.ndarray, " B"]
) -> Int[np.ndarray, " B"]:
    """The pairs, state * C + configuration, where the machines next choose or act in these states; -1 for the end."""
    here = np.where(machines.terminal[state], END, configuration)
    moving = np.flatnonzero((here != END) & machines.passes[here])
    while len(moving):
        at, among = here[moving], state[moving]
        row = machines.branch[at]
        edge = np.where(row >= 0, machines.answers[np.maximum(row, 0), among], 0)
        if (edge < 0).any():
            stuck = int(np.argmax(edge < 0))
            raise InvalidMachine(
                f"The predicate of a branch has an answer without an edge in {machines.text(among[stuck], at[stuck])}."
            )
        here[moving] = machines.following[at, edge]
        moving = moving[(here[moving] != END) & machines.passes[here[moving]]]
    return np.where(here == END, -1, state.astype(np.int64) * machines.configurations.size + here)


def _ask_everywhere(environment: Environment, space: StateSpace | Shown, predicate: Predicate) -> Int[np.ndarray, " S"]:
    """What a predicate answers in every state. Raises `InvalidMachine` where that is not one bool or integer."""
    arguments = dict(pairs(predicate.arguments))

    @jax.jit
    def ask(states: State) -> Array:
        return jax.vmap(lambda state: jnp.asarray(predicate.function(environment, state, **arguments)))(states)

    answers = []
    for rows, states in state_batches(space):
        answers.append(np.asarray(ask(states))[: rows.stop - rows.start])
    answer = np.concatenate(answers)
    if answer.ndim != 1 or not (answer.dtype == bool or np.issubdtype(answer.dtype, np.integer)):
        raise InvalidMachine(
            f"{predicate.function.__name__} must answer with one bool or integer, but answers with "
            f"{answer.dtype} {list(answer.shape[1:])}."
        )
    return answer.astype(np.int32)
