"""A task graph as a hierarchy of abstract machines: the same programs, judged as a whole.

Each subtask becomes a machine that calls one of its children again and again until it is over. The best policy of the
machines is the *hierarchically* optimal one, the best that the graph allows, where each subtask knows from its call
stack what it is done for. Pseudo-rewards play no part in it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from jaxtyping import Array, Bool

from lodestone.envs.base import Environment
from lodestone.machines.machine import Action, Branch, Call, Choice, Hierarchy, Machine, Predicate, Stop, Vertex
from lodestone.subtasks.task_graph import Subtask, TaskGraph
from lodestone.types import State


@dataclass(frozen=True)
class _Allowed:
    """Whether a call is allowed, as a predicate of machines."""

    when: Callable[[State], Bool[Array, ""]] | None
    ends: Callable[[State], Bool[Array, ""]] | None
    """Of the subtask that is called; None for an action."""

    __name__ = "whether the call is allowed"

    def __call__(self, environment: Environment, state: State) -> Any:
        del environment
        allowed = self.when is None or self.when(state)
        return allowed if self.ends is None else allowed & ~self.ends(state)


@dataclass(frozen=True)
class _Over:
    """Whether a subtask has ended, as a predicate of machines."""

    ends: Callable[[State], Bool[Array, ""]]

    __name__ = "whether the subtask has ended"

    def __call__(self, environment: Environment, state: State) -> Any:
        del environment
        return self.ends(state)


def as_machines(graph: TaskGraph) -> Hierarchy:
    """One machine for each subtask; a subtask ends its calls before it is asked whether it is over itself."""
    subtasks = {subtask.name: subtask for subtask in graph.subtasks}
    return Hierarchy(graph.subtasks[0].name, tuple(_machine(subtask, subtasks) for subtask in graph.subtasks))


def _machine(subtask: Subtask, subtasks: dict[str, Subtask]) -> Machine:
    calls: dict[str, Vertex] = {}
    only_if = {}
    for child in subtask.children:
        callee = subtasks.get(child.name)
        calls[child.name] = Call(child.name, then="over?") if callee else Action(child.name, then="over?")
        if callee or child.when:
            only_if[child.name] = Predicate(_Allowed(child.when, callee.ends if callee else None))
    return Machine(
        subtask.name,
        start="which",  # nothing is called where it has ended
        vertices={
            "over?": Branch(Predicate(_Over(subtask.ends)), {True: "stop", False: "which"}),
            "which": Choice({name: name for name in calls}, only_if),
            **calls,
            "stop": Stop(),
        },
    )
