"""The experiment on transfer: its judgement of options against a plain loop, and a short run."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from lodestone.agents.saved import UnitedPolicy
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.experiments import transfer
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.progress import Silent
from lodestone.learning.united_network import init_united_network
from lodestone.options.catalogue import tasks
from lodestone.options.execution import Rules

SMALL = MagnetArm(3, 3, 2, 2, observation="planes")
LARGE = MagnetArm(4, 3, 3, 3, observation="planes")
SHAPE = NetworkConfig(kernels=(3,), strides=(1,), channels=(16,), hidden=(32,), pooling=True)


def plain_success(policy: UnitedPolicy, network, head: int) -> tuple[float, float]:
    """One layout and one step at a time."""
    task = policy.tasks[head - 1]
    look, move, over = (
        jax.jit(lambda state: network(task.observe(state))),
        jax.jit(task.transition),
        jax.jit(task.terminal),
    )
    _, starts = task.initial_distribution()
    done, stopped = [], []
    for position in range(len(starts.row)):
        state = jax.tree.map(lambda leaf, position=position: leaf[position], starts)
        reached = well = False
        running = True
        for _ in range(policy.option_cap):
            action = np.int32(np.argmax(look(state).actions[head]))
            state = move(state, action, np.int32(0))
            reached |= bool(over(state))
            if running and look(state).termination[head - 1] > 0.5:
                running, well = False, bool(over(state))
        done.append(reached)
        stopped.append(well)
    return float(np.mean(done)), float(np.mean(stopped))


def test_success_is_that_of_a_plain_loop():
    """By networks that were learned a little, on another grid than theirs."""
    config = replace(transfer.CONFIG, network=SHAPE, learning_starts=500)
    policy, _ = transfer._learn("source", SMALL, config, None, 1, Silent())
    elsewhere = replace(policy, environment=LARGE, tasks=tasks(LARGE))
    for where in (policy, elsewhere):
        judged = transfer._judge(policy, where.environment)
        for head in (1, 2):
            found = judged.policies[0, head - 1], judged.options[0, head - 1]
            assert found == pytest.approx(plain_success(where, policy.network(0), head))
    assert judged.policies.mean() > 0.1


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transfer, "STEPS", 6000)


def test_a_short_run_judges_everywhere_and_learns_in_every_way(monkeypatch):
    monkeypatch.setattr(transfer, "SOURCE", SMALL)
    monkeypatch.setattr(transfer, "TARGET", LARGE)
    monkeypatch.setattr(transfer, "OTHERS", (LARGE,))
    ways = {way: replace(config, network=SHAPE, learning_starts=500) for way, config in transfer.WAYS.items()}
    monkeypatch.setattr(transfer, "WAYS", ways)
    monkeypatch.setattr(transfer, "CONFIG", ways[transfer.TUNED])
    study = transfer.run(2, Silent())
    judged, learned = study.tables
    assert [row[0] for row in judged.rows] == ["3x3, 2 bricks, height 2 (learned here)", "4x3, 3 bricks, height 3"]
    assert [row[1] for row in judged.rows] == [9, 21]
    assert [row[0] for row in learned.rows] == list(transfer.WAYS)
    assert [len(series.seeds) for series in study.panels[0].series] == [2, 2, 2]


def test_networks_at_random_fail_everywhere():
    keys = jax.random.split(jax.random.key(0), 2)
    networks = jax.vmap(lambda key: init_united_network(SHAPE, "hidden", (4, 3, 4), 6, 2, key))(keys)
    policy = UnitedPolicy("united", LARGE, tasks(LARGE), 21, Rules(), SHAPE, "hidden", networks, 1.0, (0, 1))
    judged = transfer._judge(policy, LARGE)
    assert judged.options.max() < 0.5
    assert (judged.terminations > 0.1).all()
    assert not judged.towers.any()


@pytest.mark.slow
def test_all_numbers_come_out(monkeypatch):
    monkeypatch.undo()
    assert [gate.name for gate in transfer.run(10, Silent()).gates if not gate.passed] == []
