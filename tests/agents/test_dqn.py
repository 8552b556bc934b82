"""The learner against closed forms, a NumPy second implementation, and itself under other batchings."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor import Corridor, Walk

from lodestone.agents.dqn import DQNConfig, dqn, loss
from lodestone.errors import Diverged, InvalidConfig
from lodestone.learning.loop import train
from lodestone.learning.networks import NetworkConfig, init_q_network
from lodestone.options.base import Primitives, Union
from lodestone.options.execution import Rules
from lodestone.types import Transition

LINEAR = NetworkConfig(kernels=(), strides=(), channels=(), hidden=())
SMALL = NetworkConfig(kernels=(), strides=(), channels=(), hidden=(16,))
CORRIDOR = Corridor(length=5)
OPTIONS = Union((Primitives(CORRIDOR.action_names), Walk(stop=3, chance=0.2)))


def random_batch(size: int) -> Transition:
    rng = np.random.default_rng(0)
    available = rng.random((size, 3)) < 0.6
    available[:, 1] = True
    discount = 0.9 ** rng.integers(1, 5, size) * (rng.random(size) < 0.8)
    available[discount == 0] = False  # nothing needs to be available after the end
    return Transition(
        obs=jnp.asarray(rng.normal(size=(size, 5)), dtype=jnp.float32),
        action=jnp.asarray(rng.integers(0, 3, size), dtype=jnp.int32),
        reward=jnp.asarray(rng.normal(size=size) * 3, dtype=jnp.float32),
        discount=jnp.asarray(discount, dtype=jnp.float32),
        next_obs=jnp.asarray(rng.normal(size=(size, 5)), dtype=jnp.float32),
        next_available=jnp.asarray(available),
    )


def numpy_q(network, x: np.ndarray) -> np.ndarray:
    for layer in network.layers[:-1]:
        x = np.maximum(x @ np.asarray(layer.weight) + np.asarray(layer.bias), 0)
    return x @ np.asarray(network.layers[-1].weight) + np.asarray(network.layers[-1].bias)


@pytest.mark.parametrize(("double", "delta"), [(False, 1.0), (True, 1.0), (True, 0.3)])
def test_loss_equals_a_plain_numpy_loop(double, delta):
    batch = random_batch(20)
    network = init_q_network(SMALL, (5,), 3, jax.random.key(0))
    target = init_q_network(SMALL, (5,), 3, jax.random.key(1))
    total = 0.0
    for index in range(20):
        one = jax.tree.map(lambda leaf, index=index: np.asarray(leaf[index]), batch)
        wanted = one.reward * 0.5
        if one.discount > 0:
            usable = np.flatnonzero(one.next_available)
            later = numpy_q(target, one.next_obs)
            judge = numpy_q(network, one.next_obs) if double else later
            wanted += one.discount * later[usable[np.argmax(judge[usable])]]
        error = abs(wanted - numpy_q(network, one.obs)[one.action])
        total += 0.5 * error**2 if error <= delta else delta * (error - 0.5 * delta)
    found = loss(DQNConfig(double=double, reward_scale=0.5, huber_delta=delta), network, target, batch)
    assert float(found) == pytest.approx(total, rel=1e-5)


@pytest.mark.parametrize(("reward", "slope"), [(0.4, 0.4), (7.0, 1.0), (-7.0, -1.0)])
def test_gradient_of_a_one_hot_linear_network_is_the_tabular_update(reward, slope):
    """With one-hot states the step along the negative gradient is Q-learning's, cut at 1 by Huber."""
    network = jax.tree.map(jnp.zeros_like, init_q_network(LINEAR, (5,), 3, jax.random.key(0)))
    batch = Transition(
        obs=jnp.eye(5)[2:3],
        action=jnp.array([1], dtype=jnp.int32),
        reward=jnp.array([reward]),
        discount=jnp.array([0.9]),
        next_obs=jnp.eye(5)[3:4],
        next_available=jnp.ones((1, 3), dtype=bool),
    )
    gradient = jax.grad(partial(loss, DQNConfig()))(network, network, batch)
    wanted = np.zeros((5, 3))
    wanted[2, 1] = -slope
    np.testing.assert_allclose(gradient.layers[0].weight, wanted, atol=1e-6)


def settings(**changes) -> DQNConfig:
    values = {
        "network": SMALL,
        "learning_starts": 16,
        "environments": 4,
        "decisions_per_round": 6,
        "updates_per_round": 5,
        "target_period": 10,
        "batch_size": 8,
    }
    return DQNConfig(**(values | changes))


def run(config: DQNConfig, seeds: list[int], rounds: int, chunk: int):
    algorithm = dqn(config, CORRIDOR, OPTIONS, Rules(discount=0.9, step_limit=30), rounds * config.decisions_per_round)
    chunks = []
    for carry, one in train(algorithm, seeds, rounds, chunk):
        chunks.append(one)
    return jax.tree.map(np.asarray, carry.learner), chunks


def test_target_network_is_copied_every_period_and_frozen_between():
    # Learning starts in round 2; after 4 rounds there were 10 updates: the first copy.
    learner, _ = run(settings(), [0], rounds=4, chunk=4)
    jax.tree.map(np.testing.assert_array_equal, learner.target, learner.network)
    learner, _ = run(settings(), [0], rounds=5, chunk=5)
    assert not np.array_equal(learner.target.layers[0].weight, learner.network.layers[0].weight)
    before, _ = run(settings(target_period=1000), [0], rounds=2, chunk=2)
    after, _ = run(settings(target_period=1000), [0], rounds=9, chunk=9)
    jax.tree.map(np.testing.assert_array_equal, before.target, after.target)


def test_updates_keep_pace_with_decisions():
    learner, chunks = run(settings(), [0, 1, 2], rounds=50, chunk=7)
    decisions = sum(chunk.log.valid.sum(axis=(1, 2)) for chunk in chunks)
    assert np.all((decisions >= 300) & (decisions < 300 + 4))
    np.testing.assert_array_equal(learner.replay.size, decisions)
    np.testing.assert_array_equal(learner.adam.count, 48 * 5)


def test_chunks_and_other_seeds_change_nothing():
    together, _ = run(settings(), [3, 4, 5], rounds=12, chunk=12)
    alone, _ = run(settings(), [4], rounds=12, chunk=5)
    np.testing.assert_array_equal(together.replay.storage.action[1], alone.replay.storage.action[0])
    np.testing.assert_allclose(together.network.layers[0].weight[1], alone.network.layers[0].weight[0], atol=1e-5)


def test_an_exploding_loss_stops_the_run_with_advice():
    config = settings(reward_scale=1e38, learning_rate=((0.0, 1.0),))
    with pytest.raises(Diverged, match="smaller learning rate"):
        run(config, [0], rounds=60, chunk=20)


@pytest.mark.parametrize(
    "wrong",
    [
        {"learning_rate": ((0.0, float("nan")),)},
        {"learning_rate": ((0.0, float("inf")),)},
        {"epsilon": ((0.0, 1.5),)},
        {"batch_size": 0},
        {"reward_scale": 0.0},
        {"huber_delta": 0.0},
        {"learning_starts": -1},
        {"replay_capacity": 3},
    ],
)
def test_bad_settings_are_refused(wrong):
    with pytest.raises(InvalidConfig, match=next(iter(wrong))):
        DQNConfig(**wrong)
