"""Abstract machines as data: partial programs that leave choices open (Parr and Russell 1997).

A machine is a graph of named vertices. It takes a primitive action, calls another machine, leaves a choice open,
branches on the environment's state, or stops. Only actions take time. A hierarchy is one machine, the root, and all
that it may call; it says which policies are considered, and what is left open in it is learned or planned.

    Hierarchy("root", (
        Machine("root", "which", {
            "which": Choice({"left": "left", "fetch": "fetch"}),
            "left": Action("left", then="which"),
            "fetch": Call("fetch", then="which"),
        }),
        sequence("fetch", "down", "magnet-on", "up"),
    ))

Everything is frozen and hashable, so that equal machines are one machine to whatever remembers by machine. Nothing is
checked here but what would keep it from being data: `lodestone.machines.configurations.check` does the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from lodestone.envs.base import Environment
from lodestone.errors import InvalidMachine

Value = str | int
"""What a machine's parameter may stand for."""


@dataclass(frozen=True)
class Parameter:
    """In place of a value: whatever the machine was called with under this name."""

    name: str


Argument = Value | Parameter
Arguments = Mapping[str, Argument] | tuple[tuple[str, Argument], ...]
"""Arguments by name; kept as pairs."""
Edges = Mapping[str, str] | tuple[tuple[str, str], ...]
"""Names of vertices by the names of the edges that lead there; kept as pairs."""


@dataclass(frozen=True)
class Predicate:
    """A question about the environment's state, asked in no time."""

    function: Callable[..., Any]
    """function(environment, state, **arguments) -> bool or int, of one state, fit for `jax.vmap`. Defined at the top of
    a module, or it is a new predicate each time."""
    arguments: Arguments = ()

    def __post_init__(self) -> None:
        _keep_pairs(self, "arguments")


@dataclass(frozen=True)
class Action:
    """Take a primitive action, given by its name or by a parameter; None takes no action and no time."""

    action: str | Parameter | None
    then: str
    """The vertex that follows in the state that the action leads to."""


@dataclass(frozen=True)
class Call:
    """Run another machine until it stops."""

    machine: str
    then: str
    """The vertex that follows when it has stopped."""
    arguments: Arguments = ()

    def __post_init__(self) -> None:
        _keep_pairs(self, "arguments")


@dataclass(frozen=True)
class Choice:
    """What is left open: take any of the edges."""

    edges: Edges
    only_if: Mapping[str, Predicate] | tuple[tuple[str, Predicate], ...] = ()
    """Edges that may only be taken where a predicate holds; the others always may."""

    def __post_init__(self) -> None:
        _keep_pairs(self, "edges")
        _keep_pairs(self, "only_if")


@dataclass(frozen=True)
class Branch:
    """Go where the environment's state says."""

    on: Predicate
    edges: Mapping[int, str] | tuple[tuple[int, str], ...]
    """The vertex that follows each answer of the predicate; True is 1, False is 0."""

    def __post_init__(self) -> None:
        _keep_pairs(self, "edges")


@dataclass(frozen=True)
class Stop:
    """Return to the caller; in the root, end the episode."""


Vertex = Action | Call | Choice | Branch | Stop


@dataclass(frozen=True)
class Machine:
    """One machine."""

    name: str
    start: str
    """The vertex where it begins."""
    vertices: Mapping[str, Vertex] | tuple[tuple[str, Vertex], ...]
    """Its vertices by name; kept as pairs."""
    parameters: tuple[str, ...] = ()
    """Names that a call must give arguments for."""

    def __post_init__(self) -> None:
        _keep_pairs(self, "vertices")


@dataclass(frozen=True)
class Hierarchy:
    """A root machine and everything that it may call."""

    root: str
    """Name of the machine where an episode begins; it has no parameters."""
    machines: tuple[Machine, ...]


def sequence(name: str, *actions: str | Parameter, parameters: tuple[str, ...] = ()) -> Machine:
    """A machine that takes the actions one after the other and stops."""
    names = [f"{number}: {_text(action)}" for number, action in enumerate(actions, 1)] + ["stop"]
    steps = {names[number]: Action(action, then=names[number + 1]) for number, action in enumerate(actions)}
    return Machine(name, names[0], {**steps, "stop": Stop()}, parameters)


def every_action(environment: Environment) -> Hierarchy:
    """The machine that leaves everything open: one choice over all primitive actions, for ever.

    Its hierarchically optimal policy is the optimal policy.
    """
    actions = environment.action_names
    steps: dict[str, Vertex] = {action: Action(action, then="choose") for action in actions}
    choose = Choice({action: action for action in actions})
    return Hierarchy("any action", (Machine("any action", "choose", {"choose": choose, **steps}),))


Key = TypeVar("Key")
Item = TypeVar("Item")


def pairs(given: Mapping[Key, Item] | Iterable[tuple[Key, Item]]) -> tuple[tuple[Key, Item], ...]:
    """Pairs of what was given as a mapping or as pairs."""
    return tuple((key, item) for key, item in (given.items() if isinstance(given, Mapping) else given))


def followers(vertex: Vertex) -> tuple[tuple[str, str], ...]:
    """The edges of a vertex inside its machine: label and name of the vertex that follows. After a call it is where the
    call returns to."""
    match vertex:
        case Action(_, then) | Call(_, then):
            return (("", then),)
        case Choice(edges):
            return pairs(edges)
        case Branch(_, labelled):
            return tuple((str(label), then) for label, then in pairs(labelled))
    return ()


def _text(action: str | Parameter) -> str:
    return action.name if isinstance(action, Parameter) else action


def _keep_pairs(item: Any, field: str) -> None:
    """Replace a mapping by its pairs, which have a hash."""
    try:
        kept = pairs(getattr(item, field))
        hash(kept)
    except (TypeError, ValueError):
        raise InvalidMachine(
            f"The {field} of a {type(item).__name__} must be a mapping or pairs of plain values, but are "
            f"{getattr(item, field)!r}."
        ) from None
    object.__setattr__(item, field, kept)
