"""A run in its folder: its settings come back, and every agent goes on from a checkpoint to the same bits."""

from __future__ import annotations

import json
from dataclasses import replace

import jax
import numpy as np
import pytest

from lodestone.agents.deep_option_critic import DeepOptionCriticConfig
from lodestone.agents.dqn import DQNConfig
from lodestone.agents.hamq import HAMQConfig
from lodestone.agents.hdqn import HDQNConfig
from lodestone.agents.intra_option import IntraOptionConfig
from lodestone.agents.maxq import MAXQConfig
from lodestone.agents.option_critic import OptionCriticConfig
from lodestone.agents.policies import UnitedPolicy
from lodestone.agents.q_learning import QLearningConfig
from lodestone.agents.run import CONFIG, Run, read_run, save_run
from lodestone.agents.sarsa import SarsaConfig
from lodestone.agents.straw import StrawConfig
from lodestone.agents.training import AGENTS, train_policy
from lodestone.agents.united import UnitedConfig
from lodestone.envs.chain import Chain
from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.host import Registered
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.two_rooms import TwoRooms
from lodestone.errors import InvalidConfig
from lodestone.learning import checkpoints
from lodestone.learning.checkpoints import Checkpoints
from lodestone.learning.history import History
from lodestone.learning.networks import NetworkConfig, init_q_network
from lodestone.learning.united_network import init_united_network
from lodestone.options.base import Capped, Options, Primitives, Union, primitives
from lodestone.options.catalogue import named_options, tasks
from lodestone.options.execution import Rules
from lodestone.options.networks import NetworkOptions

ARM = MagnetArm(rows=3, columns=3, bricks=2, tower_height=2, observation="planes")
FLAT = NetworkConfig((), (), (), (8,))
PRIMITIVES, LIMITED = Primitives(ARM.action_names), Rules(discount=0.9, step_limit=40)


def run_of(agent: object, environment: object = None, options: Options | None = None, steps: int = 640) -> Run:
    environment = environment or Chain()
    primitives = Primitives(environment.action_names)
    return Run(agent, environment, LIMITED, options or primitives, steps, (3, 4))


RUNS = {
    "dqn": run_of(DQNConfig(network=FLAT, learning_starts=50)),
    "united": run_of(UnitedConfig(network=FLAT, learning_starts=50), ARM),
    "hdqn": run_of(HDQNConfig(network=FLAT, learning_starts=50)),
    "q-learning": run_of(QLearningConfig(epsilon=((0.0, 1.0), (0.3, 0.05)))),
    "sarsa": run_of(SarsaConfig()),
    "intra-option": run_of(IntraOptionConfig()),
    "option-critic": run_of(OptionCriticConfig()),
    "deep-option-critic": run_of(DeepOptionCriticConfig(network=FLAT, environments=4)),
    "straw": run_of(StrawConfig(network=FLAT, environments=4, rollout=8), ARM),
    "maxq": run_of(MAXQConfig(), TwoRooms()),
    "hamq": run_of(HAMQConfig(), ARM),
}


SLOW = ("dqn", "united", "hdqn", "q-learning", "sarsa", "maxq", "deep-option-critic", "straw")
"""Agents that take long to compile, or that are like others. `test_resume.py` has three of them."""


def train(run: Run, kept: Checkpoints) -> tuple[dict[str, np.ndarray], History]:
    with kept:
        policy, history = train_policy(
            run.agent, run.environment, run.options, run.rules, run.steps, run.seeds, checkpoints=kept
        )
    learned = {name: getattr(policy, name) for name in ("learned", "networks", "tables") if hasattr(policy, name)}
    return learned, history


