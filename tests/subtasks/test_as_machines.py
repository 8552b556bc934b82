"""Task graphs as machines: the hierarchical optimum lies between the recursive and the flat one."""

from __future__ import annotations

import numpy as np
import pytest

from lodestone.envs.taxi import Taxi
from lodestone.envs.two_rooms import TwoRooms
from lodestone.planning.joint import hierarchical_optimum, joint_process, joint_values
from lodestone.planning.solve import value_iteration
from lodestone.planning.tables import tabulate
from lodestone.subtasks.as_machines import as_machines
from lodestone.subtasks.catalogue import task_graph
from lodestone.subtasks.recursive import recursive_optimum
from lodestone.subtasks.task_graph import tabulate_tasks


def test_two_rooms_taken_as_a_whole():
    """-7.75, as the flat optimum, where the recursive optimum of the same graph is -8.5."""
    rooms = TwoRooms()
    found = hierarchical_optimum(rooms, as_machines(task_graph(rooms).without_pseudo_rewards()))
    assert found.optimal_return == pytest.approx(-7.75)
    assert found.optimal_steps == pytest.approx(7.75)


@pytest.mark.parametrize("taxi", [Taxi(), Taxi(move_success=0.8), Taxi("jair", fickle=0.3)])
def test_no_order_of_optima_is_broken(taxi):
    """recursive <= hierarchical <= flat, for every start. The passenger who changes his mind costs a task graph
    something, as it navigates on to where he no longer wants to go."""
    tables = tabulate(taxi)
    tasks = tabulate_tasks(task_graph(taxi).without_pseudo_rewards(), taxi, tables)
    recursive = recursive_optimum(tasks, tables).values[0]
    flat = value_iteration(tables, 1.0).values
    process = joint_process(taxi, as_machines(task_graph(taxi)))
    values = joint_values(process, 1.0).values
    begins = process.initial_probs > 0
    state = process.state[begins]
    assert (recursive[state] <= values[begins] + 1e-6).all()
    assert (values[begins] <= flat[state] + 1e-6).all()
    lost = tables.initial_mean(flat) - process.initial_mean(values)
    assert lost == pytest.approx(0, abs=1e-6) if taxi.fickle == 0 else lost > 0.01
    assert np.isfinite(values[begins]).all()
