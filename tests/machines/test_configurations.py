"""Machines as data, what is wrong with some, and the call stacks of the others."""

from __future__ import annotations

import jax.numpy as jnp
import pytest
from corridor import Corridor
from hypothesis import given, settings
from hypothesis import strategies as st
from machine_interpreter import is_even, part, random_hierarchy

from lodestone.envs.corridor_maze import CorridorMaze
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.taxi import Taxi
from lodestone.errors import InvalidMachine
from lodestone.machines.configurations import check, configurations, takes_time
from lodestone.machines.corridor_maze import walk_corridors
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
    every_action,
    sequence,
)
from lodestone.machines.magnet_arm import pull_up
from lodestone.machines.taxi import get_and_put

EVEN = Predicate(is_even)


def test_equal_machines_are_one_machine() -> None:
    one, other = (Choice(edges) for edges in ({"a": "x", "b": "y"}, (("a", "x"), ("b", "y"))))
    assert one == other
    assert hash(one) == hash(other)
    assert hash(get_and_put(Taxi())) == hash(get_and_put(Taxi()))
    assert get_and_put(Taxi()) == get_and_put(Taxi())
    assert pull_up(MagnetArm(4, 3, 3, 3)) != pull_up(MagnetArm(5, 3, 4, 4))


def test_configurations_are_whole_call_stacks() -> None:
    """Two calls of one machine: its vertices are there twice, once for each place that it returns to."""
    walk = sequence("walk", Parameter("way"), parameters=("way",))
    root = Machine(
        "root",
        "out",
        {
            "out": Call("walk", then="back", arguments={"way": "right"}),
            "back": Call("walk", then="stop", arguments={"way": "left"}),
            "stop": Stop(),
        },
    )
    found = configurations(Hierarchy("root", (root, walk)))
    texts = [found.text(number) for number in range(found.size)]
    assert texts == [
        "root.out",
        "root.out > walk(way=right).1: way",
        "root.out > walk(way=right).stop",
        "root.back",
        "root.back > walk(way=left).1: way",
        "root.back > walk(way=left).stop",
        "root.stop",
    ]
    assert found.followers == ((1,), (2,), (3,), (4,), (5,), (6,), (-1,))
    assert [vertex.action for vertex in found.vertices if isinstance(vertex, Action)] == ["right", "left"]
    assert found.choices_in_a_row == 1


@pytest.mark.parametrize(
    ("environment", "make", "size", "in_a_row"),
    [
        (MagnetArm(5, 3, 4, 4), pull_up, 5 + 10, 1),  # root, and one call of nine actions
        (Taxi(), get_and_put, 3 + 2 * (3 + 7 + 4 * 4), 2),  # two calls of navigate, each with four of go
        (CorridorMaze(), walk_corridors, 5 + 4 * (11 + 2 * 5 + 5), 1),
    ],
)
def test_machines_of_the_library(environment, make, size, in_a_row) -> None:
    hierarchy = make(environment)
    check(hierarchy, environment)
    found = configurations(hierarchy)
    assert found.size == size
    assert found.choices_in_a_row == in_a_row
    # Whatever follows in no time comes first.
    place = {number: position for position, number in enumerate(found.passing_order)}
    for number, vertex in enumerate(found.vertices):
        if not takes_time(vertex):
            assert all(place[after] < place[number] for after in found.followers[number] if after >= 0)


def test_calls_of_machines_that_act_are_no_cycle_without_time() -> None:
    """A loop of nothing but a call: fine if every way through the machine called takes an action, and else not."""
    loop = Machine("loop", "again", {"again": Call("turn", then="again")})
    acts = Machine("turn", "which", {"which": Choice({"a": "go"}), "go": Action("left", "stop"), "stop": Stop()})
    assert configurations(Hierarchy("loop", (loop, acts))).size == 4
    may_not = Machine(
        "turn", "which", {"which": Choice({"a": "go", "b": "stop"}), "go": Action("left", "stop"), "stop": Stop()}
    )
    with pytest.raises(InvalidMachine, match=r"without taking time: .*turn\.which.*turn\.stop"):
        configurations(Hierarchy("loop", (loop, may_not)))


def one(start, vertices, parameters=()) -> Hierarchy:
    return Hierarchy("root", (Machine("root", start, vertices, parameters),))


def with_walk(arguments, vertices=None) -> Hierarchy:
    root = Machine("root", "go", {"go": Call("walk", then="go", arguments=arguments)})
    walk = Machine("walk", "go", vertices or {"go": Action(Parameter("way"), "stop"), "stop": Stop()}, ("way",))
    return Hierarchy("root", (root, walk))


LEFT_FOR_EVER = {"go": Action("left", then="go")}


