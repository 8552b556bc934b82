"""The experiment on discovered options: short, and (slow) the numbers that must come out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lodestone.discovery.experience import Recording
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.experiments import discovery
from lodestone.learning.history import Episodes
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.progress import Silent
from lodestone.options.base import Primitives
from lodestone.planning.tables import tabulate

ARM = MagnetArm(rows=3, columns=3, bricks=2, tower_height=2)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small arm, few steps, and the fewest eigenvectors."""
    _, training = discovery.arm_settings()
    config = replace(training.config, network=NetworkConfig((3,), (3,), (4,), (16,)), learning_starts=200)
    monkeypatch.setattr(discovery, "arm_settings", lambda: (ARM, replace(training, config=config, decisions=3000)))
    monkeypatch.setattr(discovery, "ARM_METHOD", replace(discovery.ARM_METHOD, number=2))
    monkeypatch.setattr(discovery, "WALK", Recording(5, 100))
    monkeypatch.setattr(discovery, "HOUSE_STEPS", 3000)
    monkeypatch.setattr(discovery, "DIFFUSION", {0: 620.77})
    monkeypatch.setattr(discovery, "HOUSE_METHODS", {"8 covering options": discovery.CoveringConfig(number=8)})


def test_a_short_run_computes_exactly_and_shows_every_learner(small):
    study = discovery.run(2, Silent())
    gates = {gate.name: gate for gate in study.gates}
    assert [gate.passed for name, gate in gates.items() if name.startswith("four rooms:")][:3] == [True] * 3
    rows = study.tables[0].rows
    assert all(value == pytest.approx(wanted, rel=0.005, abs=1e-9) for _, value, wanted in rows)
    house, returns, built = study.panels
    assert [series.seeds.shape for series in house.series] == [(2, discovery.EPISODES)] * 2
    assert [series.seeds.shape[0] for series in returns.series] == [1, 1, 1]
    assert [len(series.seeds) for series in built.series] == [1, 1, 1]
    assert [series.seeds[0, -1] for series in built.series] == [1, 1, 1]  # anyone builds a tower of two
    first, by_hand, flat = study.tables[1].rows
    assert (first[1], by_hand[1], flat[1]) == (500, 0, 0)
    assert [row[3] for row in (first, by_hand, flat)] == ["1 of 1"] * 3
    assert int(str(first[2]).replace(",", "")) > 500


def test_a_seed_without_a_tower_counts_as_its_whole_budget_at_least():
    def episodes(*success: bool) -> Episodes:
        count = np.arange(1, len(success) + 1)
        return Episodes(count * 100, count * 100, np.zeros(len(count)), count, count, np.array(success))

    learned = {
        discovery.DISCOVERED: discovery._Learned(50, 1000, (episodes(False, True), episodes(True, False)), (0.5, 0.5)),
        discovery.BY_HAND: discovery._Learned(0, 1000, (episodes(False, True),), (0.5,)),
        discovery.FLAT: discovery._Learned(0, 1000, (episodes(False, False), episodes(False)), (0.0,)),
    }
    assert learned[discovery.DISCOVERED].first_successes() == [250, 150]
    assert learned[discovery.FLAT].first_successes() == [1000, 1000]
    table = discovery._arm_table(learned)
    assert [row[2] for row in table.rows] == ["200", "200", "at least 1,000"]
    assert [row[3] for row in table.rows] == ["2 of 2", "1 of 1", "0 of 2"]
    share, towers = discovery._arm_gates(learned)
    assert share.measured == pytest.approx(0.2)
    assert share.passed
    assert towers.measured == 1.0


def test_the_chance_of_an_episode_at_random_is_that_of_simulations():
    """Of the primitive actions: the powers of the random walk's matrix."""
    tables = tabulate(ARM)
    walk = tables.policy_matrix(np.full((tables.num_states, 6), 1 / 6)).toarray()
    after = tables.initial_probs @ np.linalg.matrix_power(walk, 30)
    assert 0.01 < after[tables.terminal].sum() < 0.99
    assert discovery.chance_of_success(ARM, Primitives(ARM.action_names), 30) == pytest.approx(
        after[tables.terminal].sum()
    )


@pytest.mark.slow
def test_all_numbers_come_out():
    assert [gate.name for gate in discovery.run(20, Silent()).gates if not gate.passed] == []
