"""Places: no two subtasks that run in the same state share one, and whatever may run has its place."""

from __future__ import annotations

import numpy as np
import pytest

from lodestone.envs.taxi import Taxi
from lodestone.envs.two_rooms import TwoRooms
from lodestone.planning.tables import tabulate
from lodestone.subtasks.catalogue import task_graph
from lodestone.subtasks.places import arrange, may_be_running
from lodestone.subtasks.task_graph import tabulate_tasks

ENVIRONMENTS = pytest.mark.parametrize("environment", [Taxi(), TwoRooms()], ids=["taxi", "two rooms"])


def tabulated(environment):
    tables = tabulate(environment)
    return tables, tabulate_tasks(task_graph(environment), environment, tables)


def test_three_places_serve_the_taxi():
    """Navigating to one landmark at a time, then getting or putting down, then the root; at most 4, 2 and 1 calls."""
    tables, tasks = tabulated(Taxi())
    places = arrange(tasks, may_be_running(tasks, tables))
    names = tasks.names[tasks.num_actions :]
    assert dict(zip(names, places.place_of, strict=True)) == {
        **{"root": 2, "get": 1, "put": 1},
        **{f"to-{landmark}": 0 for landmark in "RGYB"},
    }
    assert [edges.shape[1] for edges in places.calls] == [4, 2, 1]
    assert places.otherwise == (False, True, False)


@ENVIRONMENTS
@pytest.mark.parametrize("everywhere", [True, False])
def test_residents_and_their_calls(environment, everywhere):
    tables, tasks = tabulated(environment)
    running = ~tasks.ends if everywhere else may_be_running(tasks, tables)
    places = arrange(tasks, running)
    for subtask, place in enumerate(places.place_of):
        np.testing.assert_array_equal(places.resident[:, place] == subtask, running[subtask])
        for number in tasks.edges_of(subtask):
            child = tasks.edges[number].child - tasks.num_actions
            assert child < 0 or places.place_of[child] < place
        for state in np.flatnonzero(running[subtask]):
            listed = [edge for edge in places.calls[place][state] if edge >= 0]
            assert listed == [edge for edge in tasks.edges_of(subtask) if tasks.available[edge, state]]


@ENVIRONMENTS
def test_what_runs_at_random_may_be_running(environment):
    tables, tasks = tabulated(environment)
    random, seen = np.random.default_rng(0), np.zeros_like(tasks.ends)
    cumulative = tables.probs.cumsum(axis=2)

    def run(subtask, state, steps_left):
        """Where it ended, or was cut, and how many steps are left."""
        while steps_left and not tasks.ends[subtask, state]:
            seen[subtask, state] = True
            edges = [edge for edge in tasks.edges_of(subtask) if tasks.available[edge, state]]
            child = tasks.edges[edges[random.integers(len(edges))]].child
            if child >= tasks.num_actions:
                state, steps_left = run(child - tasks.num_actions, state, steps_left)
            else:
                outcome = np.searchsorted(cumulative[state, child], random.random(), side="right")
                state, steps_left = tables.successors[state, child, outcome], steps_left - 1
        return state, steps_left

    for _ in range(200):
        run(0, random.choice(tables.num_states, p=tables.initial_probs), steps_left=500)
    running = may_be_running(tasks, tables)
    assert (running | ~seen).all()
    assert seen.sum() > running.sum() / 2
