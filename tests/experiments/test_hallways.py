"""The experiment on hallway options: short, and (slow) the numbers that must come out."""

from __future__ import annotations

import pytest

from lodestone.experiments import hallways
from lodestone.learning.progress import Silent


def test_a_short_run_plans_exactly_and_shows_every_learner(monkeypatch):
    monkeypatch.setattr(hallways, "STEPS", 9000)
    monkeypatch.setattr(hallways, "LOOKS", 3)
    study = hallways.run(2, Silent())
    assert [gate.passed for gate in study.gates[:2]] == [True, True]
    assert [row[-1] for row in study.tables[0].rows] == [106, 34, 74, 110, 47, 88]
    assert [len(panel.series) for panel in study.panels] == [4, 4, 2, 2]
    for panel in study.panels:
        for series in panel.series:
            assert series.seeds.shape == (2, len(series.x))


@pytest.mark.slow
def test_all_numbers_come_out():
    assert [gate.name for gate in hallways.run(20, Silent()).gates if not gate.passed] == []
