"""Where a hierarchy of machines can be: its configurations, which are whole call stacks.

A configuration is a vertex of a machine, the arguments that the machine was called with, and the configuration of the
call that it will return to. Its future depends on nothing else, so a learner that tells configurations apart, and not
only vertices, never mixes two call sites whose continuations differ.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import NamedTuple, cast

from lodestone.envs.base import Environment
from lodestone.errors import InvalidMachine
from lodestone.machines.machine import (
    Action,
    Argument,
    Branch,
    Call,
    Choice,
    Hierarchy,
    Machine,
    Parameter,
    Predicate,
    Stop,
    Value,
    Vertex,
    followers,
    pairs,
)

MAX_CONFIGURATIONS = 100_000
"""More call stacks than any machine that is written by hand has."""

END = -1
"""What follows the root's stop."""
ROOT = -1
"""The caller of the root."""


class Configuration(NamedTuple):
    """One configuration; those of the callers are found by following `caller`."""

    machine: str
    arguments: tuple[tuple[str, Value], ...]
    """What the machine was called with, in the order of its parameters."""
    vertex: str
    caller: int
    """Number of the configuration whose call is running; `ROOT` for the root machine."""


class Configurations(NamedTuple):
    """All configurations that the graph of the machines allows, numbered in the order of a breadth-first search from
    the start. C in all."""

    hierarchy: Hierarchy
    configurations: tuple[Configuration, ...]
    vertices: tuple[Vertex, ...]
    """The vertex of each, with values in place of parameters."""
    followers: tuple[tuple[int, ...], ...]
    """For each, the configurations that may follow, in the order of its edges: an action's and a choice's and a
    branch's by their vertices, a call's is the start of the machine called, a stop's is where the call returns to, or
    `END`."""
    passing_order: tuple[int, ...]
    """All, such that whatever follows one in no time comes before it."""
    choices_in_a_row: int
    """How many choices may follow one another in no time; at least 1."""

    @property
    def size(self) -> int:
        """C."""
        return len(self.configurations)

    def text(self, number: int) -> str:
        """A configuration for a person to read, the root first, such as `root.get > get.walk > walk(to=R).which`."""
        frames = []
        while number != ROOT:
            machine, arguments, vertex, caller = self.configurations[number]
            given = f"({', '.join(f'{name}={value}' for name, value in arguments)})" if arguments else ""
            frames.append(f"{machine}{given}.{vertex}")
            number = caller
        return " > ".join(reversed(frames))


def takes_time(vertex: Vertex) -> bool:
    """Whether a vertex takes a primitive step; all others take no time."""
    return isinstance(vertex, Action) and vertex.action is not None


def check(hierarchy: Hierarchy, environment: Environment) -> None:
    """Raise `InvalidMachine` where a hierarchy is not well formed or not made for this environment.

    What only shows in the environment's states, a branch without an edge for an answer and a choice with no edge to
    take, is found by `lodestone.planning.joint.joint_process`.
    """
    found = configurations(hierarchy)
    known = environment.action_names
    for number, vertex in enumerate(found.vertices):
        if isinstance(vertex, Action) and vertex.action is not None and vertex.action not in known:
            raise InvalidMachine(
                f"{found.text(number)} takes the action {vertex.action!r}, but the environment has only "
                f"{', '.join(known)}."
            )


def configurations(hierarchy: Hierarchy, limit: int = MAX_CONFIGURATIONS) -> Configurations:
    """Enumerate the configurations; remembered for the last few hierarchies.

    Raises `InvalidMachine` where a name does not exist or exists twice, a vertex or a machine is not reachable,
    arguments are not the parameters, a vertex has no edges, a machine may call itself while it runs, the machines may
    run on for ever without an action, or there are more than `limit` configurations.
    """
    return _configurations(hierarchy, limit)


@lru_cache(maxsize=16)
def _configurations(hierarchy: Hierarchy, limit: int) -> Configurations:
    machines = _checked(hierarchy)
    start = Configuration(hierarchy.root, (), machines[hierarchy.root].start, ROOT)
    vertices_of = {name: dict(pairs(machine.vertices)) for name, machine in machines.items()}
    numbers, found = {start: 0}, [start]
    vertices: list[Vertex] = []
    following: list[tuple[int, ...]] = []

    def number_of(configuration: Configuration) -> int:
        if configuration not in numbers:
            if len(found) >= limit:
                raise InvalidMachine(
                    f"The machines have more than {limit:,} configurations, which are whole call stacks; call fewer "
                    "machines from fewer places."
                )
            numbers[configuration] = len(found)
            found.append(configuration)
        return numbers[configuration]

    for number, configuration in enumerate(found):  # the list grows meanwhile
        machine, arguments, name, caller = configuration
        vertex = _resolved(vertices_of[machine][name], dict(arguments))
        vertices.append(vertex)
        nexts: list[int] = []
        match vertex:
            case Call(callee, _, given):
                values = dict(pairs(given))
                called = tuple((parameter, cast(Value, values[parameter])) for parameter in machines[callee].parameters)
                _refuse_recursion(found, number, callee, called)
                nexts = [number_of(Configuration(callee, called, machines[callee].start, number))]
            case Stop() if caller == ROOT:
                nexts = [END]
            case Stop():
                back, call = found[caller], vertices[caller]
                assert isinstance(call, Call)
                nexts = [number_of(back._replace(vertex=call.then))]
            case _:
                nexts = [number_of(configuration._replace(vertex=then)) for _, then in followers(vertex)]
        following.append(tuple(nexts))

    result = Configurations(hierarchy, tuple(found), tuple(vertices), tuple(following), (), 1)
    order = _passing_order(result)
    return result._replace(passing_order=order, choices_in_a_row=_choices_in_a_row(result, order))


