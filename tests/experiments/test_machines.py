"""The experiment on abstract machines: short, and (slow) the numbers that must come out."""

from __future__ import annotations

import numpy as np
import pytest

from lodestone.experiments import machines
from lodestone.learning.progress import Silent
from lodestone.report.studies import svg_of


def test_a_short_run_in_a_small_maze(monkeypatch):
    monkeypatch.setattr(machines, "MAZE", machines.CorridorMaze(rows=2, columns=2, length=5))
    monkeypatch.setattr(machines, "ARM_STEPS", dict.fromkeys(machines.ARM_STEPS, 8000))
    monkeypatch.setattr(machines, "MAZE_STEPS", dict.fromkeys(machines.MAZE_STEPS, 60000))
    monkeypatch.setattr(machines, "LOOKS", 4)
    study = machines.run(2, Silent())
    assert study.tables[0].rows[1][-2:] == (24.0, 76.0)
    arm, maze = study.panels
    assert np.nanmax(arm.series[0].seeds) <= 76 + 1e-6
    best, of_machine = (height for _, height in maze.references)
    assert of_machine <= best
    for series, limit in zip(maze.series, (of_machine, best), strict=True):
        assert np.nanmax(series.seeds) <= limit + 1.0  # softened as they are, policies are not quite comparable
        assert np.nanmax(series.seeds) > limit - 15.0
    assert all("<svg" in svg_of(each) for each in study.machines)
    visits = study.machines[0].visits
    assert visits.sum() >= 8


@pytest.mark.slow
def test_all_numbers_come_out():
    assert [gate.name for gate in machines.run(20, Silent()).gates if not gate.passed] == []
