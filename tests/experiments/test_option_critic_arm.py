"""The experiment on option-critic from pictures: short, and (slow) the numbers that must come out."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from lodestone.envs.base import observation_shape
from lodestone.experiments import option_critic_arm
from lodestone.experiments.option_critic_arm import ARM, FOUR, RULES, exactly
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.option_network import init_option_network
from lodestone.learning.progress import Silent
from lodestone.planning.solve import evaluate_policy, value_iteration
from lodestone.planning.tables import tabulate


def test_a_network_that_knows_nothing_is_worth_a_random_walk():
    init = jax.vmap(lambda key: init_option_network(option_critic_arm._FOUR.network, observation_shape(ARM), 4, 6, key))
    gaps, stops = exactly(init(jax.random.split(jax.random.key(0), 2)), 1.0)
    tables = tabulate(ARM)
    uniform = evaluate_policy(tables, np.full((tables.num_states, 6), 1 / 6), RULES.discount)
    best = value_iteration(tables, RULES.discount).values
    np.testing.assert_allclose(gaps, tables.initial_mean(best - uniform), rtol=1e-9)
    np.testing.assert_allclose(stops, 0.5)


def test_a_short_run_shows_a_learner(monkeypatch):
    small = replace(
        option_critic_arm._FOUR, network=NetworkConfig((3,), (3,), (4,), (8,)), environments=4, ticks_per_round=8
    )
    monkeypatch.setattr(option_critic_arm, "CONFIGS", {FOUR: small})
    for name, value in (("COLLAPSES", (FOUR,)), ("STEPS", 12_000), ("LOOKS", 5), ("WINDOW", 5)):
        monkeypatch.setattr(option_critic_arm, name, value)
    monkeypatch.setattr(option_critic_arm, "_gates", lambda runs: [])
    study = option_critic_arm.run(2, Silent())
    assert [len(panel.series) for panel in study.panels] == [1, 1, 1, 1]
    assert [len(table.rows) for table in study.tables] == [1, 1]
    lengths, stops, shares = (panel.series[0].seeds for panel in study.panels[1:])
    assert (lengths[:, -1] >= 1).all()
    assert ((stops[:, -1] > 0) & (stops[:, -1] < 1)).all()
    assert ((shares[:, -1] >= 0.25) & (shares[:, -1] <= 1)).all()
    assert np.isfinite([row[5] for row in study.tables[0].rows]).all()


@pytest.mark.slow
def test_all_numbers_come_out():
    study = option_critic_arm.run(10, Silent())
    assert [gate.name for gate in study.gates if not gate.passed] == []
