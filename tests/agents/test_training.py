"""Training from settings to policies: machines and task graphs of one's own, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor import Corridor
from united_corridor import CORRIDOR, OPTIONS

from lodestone.agents.dqn import DQNConfig
from lodestone.agents.hamq import HAMQConfig
from lodestone.agents.hdqn import HDQNConfig
from lodestone.agents.maxq import MAXQConfig
from lodestone.agents.playing import play, play_many, record
from lodestone.agents.policies import GoalPolicy, MachinePolicy, UnitedPolicy
from lodestone.agents.saved import save_policy
from lodestone.agents.training import train_policy
from lodestone.agents.united import UnitedConfig
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.task import goal
from lodestone.envs.two_rooms import TwoRooms
from lodestone.errors import InvalidConfig
from lodestone.learning.networks import NetworkConfig
from lodestone.machines.machine import every_action
from lodestone.options.base import Primitives
from lodestone.options.execution import Rules
from lodestone.planning.solve import optimum
from lodestone.subtasks.task_graph import Child, Subtask, TaskGraph

END = goal(CORRIDOR, "end", type(CORRIDOR).terminal)
ARM = MagnetArm(rows=3, columns=3, bricks=2, tower_height=2)


def test_machines_of_ones_own_are_learned_and_played_and_not_saved(tmp_path):
    primitives = Primitives(ARM.action_names)
    rules = Rules(discount=0.95, decision_limit=100)
    policy, _ = train_policy(HAMQConfig(), ARM, primitives, rules, 40_000, [0, 1], hierarchy=every_action(ARM))
    assert isinstance(policy, MachinePolicy)
    best = optimum(ARM)
    np.testing.assert_allclose(play(policy, jax.random.key(0)).total_reward, best.optimal_return)
    assert len(record(policy, 0, jax.random.key(0), "hamq").option) == best.optimal_steps
    with pytest.raises(InvalidConfig, match="ready-made machines can be saved"):
        save_policy(tmp_path / "policy.safetensors", policy)
    assert list(tmp_path.iterdir()) == []


def test_machines_are_played_within_their_limits():
    """A policy that knows nothing lets go for ever, one choice a step."""
    rules = Rules(discount=0.95, decision_limit=7)
    policy, _ = train_policy(HAMQConfig(((0.0, 0.0),)), ARM, Primitives(ARM.action_names), rules, 100, [0])
    episode = play(policy, jax.random.key(0))
    assert int(episode.decisions[0]) == 7
    assert not episode.success[0]


def test_a_task_graph_of_ones_own_is_learned():
    """One subtask over all moves is flat Q-learning, and finds the flat optimum."""
    rooms = TwoRooms()
    moves = tuple(Child(name) for name in rooms.action_names)
    graph = TaskGraph((Subtask("root", rooms.terminal, moves),))
    rules = Rules(discount=1.0, step_limit=50)
    policy, _ = train_policy(
        MAXQConfig(((0.0, 0.5),)), rooms, Primitives(rooms.action_names), rules, 30_000, [0], graph=graph
    )
    flat = play_many(policy, jax.random.key(0), 20).total_reward[0]
    assert flat.mean() > -8.5
    assert flat.min() >= -14


def test_hierarchies_take_no_options_and_need_a_program():
    rooms = TwoRooms()
    with pytest.raises(InvalidConfig, match="no ready-made machines"):
        train_policy(HAMQConfig(), rooms, Primitives(rooms.action_names), Rules(step_limit=9), 100, [0])
    with pytest.raises(InvalidConfig, match="takes no options"):
        train_policy(MAXQConfig(), rooms, Primitives(("a", "b")), Rules(step_limit=9), 100, [0])


def test_a_united_network_is_trained_for_tasks_of_ones_own():
    config = UnitedConfig(
        network=NetworkConfig(kernels=(), strides=(), channels=(), hidden=(32,)), learning_starts=100, environments=4
    )
    primitives, rules = Primitives(CORRIDOR.action_names), Rules(discount=0.5, step_limit=50)
    policy, history = train_policy(config, CORRIDOR, primitives, rules, 4000, [0, 1], tasks=OPTIONS)
    assert isinstance(policy, UnitedPolicy)
    assert history.choices == policy.choices == ("basic policy", "to-2", "to-4")
    assert play(policy, jax.random.key(0)).success.all()
    playback = record(policy, 1, jax.random.key(0), "united")
    assert playback.option_names == policy.choices
    ended = playback.termination[:, 1:] > 0.5
    cells = np.arange(len(ended))  # it walks straight to the end
    np.testing.assert_array_equal(ended, np.stack([cells == 2, cells == 4], axis=1))
    values = policy.network(1)(CORRIDOR.observe(jnp.int32(0))).choices / config.reward_scale
    np.testing.assert_allclose(playback.values[0], values, rtol=1e-5)


def train_corridor(config: UnitedConfig, seeds, start=None, steps=1500) -> UnitedPolicy:
    primitives, rules = Primitives(CORRIDOR.action_names), Rules(discount=0.5, step_limit=50)
    policy, _ = train_policy(config, CORRIDOR, primitives, rules, steps, seeds, tasks=OPTIONS, start=start)
    assert isinstance(policy, UnitedPolicy)
    return policy


CORRIDOR_CONFIG = UnitedConfig(
    network=NetworkConfig(kernels=(), strides=(), channels=(), hidden=(16,)), learning_starts=100, environments=4
)


def test_a_manager_learns_over_options_that_stay_as_they_are():
    """Three seeds start from two networks in turn."""
    before = train_corridor(CORRIDOR_CONFIG, [0, 1])
    after = train_corridor(replace(CORRIDOR_CONFIG, training="manager"), [5, 6, 7], before)
    for position, start in enumerate((0, 1, 0)):
        old, new = before.network(start), after.network(position)
        same = [(old.trunk, new.trunk), (old.terminations, new.terminations)]
        same += [(old.policy(head), new.policy(head)) for head in (1, 2)]
        for was, stays in same:
            jax.tree.map(np.testing.assert_array_equal, was, stays)
        for was, learns in ((old.manager, new.manager), (old.policy(0).head, new.policy(0).head)):
            assert not np.allclose(was.layers[-1].weight, learns.layers[-1].weight, atol=1e-5)
    assert not np.allclose(after.networks.manager.layers[-1].weight[0], after.networks.manager.layers[-1].weight[2])


def test_learning_goes_on_where_it_was():
    before = train_corridor(CORRIDOR_CONFIG, [0])
    still = replace(CORRIDOR_CONFIG, learning_starts=1_000_000)
    jax.tree.map(np.testing.assert_array_equal, before.networks, train_corridor(still, [3], before, steps=100).networks)


def test_a_network_that_does_not_fit_is_no_start():
    start = train_corridor(CORRIDOR_CONFIG, [0], steps=200)
    wider = replace(CORRIDOR_CONFIG, network=replace(CORRIDOR_CONFIG.network, hidden=(17,)))
    primitives, longer = Primitives(CORRIDOR.action_names), Corridor(length=9)
    with pytest.raises(InvalidConfig, match="have to be the same"):
        train_corridor(wider, [0], start)
    with pytest.raises(InvalidConfig, match="needs a trained network to start from"):
        train_corridor(replace(CORRIDOR_CONFIG, training="manager"), [0])
    with pytest.raises(InvalidConfig, match="has the options to-2, to-4, but the new one has to-2"):
        train_policy(CORRIDOR_CONFIG, CORRIDOR, primitives, Rules(), 100, [0], tasks=OPTIONS[:1], start=start)
    with pytest.raises(InvalidConfig, match="another shape"):
        train_policy(CORRIDOR_CONFIG, longer, primitives, Rules(), 100, [0], tasks=OPTIONS, start=start)
    with pytest.raises(InvalidConfig, match="Only a united network"):
        train_policy(DQNConfig(), CORRIDOR, primitives, Rules(), 100, [0], start=start)


@pytest.mark.parametrize("config", [UnitedConfig(), HDQNConfig()])
def test_a_united_network_needs_tasks_and_hdqn_goals(config):
    rooms = TwoRooms()
    with pytest.raises(InvalidConfig, match="environment has none"):
        train_policy(config, rooms, Primitives(rooms.action_names), Rules(), 100, [0])


def test_hdqn_is_trained_for_goals_of_ones_own():
    config = HDQNConfig(network=NetworkConfig((), (), (), (32,)), learning_starts=100, max_goal_steps=10)
    primitives, rules = Primitives(CORRIDOR.action_names), Rules(discount=0.9, step_limit=50)
    policy, history = train_policy(config, CORRIDOR, primitives, rules, 6000, [0, 1], tasks=(*OPTIONS, END))
    assert isinstance(policy, GoalPolicy)
    assert history.choices == policy.choices == ("to-2", "to-4", "end")
    assert play(policy, jax.random.key(0)).success.all()
    playback = record(policy, 1, jax.random.key(0), "hdqn")
    assert playback.option_names == policy.choices
    assert len(playback.option) == 6  # it walks straight to the end
    np.testing.assert_array_equal(playback.termination[2], [1, 0, 0])
    np.testing.assert_array_equal(playback.available[2], [False, True, True])
    values = policy.network(1).goal_values(CORRIDOR.observe(jnp.int32(0))) / config.reward_scale
    np.testing.assert_allclose(playback.values[0], values, rtol=1e-5)
