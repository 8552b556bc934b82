"""Judging a network on every start of a task."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import pytest

from lodestone.agents.dqn import DQNConfig
from lodestone.agents.pretraining import as_options, judge, pretrain
from lodestone.envs.magnet_arm import DOWN, MagnetArm, go_down_task, lift_task
from lodestone.learning.networks import NetworkConfig, init_q_network
from lodestone.options.execution import Rules
from lodestone.planning.solve import optimum

SMALL = NetworkConfig(kernels=(3,), strides=(3,), channels=(16,), hidden=(64,))
ARM = MagnetArm()


def always(action: int):
    """A network that prefers one action everywhere."""
    network = jax.tree.map(jnp.zeros_like, init_q_network(SMALL, (12, 9, 3), 6, jax.random.key(0)))
    bias = jnp.zeros(6).at[action].set(1.0)
    return network.__class__(
        network.convolutions, (network.layers[0], network.layers[1].__class__(network.layers[1].weight, bias))
    )


def test_always_down_goes_down_and_never_lifts():
    task = go_down_task(ARM)
    judgement = judge(task, always(DOWN), cap=21)
    assert judgement.success == 1.0
    assert judgement.starts == 21
    assert judgement.mean_steps == pytest.approx(2.0)
    assert optimum(task).optimal_steps == pytest.approx(1.82716, abs=1e-5)  # a step to a taller tower is shorter
    assert judge(lift_task(ARM), always(DOWN), cap=21).success == 0.0
    assert judge(task, always(DOWN), cap=1).success < 1.0


def test_pretraining_ends_when_an_option_is_good_enough():
    config = DQNConfig(network=SMALL, reward_scale=0.1, epsilon=((0.0, 1.0), (0.3, 0.1)))
    reports = []
    found = pretrain(
        go_down_task(ARM), config, Rules(step_limit=100), 15_000, [0], 21, lambda *report: reports.append(report)
    )
    assert found.judgement.success == 1.0
    assert found.judgement.mean_steps <= 1.01 * found.optimal_steps
    assert found.decisions < 15_000
    assert reports[-1] == (found.decisions, found.judgement)
    options = as_options([found, found])
    assert options.names == ("go-down", "go-down")
