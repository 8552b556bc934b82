"""Atari's games, where they are installed (`pip install 'lodestone[atari]'`)."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

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


def test_the_places_in_montezumas_first_room(capsys):
    """The program of docs/hdqn.md runs; down is the foot of the ladder, a jump to the left the left door."""
    text = (Path(__file__).parents[2] / "docs" / "hdqn.md").read_text()
    (program,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    names: dict = {}
    exec(compile(program.replace("2_500_000", "64"), "docs/hdqn.md", "exec", dont_inherit=True), names)
    assert "'key': " in capsys.readouterr().out

    game = gymnasium.make("ale_py:ALE/MontezumaRevenge-v5", obs_type="ram", repeat_action_probability=0.0)
    actions = game.unwrapped.get_action_meanings()

    def held(*script: tuple[str, int]) -> list[str]:
        """Which goals hold on the way, each once."""
        seen, _ = game.reset(seed=0)
        found: dict[str, None] = {}
        for word in [word for word, count in script for _ in range(count)]:
            seen, *_ = game.step(actions.index(word))
            state = SimpleNamespace(seen=SimpleNamespace(observation=seen))
            found |= {name: None for name, holds in names["GOALS"].items() if holds(None, state)}
        return list(found)

    assert held(("NOOP", 10)) == []
    assert held(("NOOP", 10), ("DOWN", 9)) == ["foot of the middle ladder"]
    assert held(("NOOP", 10), ("LEFT", 3), ("LEFTFIRE", 10), ("LEFT", 6)) == ["left door"]
    game.close()
