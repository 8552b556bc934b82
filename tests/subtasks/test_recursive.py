"""Exact values of task graphs, against flat optima, an interpreter that plays them, and worked examples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lodestone.envs.taxi import Taxi
from lodestone.envs.two_rooms import TwoRooms
from lodestone.errors import InvalidTaskGraph
from lodestone.planning.solve import evaluate_policy, value_iteration
from lodestone.planning.tables import Tables, tabulate
from lodestone.subtasks.catalogue import task_graph
from lodestone.subtasks.recursive import check_abstraction, evaluate_choices, polled_policy, recursive_optimum
from lodestone.subtasks.task_graph import Edge, TaskGraph, TaskTables, tabulate_tasks


def prepare(environment, graph: TaskGraph | None = None) -> tuple[Tables, TaskTables]:
    tables = tabulate(environment)
    return tables, tabulate_tasks(graph or task_graph(environment), environment, tables)


@pytest.mark.parametrize(
    ("taxi", "value"),
    [
        (Taxi(), 7.93),
        (Taxi("jair"), 6.93),
        (Taxi(move_success=0.8), 3.954575),
    ],
)
def test_the_taxis_recursive_optimum_is_the_flat_one(taxi, value):
    tables, tasks = prepare(taxi)
    found = recursive_optimum(tasks, tables)
    assert tables.initial_mean(found.values[0]) == pytest.approx(value, abs=1e-6)
    np.testing.assert_allclose(found.values[0], value_iteration(tables, 1.0).values, atol=1e-8)
    check_abstraction(tasks, tables, found)


def test_dietterichs_worked_example():
    """His figure 3, with 20 for delivery paid besides the step: the taxi is one square below R, where the passenger
    waits who wants to go to B. V(root) = -1 + 0 + -1 + 12 = 10."""
    taxi = Taxi("jair")
    tables, tasks = prepare(taxi, task_graph(taxi).without_abstraction())
    found = recursive_optimum(tasks, tables)
    states = tables.space.states
    [here] = np.flatnonzero(
        (states.row == 1) & (states.column == 0) & (states.passenger == 0) & (states.destination == 3)
    )
    completion = {name: found.completions[number, here] for number, name in enumerate(tasks.edge_names)}
    assert tables.mean_rewards()[here, taxi.action_names.index("north")] == -1
    assert completion["to-R/north"] == 0
    assert completion["get/to-R"] == -1
    assert completion["root/get"] == pytest.approx(12)
    assert found.values[0, here] == pytest.approx(10)


def test_two_rooms_need_a_pseudo_reward():
    """Dietterich's figure 6: the nearer door is not the better one for 8 of 32 states."""
    rooms = TwoRooms()
    graph = task_graph(rooms)
    tables, tasks = prepare(rooms, graph.without_pseudo_rewards())
    flat = value_iteration(tables, 1.0).values
    found = recursive_optimum(tasks, tables).values[0]
    left = tables.initial_probs > 0
    assert tables.initial_mean(found) == pytest.approx(-8.5)
    loss, row = flat[left] - found[left], np.asarray(tables.space.states.row)[left]
    np.testing.assert_allclose(loss, np.select([row == 4, row == 5], [4.0, 2.0], 0.0))

    _, tasks = prepare(rooms, graph)
    np.testing.assert_allclose(recursive_optimum(tasks, tables).values[0][left], flat[left])
    assert tables.initial_mean(flat) == pytest.approx(-7.75)


def play(tasks: TaskTables, tables: Tables, choices, discount: float, subtask: int, state: int, limit: int):
    """The reward until the subtask ends, the state then and the steps it took, by recursion; for a world without
    chance."""
    total, steps = 0.0, 0
    while not tasks.ends[subtask, state] and steps < limit:
        child = tasks.edges[choices[subtask, state]].child
        if child < tasks.num_actions:
            reward, state, taken = tables.rewards[state, child, 0], int(tables.successors[state, child, 0]), 1
        else:
            child -= tasks.num_actions
            reward, state, taken = play(tasks, tables, choices, discount, child, state, limit - steps)
        total, steps = total + discount**steps * reward, steps + taken
    return total, state, steps


