"""Machines run one vertex at a time by a plain interpreter, and random machines to run: a second implementation."""

from __future__ import annotations

from functools import cache

import numpy as np

from lodestone.machines.machine import (
    Action,
    Branch,
    Call,
    Choice,
    Hierarchy,
    Machine,
    Parameter,
    Predicate,
    Stop,
    followers,
    pairs,
)
from lodestone.planning.tables import Tables


class Interpreter:
    """A hierarchy in an environment. A stack is a tuple of frames (machine, arguments, vertex), the root first."""

    def __init__(self, environment, tables: Tables, hierarchy: Hierarchy) -> None:
        self.environment, self.tables, self.hierarchy = environment, tables, hierarchy
        self.machines = {machine.name: machine for machine in hierarchy.machines}
        self.ask = cache(self._ask)

    def _ask(self, predicate: Predicate, frame_arguments, state: int) -> int:
        values = dict(frame_arguments)
        arguments = {
            name: values[item.name] if isinstance(item, Parameter) else item
            for name, item in pairs(predicate.arguments)
        }
        return int(predicate.function(self.environment, self.tables.space.state(np.int32(state)), **arguments))

    def start(self, state: int):
        return self.settle(state, ((self.hierarchy.root, (), self.machines[self.hierarchy.root].start),))

    def vertex(self, stack):
        machine, _, name = stack[-1]
        return dict(pairs(self.machines[machine].vertices))[name]

    def goto(self, stack, name):
        return (*stack[:-1], (*stack[-1][:2], name))

    def settle(self, state: int, stack):
        """The next (state, stack) at a choice or an action; None where the episode is over."""
        while stack and not self.tables.terminal[state]:
            vertex, values = self.vertex(stack), dict(stack[-1][1])
            match vertex:
                case Action(None, then):
                    stack = self.goto(stack, then)
                case Action() | Choice():
                    return state, stack
                case Call(name, _, arguments):
                    given = tuple(
                        sorted((key, values[x.name] if isinstance(x, Parameter) else x) for key, x in pairs(arguments))
                    )
                    stack = (*stack, (name, given, self.machines[name].start))
                case Branch(predicate, edges):
                    stack = self.goto(stack, dict(pairs(edges))[self.ask(predicate, stack[-1][1], state)])
                case Stop():
                    stack = stack[:-1]
                    if stack:
                        stack = self.goto(stack, self.vertex(stack).then)
        return None

    def edges(self, joint):
        """The joint state after each edge that may be taken at a choice, by name."""
        state, stack = joint
        vertex = self.vertex(stack)
        needed = dict(pairs(vertex.only_if))
        return {
            name: self.settle(state, self.goto(stack, then))
            for name, then in pairs(vertex.edges)
            if name not in needed or self.ask(needed[name], stack[-1][1], state)
        }

    def draws(self, joint):
        """(probability, reward, joint state) of each of nature's draws at an action."""
        state, stack = joint
        vertex = self.vertex(stack)
        name = dict(stack[-1][1])[vertex.action.name] if isinstance(vertex.action, Parameter) else vertex.action
        action = self.environment.action_names.index(name)
        for prob, reward, following in zip(
            self.tables.probs[state, action],
            self.tables.rewards[state, action],
            self.tables.successors[state, action],
            strict=True,
        ):
            if prob > 0:
                yield prob, reward, self.settle(int(following), self.goto(stack, vertex.then))

    def expand(self):
        """Every reachable joint state: {joint: edges by name, or draws as a list}."""
        begins = np.flatnonzero(self.tables.initial_probs)
        frontier = [joint for state in begins if (joint := self.start(int(state))) is not None]
        found: dict = {}
        while frontier:
            joint = frontier.pop()
            if joint in found:
                continue
            if isinstance(self.vertex(joint[1]), Choice):
                found[joint] = self.edges(joint)
                frontier += [after for after in found[joint].values() if after is not None]
            else:
                found[joint] = list(self.draws(joint))
                frontier += [after for _, _, after in found[joint] if after is not None]
        return found

    def values(self, discount: float, sweeps: int = 400) -> dict:
        """V of every joint state by repeated sweeps in place."""
        found = self.expand()
        values = dict.fromkeys(found, 0.0) | {None: 0.0}
        for _ in range(sweeps):
            for joint, follows in found.items():
                if isinstance(follows, dict):
                    values[joint] = max(values[after] for after in follows.values())
                else:
                    values[joint] = sum(prob * (reward + discount * values[after]) for prob, reward, after in follows)
        return values