def _resolved(vertex: Vertex, values: dict[str, Value]) -> Vertex:
    """The vertex with values in place of its machine's parameters."""

    def value(argument: Argument) -> Value:
        return values[argument.name] if isinstance(argument, Parameter) else argument

    def asked(predicate: Predicate) -> Predicate:
        return Predicate(
            predicate.function, tuple((name, value(argument)) for name, argument in pairs(predicate.arguments))
        )

    match vertex:
        case Action(Parameter(name), then):
            return Action(cast(str, values[name]), then)  # `check` refuses what is no action
        case Call(machine, then, arguments):
            return Call(machine, then, tuple((name, value(argument)) for name, argument in pairs(arguments)))
        case Choice(edges, only_if):
            return Choice(edges, tuple((name, asked(predicate)) for name, predicate in pairs(only_if)))
        case Branch(predicate, edges):
            return Branch(asked(predicate), edges)
    return vertex


def _refuse_recursion(found: list[Configuration], number: int, callee: str, called: tuple) -> None:
    """A machine that runs below itself with the same arguments does so again and again: its stacks have no bound."""
    while number != ROOT:
        if found[number][:2] == (callee, called):
            raise InvalidMachine(
                f"Machine {callee!r} may call itself while it runs, so that its call stacks grow without bound."
            )
        number = found[number].caller


def _passing_order(result: Configurations) -> tuple[int, ...]:
    """A topological order of what follows in no time. Raises `InvalidMachine` where there is a cycle."""
    before: list[list[int]] = [[] for _ in range(result.size)]
    open_edges = [0] * result.size
    for number, vertex in enumerate(result.vertices):
        if not takes_time(vertex):
            nexts = {following for following in result.followers[number] if following != END}
            open_edges[number] = len(nexts)
            for following in nexts:
                before[following].append(number)
    order = [number for number in range(result.size) if open_edges[number] == 0]
    for number in order:  # the list grows meanwhile
        for earlier in before[number]:
            open_edges[earlier] -= 1
            if open_edges[earlier] == 0:
                order.append(earlier)
    if len(order) < result.size:
        # From any configuration that is left, another one that is left follows: walk until one comes again.
        walk: dict[int, int] = {}
        here = next(number for number in range(result.size) if open_edges[number])
        while here not in walk:
            walk[here] = len(walk)
            here = next(each for each in result.followers[here] if each != END and open_edges[each])
        cycle = [result.text(number) for number in list(walk)[walk[here] :]]
        shown = cycle if len(cycle) <= 5 else [*cycle[:4], f"{len(cycle) - 4} more"]
        raise InvalidMachine(
            f"The machines may run on for ever without taking time: {', then '.join(shown)}, and again."
        )
    return tuple(order)


def _choices_in_a_row(result: Configurations, order: tuple[int, ...]) -> int:
    """The most choices on a path that takes no time."""
    most = [0] * result.size
    for number in order:
        vertex = result.vertices[number]
        if not takes_time(vertex):
            nexts = [most[following] for following in result.followers[number] if following != END]
            most[number] = max(nexts, default=0) + isinstance(vertex, Choice)
    return max(1, max(most))


def _checked(hierarchy: Hierarchy) -> dict[str, Machine]:
    """The machines by name. Raises `InvalidMachine` where one of them is not well formed by itself."""
    machines = {machine.name: machine for machine in hierarchy.machines}
    if len(machines) < len(hierarchy.machines):
        raise InvalidMachine(f"Machines need different names, but these were given: {_names(hierarchy.machines)}.")
    if hierarchy.root not in machines:
        raise InvalidMachine(f"There is no root machine named {hierarchy.root!r} among {_names(hierarchy.machines)}.")
    if machines[hierarchy.root].parameters:
        raise InvalidMachine(
            f"The root machine {hierarchy.root!r} has parameters, but nothing calls it with arguments."
        )
    for machine in hierarchy.machines:
        _check_vertices(machine)
        for name, vertex in pairs(machine.vertices):
            _check_vertex(f"{machine.name}.{name}", vertex, machine, machines)
    _check_called(hierarchy.root, machines)
    return machines


