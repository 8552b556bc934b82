"""The paper's experiments: the protocol to the letter, a tiny run end to end, and (slow) the numbers that must come
out."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from lodestone.errors import UnknownName
from lodestone.experiments import magnet_tower
from lodestone.experiments.magnet_tower import FLAT, WITH_OPTIONS, run, settings, total_work
from lodestone.learning.progress import Silent
from lodestone.report.reproduction import Reproduction


@pytest.mark.parametrize(("figure", "decisions"), [("2", 100_000), ("3", 500_000)])
def test_the_paper_preset_is_the_authors_protocol(figure, decisions):
    chosen = settings(figure, "paper")
    for name, limit in ((WITH_OPTIONS, 201), (FLAT, 200)):
        training = chosen.agents[name]
        config = training.config
        assert training.decisions == decisions
        assert training.rules.decision_limit == limit
        assert training.rules.undiscounted_option_reward
        assert not training.rules.bootstrap_at_limit
        assert (config.environments, config.decisions_per_round, config.updates_per_round) == (1, 1, 1)
        assert (config.batch_size, config.learning_starts, config.target_period) == (32, 5000, 200)
        assert (config.replay_capacity, config.adam_epsilon, config.max_gradient_norm) == (1_000_000, 1e-4, 10)
        assert [(round(time * decisions), value) for time, value in config.learning_rate] == [
            (0, 1e-4),
            (decisions // 40, 1e-4),
            (decisions // 8, 5e-5),
        ]
        assert not config.double
        assert config.reward_scale == config.huber_delta == 1
        assert (config.network.kernels, config.network.strides) == ((8, 4, 3), (4, 2, 1))
        assert (config.network.channels, config.network.hidden) == ((32, 64, 64), (256,))
    epsilon = [(round(time * 500_000), value) for time, value in settings("3", "paper").agents[FLAT].config.epsilon]
    assert epsilon == [(0, 1.0), (80_000, 0.3), (200_000, 0.01)]
    for name, budget in (("go-down", 200_000), ("lift", 400_000)):
        training = chosen.pretraining[name]
        assert training.decisions == budget
        assert training.rules.step_limit == 100
        assert [(round(time * budget), value) for time, value in training.config.epsilon] == [
            (0, 1.0),
            (8_000, 0.3),
            (budget // 4, 0.01),
        ]


def test_unknown_figures_and_presets_are_refused():
    with pytest.raises(UnknownName, match="'4'"):
        settings("4", "fast")
    with pytest.raises(UnknownName, match="'slow'"):
        settings("2", "slow")


def tiny() -> magnet_tower.Settings:
    """Figure 2 with budgets of a few seconds."""
    chosen = settings("2", "fast")
    return replace(
        chosen,
        pretraining={name: replace(training, decisions=2000) for name, training in chosen.pretraining.items()},
        agents={name: replace(training, decisions=2000) for name, training in chosen.agents.items()},
    )


@pytest.mark.slow
def test_a_tiny_run_fills_the_folder(tmp_path):
    reproduction = Reproduction(tmp_path, "fast", 2, "2")
    saved = []

    def save(trained):
        reproduction.save(trained)
        saved.append(reproduction.finished)

    run(tiny(), [0, 1], Silent(), save)
    assert saved == [["figure-2 DQN with options"], ["figure-2 DQN with options", "figure-2 DQN"]]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(reproduction.files)
    results = json.loads((tmp_path / "results.json").read_text())
    figure = results["figures"][0]
    assert figure["name"] == "figure-2"
    assert {gate["name"] for gate in results["gates"]} >= {"figure-2: decisions to return 70, DQN with options / DQN"}
    assert all(set(gate) == {"name", "measured", "required", "passed"} for gate in results["gates"])
    assert (tmp_path / "figure-2.png").read_bytes()[:4] == b"\x89PNG"
    assert "http" not in (tmp_path / "report.html").read_text().replace("http-equiv", "")


def test_work_counts_updates():
    chosen = tiny()
    work = total_work([chosen], seeds=3)
    assert work == pytest.approx(2 * 2 * 2000 + 2 * 3 * 2000)


@pytest.mark.slow
@pytest.mark.parametrize("figure", ["2", "3"])
def test_fast_preset_reaches_its_numbers(figure):
    trained = run(settings(figure, "fast"), range(6), Silent(), lambda trained: None)
    missed = [gate for gate in magnet_tower.gates([trained], "fast") if not gate.passed]
    assert missed == []