@pytest.mark.parametrize(
    ("hierarchy", "message"),
    [
        (one("start", LEFT_FOR_EVER), "begins at 'start'"),
        (one("go", {"go": Action("left", then="on")}), "leads to 'on', which is no vertex"),
        (one("go", {"go": Choice({"a": "go", "b": "on"})}), "edge 'b' of root.go leads to 'on'"),
        (one("go", {**LEFT_FOR_EVER, "alone": Stop()}), "Nothing leads to vertex 'alone'"),
        (one("go", {"go": Choice({})}), "root.go has no edges"),
        (one("go", {"go": Branch(EVEN, {})}), "root.go has no edges"),
        (one("go", {"go": Choice((("a", "on"), ("a", "on"))), "on": Stop()}), "two edges of the same name"),
        (one("go", {"go": Choice({"a": "on"}, {"b": EVEN}), "on": Stop()}), "'b', which is none of its edges"),
        (one("go", {"go": "left"}), "no kind of vertex"),
        (one("go", (("go", Action("left", "go")), ("go", Stop()))), "Two vertices of machine 'root'"),
        (one("go", {"go": Call("walk", then="go")}), "calls 'walk', but there is no such machine"),
        (one("go", LEFT_FOR_EVER, parameters=("way",)), "root machine 'root' has parameters"),
        (one("go", {"go": Action(Parameter("way"), then="go")}), "'way', which is no parameter of machine 'root'"),
        (Hierarchy("main", (Machine("root", "go", LEFT_FOR_EVER),)), "no root machine named 'main'"),
        (Hierarchy("root", (Machine("root", "go", LEFT_FOR_EVER),) * 2), "need different names"),
        (Hierarchy("root", (Machine("root", "go", LEFT_FOR_EVER), sequence("b", "left"))), "Nothing calls machine 'b'"),
        (with_walk({}), "with no arguments, but the parameters of that machine are way"),
        (with_walk({"way": "left", "far": 3}), "with way, far, but the parameters"),
        (with_walk({"way": "up"}), r"root.go > walk\(way=up\).go takes the action 'up', but the environment has only"),
        (with_walk({"way": 1}), "takes the action 1"),
        (with_walk({"way": Parameter("side")}), "'side', which is no parameter of machine 'root'"),
        (with_walk({"way": "left"}, {"go": Call("walk", then="go", arguments={"way": "left"})}), "may call itself"),
        (one("go", {"go": Action(None, then="go")}), "without taking time: root.go, and again"),
        (one("go", {"go": Choice({"a": "on", "b": "go"}), "on": Stop()}), "without taking time: root.go"),
        (
            one("go", {"go": Branch(EVEN, {0: "b", 1: "c"}), "b": Action(None, "go"), "c": Action("left", "go")}),
            "without taking time: root.go, then root.b",
        ),
        (one("go", {"go": Branch(Predicate(part), {0: "on"}), "on": Stop()}), "does not take these: missing"),
        (one("go", {"go": Branch(Predicate(is_even, {"x": 1}), {0: "on"}), "on": Stop()}), "does not take these"),
        (one("go", {"go": Branch(EVEN, {"yes": "on"}), "on": Stop()}), "labels of a branch"),
    ],
)
def test_what_is_wrong_is_said(hierarchy: Hierarchy, message: str) -> None:
    with pytest.raises(InvalidMachine, match=message) as caught:
        check(hierarchy, Corridor())
    assert str(caught.value).endswith(".")


def test_what_has_no_hash_is_refused() -> None:
    with pytest.raises(InvalidMachine, match="arguments of a Call"):
        Call("walk", then="go", arguments={"way": [1]})
    with pytest.raises(InvalidMachine, match="edges of a Choice"):
        Choice(3)


def test_call_stacks_are_bounded() -> None:
    """Each machine calls the next one twice: 2^20 stacks."""
    machines = [
        Machine(str(level), "a", {"a": Call(str(level + 1), "b"), "b": Call(str(level + 1), "stop"), "stop": Stop()})
        for level in range(20)
    ]
    hierarchy = Hierarchy("0", (*machines, sequence("20", "left")))
    with pytest.raises(InvalidMachine, match="more than 5,000 configurations"):
        configurations(hierarchy, limit=5000)


def test_every_action_is_one_choice() -> None:
    corridor = Corridor()
    check(every_action(corridor), corridor)
    assert configurations(every_action(corridor)).size == 1 + corridor.num_actions


@settings(max_examples=400)
@given(st.integers(0, 10**9))
def test_any_machine_is_accepted_or_refused_by_name(seed: int) -> None:
    hierarchy = random_hierarchy(seed, ("left", "right"), sound=False)
    message = ""
    try:
        check(hierarchy, Corridor())
    except InvalidMachine as error:
        message = str(error)
    assert message == "" or message.endswith(".")
    assert "\n" not in message


def test_predicates_of_the_maze_machine() -> None:
    """They are what the maze itself says."""
    from lodestone.machines.corridor_maze import at_intersection, blocked, free

    maze = CorridorMaze(rows=2, columns=2)
    _, states = maze.initial_distribution()
    state = type(states)(states.cell[0])
    assert bool(at_intersection(maze, state))
    assert not bool(blocked(maze, state, "right"))
    corner = state
    for _ in range(3):
        corner = maze.transition(corner, jnp.int32(0), jnp.int32(0))
    assert bool(blocked(maze, corner, "up"))
    assert not bool(free(maze, corner, "up"))