def _check_vertices(machine: Machine) -> None:
    vertices = dict(pairs(machine.vertices))
    if len(vertices) < len(pairs(machine.vertices)):
        raise InvalidMachine(f"Two vertices of machine {machine.name!r} have the same name.")
    if len(set(machine.parameters)) < len(machine.parameters):
        raise InvalidMachine(f"Two parameters of machine {machine.name!r} have the same name.")
    for name, vertex in vertices.items():
        if not isinstance(vertex, Vertex):
            raise InvalidMachine(f"{machine.name}.{name} is {vertex!r}, which is no kind of vertex.")
    if machine.start not in vertices:
        raise InvalidMachine(f"Machine {machine.name!r} begins at {machine.start!r}, which is none of its vertices.")
    reached, frontier = {machine.start}, [machine.start]
    for name in frontier:  # the list grows meanwhile
        for label, then in followers(vertices[name]):
            if then not in vertices:
                where = f"edge {label!r} of {machine.name}.{name}" if label else f"{machine.name}.{name}"
                raise InvalidMachine(f"The {where} leads to {then!r}, which is no vertex of machine {machine.name!r}.")
            if then not in reached:
                reached.add(then)
                frontier.append(then)
    for name in vertices:
        if name not in reached:
            raise InvalidMachine(f"Nothing leads to vertex {name!r} of machine {machine.name!r}.")


def _check_vertex(where: str, vertex: Vertex, machine: Machine, machines: dict[str, Machine]) -> None:
    match vertex:
        case Call(name, _, arguments):
            if name not in machines:
                raise InvalidMachine(f"{where} calls {name!r}, but there is no such machine.")
            given, wanted = [argument for argument, _ in pairs(arguments)], machines[name].parameters
            if sorted(given) != sorted(wanted):
                raise InvalidMachine(
                    f"{where} calls {name!r} with {_listed(given)}, but the parameters of that machine are "
                    f"{_listed(wanted)}."
                )
        case Choice(edges, only_if):
            _check_labels(where, [label for label, _ in pairs(edges)])
            _check_labels(where, [label for label, _ in pairs(only_if)], may_be_empty=True)
            for label, _ in pairs(only_if):
                if label not in dict(pairs(edges)):
                    raise InvalidMachine(f"{where} has a predicate for {label!r}, which is none of its edges.")
        case Branch(_, answers):
            labels = [label for label, _ in pairs(answers)]
            _check_labels(where, labels)
            if not all(isinstance(label, int) for label in labels):
                raise InvalidMachine(
                    f"The labels of a branch are bools or integers, but {where} has {_listed(labels)}."
                )
    for argument in _arguments(vertex):
        if isinstance(argument, Parameter) and argument.name not in machine.parameters:
            raise InvalidMachine(f"{where} uses {argument.name!r}, which is no parameter of machine {machine.name!r}.")
    for predicate in _predicates(vertex):
        try:
            inspect.signature(predicate.function).bind(None, None, **dict(pairs(predicate.arguments)))
        except TypeError as error:
            name = getattr(predicate.function, "__name__", repr(predicate.function))
            raise InvalidMachine(
                f"{where} asks {name} with the environment, a state and {_listed(dict(pairs(predicate.arguments)))}, "
                f"but it does not take these: {error}."
            ) from None


def _check_labels(where: str, labels: list, may_be_empty: bool = False) -> None:
    if not labels and not may_be_empty:
        raise InvalidMachine(f"{where} has no edges.")
    if len(set(labels)) < len(labels):
        raise InvalidMachine(f"{where} has two edges of the same name.")


def _check_called(root: str, machines: dict[str, Machine]) -> None:
    """Every machine is called by one that is called."""
    called, frontier = {root}, [root]
    for name in frontier:  # the list grows meanwhile
        for _, vertex in pairs(machines[name].vertices):
            if isinstance(vertex, Call) and vertex.machine not in called:
                called.add(vertex.machine)
                frontier.append(vertex.machine)
    for name in machines:
        if name not in called:
            raise InvalidMachine(f"Nothing calls machine {name!r}.")


def _predicates(vertex: Vertex) -> Iterator[Predicate]:
    match vertex:
        case Choice(_, only_if):
            yield from (predicate for _, predicate in pairs(only_if))
        case Branch(predicate, _):
            yield predicate


def _arguments(vertex: Vertex) -> Iterator[object]:
    """Every place of a vertex where a parameter may stand."""
    match vertex:
        case Action(action, _):
            yield action
        case Call(_, _, arguments):
            yield from (argument for _, argument in pairs(arguments))
    for predicate in _predicates(vertex):
        yield from (argument for _, argument in pairs(predicate.arguments))


def _names(machines: tuple[Machine, ...]) -> str:
    return ", ".join(repr(machine.name) for machine in machines)


def _listed(names: Iterable[object]) -> str:
    return ", ".join(map(str, names)) or "no arguments"
