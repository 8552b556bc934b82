"""Atari's games, where they are installed (`pip install 'lodestone[atari]'`)."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from lodestone.agents.deep_option_critic import DeepOptionCriticConfig
from lodestone.agents.dqn import DQNConfig
from lodestone.agents.training import train_policy
from lodestone.envs.host import Registered
from lodestone.envs.registry import make_environment
from lodestone.learning.networks import NetworkConfig
from lodestone.options.base import primitives
from lodestone.options.execution import Rules

pytest.importorskip("ale_py")
pytest.importorskip("cv2")

BREAKOUT = "lodestone.envs.atari:Atari/Breakout-v5"
NETWORK = NetworkConfig(kernels=(8,), strides=(8,), channels=(4,), hidden=(8,))


def test_the_last_four_steps_are_seen_the_newest_last():
    game = gymnasium.make(BREAKOUT, render_mode="rgb_array")
    seen, _ = game.reset(seed=0)
    assert seen in game.observation_space
    assert seen.shape == (84, 84, 4)
    frame = game.unwrapped.ale.getFrameNumber()
    for _ in range(6):
        before, (seen, *_) = seen, game.step(1)
        np.testing.assert_array_equal(seen[..., :3], before[..., 1:])
        frame += 4
        assert game.unwrapped.ale.getFrameNumber() == frame
    assert (seen[..., 3] != seen[..., 0]).any(), "nothing moves"
    assert game.render().shape == (210, 160, 3)
    game.close()


def test_every_game_of_ale_is_there_and_a_file_may_name_it():
    gymnasium.make(BREAKOUT).close()
    every, ours = ({one.name for one in gymnasium.registry.values() if one.namespace == of} for of in ("ALE", "Atari"))
    assert every == ours
    assert make_environment("gymnasium", id=BREAKOUT) == Registered(BREAKOUT)


@pytest.mark.parametrize(
    ("name", "config"),
    [
        (BREAKOUT, DQNConfig(network=NETWORK, environments=2, learning_starts=8)),
        ("ale_py:ALE/Breakout-v5", DeepOptionCriticConfig(network=NETWORK, environments=2, ticks_per_round=4)),
    ],
)
def test_networks_learn_in_it(name, config):
    """By the same code as anywhere."""
    game = Registered(name, max_episode_steps=9)
    assert primitives(game).names == ("noop", "fire", "right", "left")
    _, history = train_policy(config, game, primitives(game), Rules(), 32, [0])
    lengths = history.episodes(0).length_steps
    assert len(lengths) >= 2
    assert (lengths == 9).all()
