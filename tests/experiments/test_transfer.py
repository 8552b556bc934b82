"""The experiment on transfer: its judgement of options against a plain loop, and a short run."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.agents.policies import UnitedPolicy
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


@eqx.filter_jit
def look(task, network, state):
    return network(task.observe(state))


@eqx.filter_jit
def move(task, state, action):
    return task.transition(state, action, jnp.int32(0))


@eqx.filter_jit
def over(task, state):
    return task.terminal(state)


def plain_success(policy: UnitedPolicy, network, head: int) -> tuple[float, float]:
    """One layout and one step at a time."""
    task = policy.tasks[head - 1]
    _, starts = task.initial_distribution()
    done, stopped = [], []
    for position in range(len(starts.row)):
        state = jax.tree.map(lambda leaf, position=position: leaf[position], starts)
        reached = well = False
        running = True
        for _ in range(policy.option_cap):
            action = np.int32(np.argmax(look(task, network, state).actions[head]))
            state = move(task, state, action)
            reached |= bool(over(task, state))
            if running and look(task, network, state).termination[head - 1] > 0.5:
                running, well = False, bool(over(task, state))
        done.append(reached)
        stopped.append(well)
    return float(np.mean(done)), float(np.mean(stopped))


def at_random(arm: MagnetArm, seeds: tuple[int, ...]) -> UnitedPolicy:
    keys = jax.random.split(jax.random.key(0), 12)[jnp.asarray(seeds)]
    networks = jax.vmap(lambda key: init_united_network(SHAPE, "hidden", (arm.rows, arm.columns, 4), 6, 2, key))(keys)
    return UnitedPolicy("united", arm, tasks(arm), 21, Rules(), SHAPE, "hidden", networks, 1.0, seeds)


def test_success_is_that_of_a_plain_loop():
    """Of networks at random that do a task from some layouts by chance, as not all do; on another grid, too."""
    source = at_random(SMALL, (2, 10))
    for arm in (SMALL, LARGE):
        judged, where = transfer._judge(source, arm), replace(source, environment=arm, tasks=tasks(arm))
        assert judged.policies.max() > judged.options.max() > 0
        for position in (0, 1):
            for head in (1, 2):
                found = judged.policies[position, head - 1], judged.options[position, head - 1]
                assert found == pytest.approx(plain_success(where, source.network(position), head))


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transfer, "STEPS", 6000)


@pytest.mark.slow
def test_a_short_run_judges_everywhere_and_learns_on(monkeypatch):
    monkeypatch.setattr(transfer, "SOURCE", SMALL)
    monkeypatch.setattr(transfer, "TARGET", LARGE)
    monkeypatch.setattr(transfer, "OTHERS", (LARGE,))
    config = replace(transfer.CONFIG, network=SHAPE, learning_starts=500)
    ways = {transfer.AS_THEY_ARE: replace(config, training="manager"), transfer.SCRATCH: config}
    monkeypatch.setattr(transfer, "WAYS", ways)
    monkeypatch.setattr(transfer, "CONFIG", config)
    study = transfer.run(2, Silent())
    judged, learned = study.tables
    assert [row[0] for row in judged.rows] == ["3x3, 2 bricks, height 2 (learned here)", "4x3, 3 bricks, height 3"]
    assert [row[1] for row in judged.rows] == [9, 21]
    assert [row[0] for row in learned.rows] == list(ways)
    assert [len(series.seeds) for series in study.panels[0].series] == [2, 2]


def test_networks_at_random_fail_in_most_ways():
    judged = transfer._judge(at_random(LARGE, (0, 1)), LARGE)
    assert judged.options.mean() < 0.5
    assert (judged.terminations > 0.1).all()
    assert not judged.towers.any()


@pytest.mark.slow
def test_all_numbers_come_out(monkeypatch):
    monkeypatch.undo()
    assert [gate.name for gate in transfer.run(10, Silent()).gates if not gate.passed] == []
