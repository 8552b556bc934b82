"""The experiment on the taxi: short, and (slow) the numbers that must come out."""

from __future__ import annotations

import numpy as np
import pytest

from lodestone.experiments import taxi
from lodestone.learning.progress import Silent


def test_a_short_run_is_judged_within_its_limits(monkeypatch):
    monkeypatch.setattr(taxi, "STEPS", dict.fromkeys(taxi.STEPS, 2000))
    monkeypatch.setattr(taxi, "LOOKS", 6)
    study = taxi.run(2, Silent())
    assert [gate.passed for gate in study.gates[:2]] == [True, True]
    assert [row[:2] for row in study.tables[0].rows] == [(taxi.ABSTRACT, 613), (taxi.WHOLE, 9728), (taxi.FLAT, 2424)]
    for panel in study.panels:
        assert len(panel.series) == 3
        for series in panel.series:
            known = series.seeds[np.isfinite(series.seeds)]
            assert ((known >= -10 * taxi.JUDGED_STEPS) & (known <= 7.93 + 1e-9)).all()


@pytest.mark.slow
def test_all_numbers_come_out():
    assert [gate.name for gate in taxi.run(20, Silent()).gates if not gate.passed] == []
