"""The experiment on options that fall out of use: what is exact by closed forms; short; and (slow) the numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lodestone.experiments import option_usage
from lodestone.experiments.option_usage import DISCOUNTED, FEWER, GOAL_ONLY, SUM, VARIANTS
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.progress import Silent


def test_a_plain_sum_costs_what_discounting_takes_off():
    """The longest option that is best somewhere takes five steps: 5 instead of 1 + gamma + ... + gamma^4."""
    plain = option_usage._plan(VARIANTS[SUM])
    gamma = option_usage.DISCOUNT
    assert plain.loss == pytest.approx(5 - (1 - gamma**5) / (1 - gamma), abs=1e-4)
    assert plain.worse > 0
    assert plain.steps == pytest.approx(13)


@pytest.mark.parametrize(("name", "steps"), [(DISCOUNTED, 13), (FEWER, 15), (GOAL_ONLY, 13)])
def test_each_cure_makes_the_best_options_as_good_as_they_are(name, steps):
    exact = option_usage._plan(VARIANTS[name])
    assert (exact.worse, exact.steps) == (0, pytest.approx(steps))


def test_a_short_run_shows_every_variant(monkeypatch):
    network = NetworkConfig((3,), (3,), (4,), (16,))
    training = replace(
        option_usage.TRAINING, config=replace(option_usage.TRAINING.config, network=network, learning_starts=2000)
    )
    monkeypatch.setattr(option_usage, "TRAINING", training)
    monkeypatch.setattr(option_usage, "DECISIONS", 2000)
    study = option_usage.run(2, Silent())
    assert [row[0] for row in study.tables[0].rows] == list(VARIANTS)
    for panel in study.panels:
        assert [series.name for series in panel.series] == list(VARIANTS)
        for series in panel.series:
            assert series.seeds.shape == (2, len(series.x))
            assert ((series.seeds >= 0) & (series.seeds <= 1)).all()
    # An option takes a step at least. At first all is chance: two options, where they may start, among eight or five.
    steps, calls = ({series.name: series.seeds for series in panel.series} for panel in study.panels)
    assert (steps[DISCOUNTED] >= calls[DISCOUNTED]).all()
    few, many = (calls[name][:, :5].mean() for name in (DISCOUNTED, FEWER))
    assert few <= 0.25
    assert few < many <= 0.4
    assert np.isfinite([gate.measured for gate in study.gates[:3]]).all()


@pytest.mark.slow
def test_all_numbers_come_out():
    assert [gate.name for gate in option_usage.run(10, Silent()).gates if not gate.passed] == []
