"""Task graphs: what is refused, and what is stored where."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestone.envs.taxi import Taxi
from lodestone.envs.two_rooms import TwoRooms
from lodestone.errors import InvalidTaskGraph
from lodestone.planning.tables import tabulate
from lodestone.subtasks.catalogue import task_graph
from lodestone.subtasks.task_graph import Child, Subtask, TaskGraph, tabulate_tasks

ROOMS = TwoRooms()
MOVES = tuple(Child(name) for name in ROOMS.action_names)


def never(state):
    return jnp.bool_(False)


def subtask(name, *children):
    return Subtask(name, never, tuple(Child(child) for child in children))


REFUSED = [
    ((), "needs at least one subtask"),
    ((subtask("root"),), "'root' has no children"),
    ((subtask("root", "a"), subtask("a", "north"), subtask("a", "south")), "Two subtasks are named 'a'"),
    ((subtask("root", "north", "north"),), "two children named 'north'"),
    ((subtask("root", "a"), subtask("a", "b"), subtask("b", "a")), "in a circle"),
    ((subtask("root", "root"),), "in a circle: root -> root"),
    ((subtask("root", "north"), subtask("a", "south")), "'a' is never called"),
    ((subtask("root", "fly"),), "calls 'fly'"),
    ((subtask("root", "north"), subtask("north", "east")), "name of a primitive action"),
    ((Subtask("root", never, (Child("north", when=never),)),), "may call none of its children"),
    (
        (Subtask("root", never, (Child("north", final=True),), pseudo_reward=never),),
        "none of its children can be final",
    ),
]


@pytest.mark.parametrize(("subtasks", "sentence"), REFUSED)
def test_bad_graphs_are_refused_in_a_sentence(subtasks, sentence):
    with pytest.raises(InvalidTaskGraph) as refusal:
        tabulate_tasks(TaskGraph(subtasks), ROOMS, tabulate(ROOMS))
    assert sentence in str(refusal.value)
    with pytest.raises(InvalidTaskGraph, match="no action 'fly'"):
        tabulate_tasks(TaskGraph((subtask("root", "north"),), {"fly": never}), ROOMS, tabulate(ROOMS))


NAMES = st.sampled_from(["root", "a", "b", "c", "north", "south", "fly"])


@given(st.lists(st.tuples(NAMES, st.lists(NAMES, max_size=3)), max_size=5))
def test_any_graph_is_refused_or_has_an_order(described):
    """Whatever the names: a graph that is not refused calls nothing before what it calls is known, and never hangs."""
    try:
        graph = TaskGraph(tuple(subtask(name, *children) for name, children in described))
        tasks = tabulate_tasks(graph, ROOMS, tabulate(ROOMS))
    except InvalidTaskGraph:
        return
    seen: set[int] = set()
    for number in tasks.bottom_up:
        called = {tasks.edges[edge].child - tasks.num_actions for edge in tasks.edges_of(number)}
        assert {child for child in called if child >= 0} <= seen
        seen.add(number)
    assert tasks.bottom_up[-1] == 0
    assert len(seen) == len(described)
    assert 1 <= graph.levels <= len(described)


def test_taxi_stores_no_more_than_dietterich_counts():
    """His 632 values, less those of states where a call is not allowed, as navigating to where one is."""
    taxi = Taxi("jair", starts="any")
    tables = tabulate(taxi)
    tasks = tabulate_tasks(task_graph(taxi), taxi, tables)
    counts = {
        name: len(np.unique(slots[slots >= 0]))
        for name, slots in zip(tasks.edge_names, tasks.completion_slot, strict=True)
    }
    assert counts["root/get"] == 16
    assert counts["root/put"] == 0
    assert counts["get/pickup"] == counts["put/putdown"] == 100
    assert sum(counts[f"get/to-{name}"] for name in "RGYB") == sum(counts[f"put/to-{name}"] for name in "RGYB") == 4
    assert counts["to-R/north"] == 24
    assert tasks.num_slots == 632 - 16 + 1  # and what a putdown in the wrong place would pay, which here is illegal
    assert tabulate_tasks(task_graph(taxi).without_abstraction(), taxi, tables).num_slots > 10_000


def test_what_is_called_is_allowed_there():
    taxi = Taxi()
    tables = tabulate(taxi)
    tasks = tabulate_tasks(task_graph(taxi), taxi, tables)
    for number, edge in enumerate(tasks.edges):
        assert not (tasks.available[number] & tasks.ends[edge.subtask]).any()
        if edge.child >= tasks.num_actions:
            assert not (tasks.available[number] & tasks.ends[edge.child - tasks.num_actions]).any()
    assert (tasks.pseudo_rewards[~tasks.ends] == 0).all()
    assert tasks.pseudo_rewards.min() == -100
