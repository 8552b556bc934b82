"""The hallway options against the values of an independent computation, and by what they are."""

from __future__ import annotations

import numpy as np
import pytest

from lodestone.envs.four_rooms import NUMBER, FourRooms
from lodestone.options.base import Primitives, Union
from lodestone.options.four_rooms import DOORS, hallway_options
from lodestone.planning.option_models import option_value_iteration, tabulate_options
from lodestone.planning.tables import tabulate


def solve(rooms: FourRooms, which: str):
    primitives, hallways = Primitives(rooms.action_names), hallway_options(rooms)
    options = {"actions": primitives, "hallways": hallways, "both": Union((primitives, hallways))}[which]
    tables = tabulate(rooms)
    return tables, option_value_iteration(tables, tabulate_options(options, tables.space), 0.9, tolerance=1e-12)


@pytest.mark.parametrize(
    ("goal", "which", "corner", "mean"),
    [
        ((7, 9), "actions", 0.093109, 0.326272),
        ((7, 9), "hallways", 0.093109, 0.326209),
        ((7, 9), "both", 0.093109, 0.326272),
        ((9, 9), "actions", 0.062541, 0.322896),
        ((9, 9), "hallways", 0.020486, 0.134995),
        ((9, 9), "both", 0.062541, 0.322896),
    ],
)
def test_values_of_planning_with_hallways(goal, which, corner, mean):
    """The mean is over all 104 cells, the goal among them."""
    tables, solution = solve(FourRooms(goal=int(NUMBER[goal])), which)
    assert float(solution.values[np.asarray(tables.space.states.cell) == 0][0]) == pytest.approx(corner, abs=1e-6)
    assert solution.values.mean() == pytest.approx(mean, abs=1e-6)


def test_hallways_alone_are_planned_with_in_fewer_sweeps():
    rooms = FourRooms()
    assert solve(rooms, "hallways")[1].sweeps < solve(rooms, "both")[1].sweeps < solve(rooms, "actions")[1].sweeps


def test_two_options_start_in_each_room_and_two_in_each_hallway():
    rooms = FourRooms(goal=int(NUMBER[9, 9]))
    options = tabulate_options(hallway_options(rooms), tabulate(rooms).space)
    cell = np.asarray(tabulate(rooms).space.states.cell)
    assert (options.initiation.sum(axis=0) == 2).all()
    assert options.names[0] == "north-west-to-north"
    stops = options.termination[0].astype(bool)
    assert set(cell[~stops & options.initiation[0]]) == set(NUMBER[1:6, 1:6].ravel())
    assert stops[cell == DOORS["west"]].all()
    assert options.termination[:, cell == rooms.goal].all()