@pytest.mark.parametrize("agent", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in AGENTS])
def test_every_agent_goes_on_to_the_same_bits(agent, monkeypatch, tmp_path):
    """From a checkpoint in the middle of the run."""
    monkeypatch.setattr(checkpoints, "KEPT", 1000)
    wanted, history = train(RUNS[agent], Checkpoints(tmp_path, "run", every=0.0))
    written = sorted(tmp_path.iterdir())
    assert len(written) == len(history.usage) - 1  # the last chunk ends the run
    for path in written[len(written) // 2 :]:
        path.unlink()
    found, again = train(RUNS[agent], Checkpoints(tmp_path, "run"))
    assert again.restored == len(written) // 2 > 5
    jax.tree.map(np.testing.assert_array_equal, found, wanted)
    for name, array in history.arrays().items():
        if name != "usage/seconds":
            np.testing.assert_array_equal(again.arrays()[name], array)


def networks(count: int, outputs: int):
    keys = jax.random.split(jax.random.key(0), count)
    return jax.vmap(lambda key: init_q_network(FLAT, (3, 3, 4), outputs, key))(keys)


OPTIONS = {
    "scripts": (ARM, Union((PRIMITIVES, Capped(named_options(ARM, ("lift", "go-down")), 7)))),
    "networks": (ARM, Union((Capped(NetworkOptions(tasks(ARM), networks(2, 6)), 21),))),
    "tables": (FourRooms(), Union((Primitives(FourRooms().action_names), named_options(FourRooms(), ("hallways",))))),
}


@pytest.mark.parametrize("agent", list(AGENTS))
def test_settings_come_back(agent, tmp_path):
    run = replace(RUNS[agent], checkpoint_every=1.5)
    save_run(tmp_path, run)
    assert read_run(tmp_path) == run
    assert json.loads((tmp_path / CONFIG).read_text())["versions"]["numpy"] == np.__version__


@pytest.mark.parametrize("kind", list(OPTIONS))
def test_options_come_back(kind, tmp_path):
    environment, options = OPTIONS[kind]
    save_run(tmp_path, run_of(QLearningConfig(), environment, options))
    found = read_run(tmp_path).options
    assert (found.names, found.max_steps) == (options.names, options.max_steps)
    jax.tree.map(np.testing.assert_array_equal, jax.tree.leaves(found), jax.tree.leaves(options))


def test_what_a_network_starts_as_comes_back(tmp_path):
    config = UnitedConfig(network=FLAT)
    keys = jax.random.split(jax.random.key(0), 1)
    made = jax.vmap(lambda key: init_united_network(FLAT, config.shared, (3, 3, 4), 6, 2, key))(keys)
    start = UnitedPolicy("united", ARM, tasks(ARM), 21, LIMITED, FLAT, config.shared, made, 0.2, (0,))
    save_run(tmp_path, replace(run_of(config, ARM), start=start, from_run="there/run"))
    found = read_run(tmp_path)
    assert found.from_run == "there/run"
    jax.tree.map(np.testing.assert_array_equal, found.start.networks, made)


def test_a_gymnasium_environment_comes_back_and_has_no_checkpoints(tmp_path):
    world = Registered("CartPole-v1", max_episode_steps=30)
    run = Run(DQNConfig(network=FLAT), world, Rules(), primitives(world), 100, (0,))
    save_run(tmp_path, run)
    assert read_run(tmp_path) == run
    with pytest.raises(InvalidConfig, match="keeps its state to itself"):
        train(run, Checkpoints(tmp_path, "run"))
    world.close()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"steps": 0}, "steps is 0"),
        ({"seeds": ()}, "at least one seed"),
        ({"seeds": (1, 2, 1)}, "seeds must differ"),
        ({"seeds": (2**31,)}, "seeds must be from -2147483648 to 2147483647"),
        ({"checkpoint_every": -1.0}, "checkpoint_every is -1.0"),
        ({"checkpoint_every": float("nan")}, "checkpoint_every is nan"),
    ],
)
def test_a_run_that_makes_no_sense_is_refused(changes, sentence):
    with pytest.raises(InvalidConfig, match=sentence):
        replace(RUNS["dqn"], **changes)