@pytest.mark.parametrize("environment", [Taxi(), TwoRooms()])
def test_values_are_what_playing_brings(environment):
    """Random choices, discounted, so that children of several steps and episodes without an end are among them."""
    tables, tasks = prepare(environment, task_graph(environment).without_abstraction())
    rng, discount = np.random.default_rng(1), 0.8
    for _ in range(3):
        choices = np.full(tasks.ends.shape, -1)
        for subtask, state in np.argwhere(~tasks.ends):
            allowed = [edge for edge in tasks.edges_of(subtask) if tasks.available[edge, state]]
            choices[subtask, state] = rng.choice(allowed)
        found = evaluate_choices(tasks, tables, choices, discount)
        for state in rng.integers(tables.num_states, size=20):
            for subtask in range(len(tasks.ends)):
                reward, _, _ = play(tasks, tables, choices, discount, subtask, state, 200)
                assert found.values[subtask, state] == pytest.approx(reward, abs=1e-9)


def test_a_discount_counts_the_steps_of_a_child():
    """Navigating takes many steps: the recursive optimum is the flat one only if each of them is discounted."""
    taxi = Taxi(move_success=0.8)
    tables, tasks = prepare(taxi, task_graph(taxi).without_abstraction())
    found = recursive_optimum(tasks, tables, discount=0.9, tolerance=1e-12)
    np.testing.assert_allclose(found.values[0], value_iteration(tables, 0.9, tolerance=1e-12).values, atol=1e-9)


def test_polling_is_never_worse():
    """Dietterich 2000, section 6. Rooms without the pseudo-reward; asked at every step, *exit* changes nothing."""
    for environment in (TwoRooms(), Taxi(move_success=0.8)):
        tables, tasks = prepare(environment, task_graph(environment).without_pseudo_rewards())
        found = recursive_optimum(tasks, tables)
        polled = evaluate_policy(tables, polled_policy(tasks, found.choices), 1.0)
        begins = tables.initial_probs > 0
        assert (polled[begins] >= found.values[0][begins] - 1e-9).all()


def test_an_abstraction_that_is_not_safe_is_named():
    """With a discount the way to the passenger counts, which *get* does not see."""
    taxi = Taxi()
    tables, tasks = prepare(taxi)
    with pytest.raises(InvalidTaskGraph, match="abstraction of 'root/get' is not safe"):
        check_abstraction(tasks, tables, recursive_optimum(tasks, tables, discount=0.9))
    rooms = TwoRooms()
    graph = task_graph(rooms)
    root = graph.subtasks[0]
    calls = tuple(replace(child, final=True) for child in root.children)
    tables, tasks = prepare(rooms, replace(graph, subtasks=(replace(root, children=calls), *graph.subtasks[1:])))
    with pytest.raises(InvalidTaskGraph, match="'root/exit' is not final"):
        check_abstraction(tasks, tables, recursive_optimum(tasks, tables))


def test_a_child_must_end_with_its_caller():
    taxi = Taxi()
    graph = task_graph(taxi)
    late = replace(graph.subtasks[1], ends=graph.subtasks[0].ends)
    early_root = replace(graph.subtasks[0], ends=graph.subtasks[1].ends)
    tables, tasks = prepare(taxi, replace(graph, subtasks=(early_root, late, *graph.subtasks[2:])))
    with pytest.raises(InvalidTaskGraph, match="'get' may go on when 'root'"):
        recursive_optimum(tasks, tables)


@pytest.mark.parametrize("rewards", ["gym", "jair"])
def test_the_taxis_abstraction_is_safe_also_for_a_fickle_passenger(rewards):
    tables, tasks = prepare(Taxi(rewards, move_success=0.8, fickle=0.3))
    check_abstraction(tasks, tables, recursive_optimum(tasks, tables))


