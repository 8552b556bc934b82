"""The experiment on united networks: a short run on a tiny tower, and (slow) the numbers that must come out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lodestone.envs.magnet_arm import MagnetArm
from lodestone.experiments import united
from lodestone.learning.history import History
from lodestone.learning.progress import Silent


def test_a_short_run_shows_separate_and_united(monkeypatch):
    """Stages, which take the longest to compile, are tested with the learner."""
    tower = replace(
        united.SIZES[0],
        arm=MagnetArm(rows=3, columns=3, bricks=2, tower_height=2),
        config=replace(united.SIZES[0].config, learning_starts=500, updates_per_round=1),
        steps=4000,
    )
    monkeypatch.setattr(united, "WINDOW", 5)
    forms = {form: united.FORMS[form] for form in (united.SEPARATE, united.UNITED)}
    monkeypatch.setattr(united, "FORMS", forms)
    monkeypatch.setattr(united, "SIZES", (tower,))
    study = united.run(2, Silent())
    table = {row[0]: row[1:] for row in study.tables[0].rows}
    assert table[united.UNITED][0] < 0.4 * table[united.SEPARATE][0]
    assert [series.name for series in study.panels[0].series] == list(forms)
    for series in study.panels[0].series:
        assert series.seeds.shape == (2, len(series.x))
        assert np.nanmax(series.seeds) <= 94  # the optimum: six steps
    assert {gate.name: gate.passed for gate in study.gates}["4x3: parameters, united / separate"]


def test_decisions_to_a_threshold_count_from_the_start():
    class TwoSeeds(History):
        def episodes(self, seed: int):
            count = np.arange(1, 101)
            returns = np.where(count > 20, 80.0, -50.0) if seed == 0 else np.full(100, 40.0)
            return super().episodes(seed)._replace(decisions=7 * count, total_reward=returns)

    # With b bad episodes among the last 50 the mean is 80 - 2.6 b: above 50 from b = 11 on, which is at episode 59.
    assert united.decisions_to(TwoSeeds(2, ("a",)), 50.0) == [7 * 59, float("inf")]


@pytest.mark.slow
def test_all_numbers_come_out():
    assert [gate.name for gate in united.run(10, Silent()).gates if not gate.passed] == []