def is_even(environment, state):
    """Whether the number of a numbered state is even."""
    del environment
    return state % 2 == 0


def part(environment, state, parts):
    """In which of `parts` classes a numbered state is."""
    del environment
    return state % parts


KINDS = ("action", "choice", "call", "branch", "stop", "nothing")
CHANCES = (0.4, 0.2, 0.2, 0.1, 0.05, 0.05)


def random_hierarchy(seed: int, actions: tuple[str, ...], sound: bool) -> Hierarchy:
    """Up to three machines of up to seven vertices. A sound one has no wrong names and nothing that is not reachable,
    but may still run on without an action; others may be wrong in any way."""
    rng = np.random.default_rng(seed)
    names = [f"m{number}" for number in range(rng.integers(2 if sound else 1, 4))]
    parameters = {name: (("p",) if name != "m0" and rng.random() < 0.5 else ()) for name in names}
    wrong = 0.0 if sound else 0.03

    def pick(items, bad="nowhere"):
        return bad if not len(items) or rng.random() < wrong else items[rng.integers(len(items))]

    def action(own):
        return Parameter("p") if own and rng.random() < 0.5 else pick(actions, "jump")

    def vertex(index, own, vertices, callable_):
        # Mostly the next one follows, so that machines go through their vertices and then round or out.
        last = index + 1 == len(vertices)
        then = vertices[index + 1] if not last and rng.random() < 0.7 else pick(vertices)
        kind = rng.choice(KINDS, p=CHANCES) if not last or rng.random() < 0.5 else "stop"
        if kind == "call" and len(callable_):
            callee = pick(callable_)
            wanted = parameters.get(callee, ()) if rng.random() >= wrong else ("p",)
            return Call(callee, then, {name: action(own) for name in wanted})
        if kind == "choice":
            edges = {"e": then, **{f"e{number}": pick(vertices) for number in range(rng.integers(0, 3))}}
            edges = {} if rng.random() < wrong else edges
            guarded = list(edges)[1:] if rng.random() < 0.5 else []
            return Choice(edges, {name: Predicate(is_even) for name in guarded})
        if kind == "branch":
            parts = int(rng.integers(1, 3))
            return Branch(Predicate(part, {"parts": parts}), {number: pick(vertices) for number in range(parts)})
        if kind == "stop":
            return Stop()
        return Action(None if kind == "nothing" else action(own), then)

    machines = []
    for number, name in enumerate(names):
        own, vertices = parameters[name], [f"v{index}" for index in range(rng.integers(4 if sound else 1, 8))]
        below = names[number + 1 :] if sound or rng.random() < 0.9 else names
        made = {each: vertex(index, own, vertices, below) for index, each in enumerate(vertices)}
        machines.append(Machine(name, pick(vertices[:1]), made, own))
    return _pruned(Hierarchy("m0", tuple(machines))) if sound else Hierarchy(pick(names[:1]), tuple(machines))


def _pruned(hierarchy: Hierarchy) -> Hierarchy:
    """What can be reached of the machines and their vertices."""
    machines = {machine.name: machine for machine in hierarchy.machines}
    kept: dict[str, Machine] = {}
    frontier = [hierarchy.root]
    for name in frontier:
        if name in kept:
            continue
        vertices, reached = dict(pairs(machines[name].vertices)), [machines[name].start]
        for each in reached:
            reached += [then for _, then in followers(vertices[each]) if then not in reached]
        vertices = {each: vertices[each] for each in vertices if each in reached}
        kept[name] = Machine(name, machines[name].start, vertices, machines[name].parameters)
        frontier += [vertex.machine for vertex in vertices.values() if isinstance(vertex, Call)]
    return Hierarchy(hierarchy.root, tuple(kept.values()))
