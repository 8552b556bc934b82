"""The experiment on two kinds of optimality: short, and (slow) the numbers that must come out."""

from __future__ import annotations

import pytest

from lodestone.experiments import two_rooms
from lodestone.learning.progress import Silent


def test_a_short_run_knows_the_exact_values(monkeypatch):
    monkeypatch.setattr(two_rooms, "STEPS", 2000)
    monkeypatch.setattr(two_rooms, "LOOKS", 4)
    study = two_rooms.run(2, Silent())
    assert [gate.passed for gate in study.gates[:4]] == [True] * 4
    assert [row[1] for row in study.tables[0].rows] == pytest.approx([-7.75, -8.5, -7.75])
    for series in study.panels[0].series:
        assert series.seeds.shape == (2, len(series.x))


@pytest.mark.slow
def test_all_numbers_come_out():
    assert [gate.name for gate in two_rooms.run(20, Silent()).gates if not gate.passed] == []
