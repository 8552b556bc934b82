"""Pictures of machines: everything is there, nothing overlaps."""

from __future__ import annotations

from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
import pytest
from corridor import Corridor
from hypothesis import given, settings
from hypothesis import strategies as st
from machine_interpreter import is_even, random_hierarchy

from lodestone.agents.machine_playing import play_choices
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.taxi import Taxi
from lodestone.errors import LodestoneError
from lodestone.machines.machine import Action, Branch, Choice, Hierarchy, Machine, Predicate, Stop, followers, pairs
from lodestone.machines.magnet_arm import pull_up
from lodestone.machines.taxi import get_and_put
from lodestone.planning.joint import evaluate_choices, expected_choices, expected_visits, joint_process, joint_values
from lodestone.planning.solve import greedy_choices
from lodestone.report.machine_picture import _crossings, _lay_out, edge_counts, hierarchy_svg, machine_svg


def texts(svg: str) -> list[str]:
    """Everything that is written in a picture, titles left out."""
    tree = ElementTree.fromstring(svg)
    return [element.text or "" for element in tree.iter("{http://www.w3.org/2000/svg}text")]


def shapes(svg: str, tag: str) -> int:
    return sum(1 for _ in ElementTree.fromstring(svg).iter(f"{{http://www.w3.org/2000/svg}}{tag}"))


def test_every_machine_vertex_and_label_is_in_the_picture() -> None:
    svg = hierarchy_svg(get_and_put(Taxi()))
    written = texts(svg)
    assert [text for text in written if text in ("taxi", "get", "put", "navigate(to)", "go(direction)")] == [
        *("taxi", "get", "put"),  # the root and its calls, whose texts say what their edges would
        *("get", "put", "navigate(to)", "go(direction)"),
    ]
    for text in ("navigate(passenger)", "navigate(destination)", "go(south)", "\u2039direction\u203a", "pickup"):
        assert text in written
    for label in ("True", "False", "south", "one step", "two steps"):
        assert label in written
    titles = [element.text for element in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}title")]
    assert "there?: arrived(\u2039to\u203a)" in titles


def test_a_picture_is_the_same_every_time_and_names_are_escaped() -> None:
    machine = Machine("a<b", "x&y", {"x&y": Choice({'"': "go", "<": "go"}), "go": Action("left", "x&y")})
    assert machine_svg(machine) == machine_svg(machine)
    assert {"a<b", "x&y", '"', "<", "left"} <= set(texts(machine_svg(machine)))


@settings(max_examples=60)
@given(st.integers(0, 10**9))
def test_no_vertices_overlap_and_every_edge_is_drawn(seed: int) -> None:
    for machine in random_hierarchy(seed, ("left", "right"), sound=True).machines:
        layout = _lay_out(machine)
        for layer in layout.layers:
            for one, other in pairwise(layer):
                assert other.x - one.x >= (one.width + other.width) / 2
        vertices = dict(pairs(machine.vertices))
        wanted = sorted((name, then) for name, vertex in vertices.items() for _, then in followers(vertex))
        assert sorted((edge.source, edge.target) for edge in layout.edges) == wanted
        for edge in layout.edges:
            if edge.path:
                # One layer at a time, and only edges that close a cycle lead up.
                assert [node.layer for node in edge.path] == list(
                    range(edge.path[0].layer, edge.path[0].layer + len(edge.path))
                )
                assert (edge.path[-1].name if edge.upwards else edge.path[0].name) == edge.source
        ElementTree.fromstring(machine_svg(machine))


def test_edges_that_need_not_cross_do_not() -> None:
    """Two chains that are written in opposite orders."""
    choose = Choice({"a": "a", "b": "b"})
    vertices = {
        "choose": choose,
        "a": Choice({"c": "c"}),
        "b": Choice({"d": "d"}),
        "d": Action("left", "stop"),
        "c": Action("right", "stop"),
        "stop": Stop(),
    }
    assert _crossings(_lay_out(Machine("m", "choose", vertices)).layers) == 0


def test_an_edge_from_a_vertex_to_itself_is_inside_the_picture() -> None:
    vertices = {"go": Action("left", then="go")}
    tree = ElementTree.fromstring(machine_svg(Machine("m", "go", vertices)))
    plain = ElementTree.fromstring(machine_svg(Machine("m", "go", {"go": Action("left", "stop"), "stop": Stop()})))
    assert float(tree.attrib["width"]) > float(plain.attrib["width"]) + 30


def test_kinds_of_vertices_have_shapes_of_their_own() -> None:
    vertices = {
        "ask": Branch(Predicate(is_even), {0: "go", 1: "stop"}),
        "go": Action("right", "stop"),
        "stop": Stop(),
    }
    svg = machine_svg(Machine("m", "ask", vertices))
    assert shapes(svg, "circle") == 1 + 2  # the start, and the double circle of the stop
    assert shapes(svg, "rect") == 1 + 2  # the frame, and the box with its tint


def test_counts_are_those_of_episodes() -> None:
    """In a deterministic world an episode is what is expected: three to the right, two bricks fetched."""
    arm = MagnetArm(5, 3, 4, 4)
    process = joint_process(arm, pull_up(arm))
    policy = greedy_choices(joint_values(process, 0.99).choice_values)
    visits = expected_visits(process, policy)
    episode = play_choices(process, policy, np.random.default_rng(0), 1000)
    played = np.zeros_like(visits)
    np.add.at(played, (episode.joint[:-1][episode.edge >= 0], episode.edge[episode.edge >= 0]), 1)
    np.testing.assert_allclose(visits, played, atol=1e-9)
    counts = edge_counts(process, visits)
    assert counts[("build", "next", "pull up")] == pytest.approx(2)
    assert sum(counts.values()) == pytest.approx(8)
    assert "let go 2" in texts(hierarchy_svg(pull_up(arm), counts))
    assert "2" in texts(hierarchy_svg(pull_up(arm), counts))


def test_expected_visits_are_the_expected_choices() -> None:
    taxi = Taxi(move_success=0.8)
    process = joint_process(taxi, get_and_put(taxi))
    policy = process.available / process.available.sum(axis=1, keepdims=True)
    visits = expected_visits(process, policy)
    assert visits.sum() == pytest.approx(process.initial_mean(expected_choices(process, policy)))
    # What is earned is what the visits earn: the value of an edge over that of its choice, summed, is nothing.
    values = evaluate_choices(process, policy, 1.0)
    advantage = values[process.edges] - values[: process.num_choices, None]
    assert (visits * advantage).sum() == pytest.approx(0.0, abs=1e-6)


def test_visits_without_end_are_refused() -> None:
    vertices = {"which": Choice({"left": "left", "right": "right"})}
    vertices |= {name: Action(name, "which") for name in ("left", "right")}
    process = joint_process(Corridor(), Hierarchy("m", (Machine("m", "which", vertices),)))
    with pytest.raises(LodestoneError, match="go on for ever"):
        expected_visits(process, np.zeros(process.num_choices, dtype=int))