def test_what_a_pseudo_reward_tells_apart_must_be_seen():
    """The moves of *exit* see the row alone, so neither how far the doors are nor what they are valued at."""
    rooms = TwoRooms()
    graph = task_graph(rooms)
    root, leave, go = graph.subtasks
    leave = replace(leave, children=tuple(replace(child, sees=lambda state: state.row) for child in leave.children))
    tables, tasks = prepare(rooms, replace(graph, subtasks=(root, leave, go)))
    with pytest.raises(InvalidTaskGraph, match=r"abstraction of 'exit/.*' is not safe"):
        check_abstraction(tasks, tables, recursive_optimum(tasks, tables))


def test_pseudo_rewards_are_part_of_inner_completions_alone():
    """C~ - C is what the pseudo-reward of *exit* is worth at the door that its policy takes."""
    rooms = TwoRooms()
    tables, tasks = prepare(rooms)
    found = recursive_optimum(tasks, tables)
    states = tables.space.states
    doors = {0: -2.0, 7: -7.0}
    for name in ("exit/north", "exit/east"):
        number = tasks.edge_names.index(name)
        [start] = np.flatnonzero((states.row == 1) & (states.column == 3))
        difference = found.inner_completions[number, start] - found.completions[number, start]
        assert difference == pytest.approx(doors[0])
    go = tasks.edge_names.index("go/north")
    np.testing.assert_array_equal(found.inner_completions[go], found.completions[go])


def test_what_has_no_chance_is_no_risk():
    """Random worlds with one policy: working states, a way out to the end, a trap. The subtask *work* lasts as long as
    one works; whoever cannot get into the trap must not be told that he may."""
    rng, action, work = np.random.default_rng(0), 0, 2
    for _ in range(250):
        working = int(rng.integers(4, 25))
        exit_, trap, end = working, working + 1, working + 2
        successors, probs = np.zeros((end + 1, 1, 3), dtype=np.int32), np.zeros((end + 1, 1, 3))
        for state in range(working):
            successors[state, 0] = rng.choice(working + 2, 3, replace=False)
            probs[state, 0, : rng.integers(1, 4)] = 1.0
            probs[state, 0] *= rng.dirichlet(np.full(3, 0.7)) + 0.04
        for state, following in ((exit_, end), (trap, trap), (end, end)):
            successors[state, 0], probs[state, 0, 0] = following, 1.0
        probs /= probs.sum(axis=2, keepdims=True)
        terminal = np.arange(end + 1) == end
        rewards = np.where(terminal[:, None, None], 0.0, -np.ones(probs.shape))
        tables = Tables(None, successors, probs, rewards, terminal, np.full(end + 1, 1 / (end + 1)))
        ends = np.stack([terminal, np.arange(end + 1) >= working])
        tasks = TaskTables(
            names=("act", "root", "work"),
            num_actions=1,
            edges=(Edge(0, work), Edge(0, action), Edge(1, action)),
            bottom_up=(1, 0),
            ends=ends,
            available=np.stack([~ends[1], ends[1] & ~terminal, ~ends[1]]),
            pseudo_rewards=np.zeros(ends.shape),
            completion_slot=np.zeros((3, end + 1), dtype=np.int32),
            reward_slot=np.zeros((1, end + 1), dtype=np.int32),
            num_slots=1,
        )
        choices = np.where(ends, -1, np.array([[0], [2]]))
        choices[0, ends[1] & ~terminal] = 1
        found = evaluate_choices(tasks, tables, choices).values[0]
        flat = evaluate_policy(tables, np.zeros(end + 1, dtype=int), 1.0)
        np.testing.assert_array_equal(np.isneginf(found), np.isneginf(flat))
        np.testing.assert_allclose(found[np.isfinite(flat)], flat[np.isfinite(flat)], rtol=1e-6)
