"""Rollouts of the paper's own environment, replayed bit for bit through Gymnasium, where their file is at hand."""

import hashlib
import json
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import lodestone  # noqa: F401  (registers the environment)
from lodestone.envs.magnet_arm import BRICK

TRACES = Path(__file__).parents[3] / "shared" / "reference" / "magnet_arm_traces.json"

pytestmark = pytest.mark.skipif(not TRACES.exists(), reason=f"{TRACES} is not here")


def test_the_traces_of_the_papers_own_environment() -> None:
    for trace in json.loads(TRACES.read_text()):
        names = ("rows", "columns", "bricks", "tower_height", "step_limit", "pixels_per_cell")
        parameters = {name: trace[name] for name in names}
        rewards = {name: float(trace[name]) for name in ("tower_reward", "step_reward")}
        env = gymnasium.make("lodestone/MagnetArm-v0", **parameters, **rewards)
        assert trace["episodes"]
        for episode in trace["episodes"]:
            observation, _ = env.reset()
            _same(env, observation, episode, 0)
            for time, action in enumerate(episode["actions"]):
                observation, reward, terminated, truncated, info = env.step(action)
                _same(env, observation, episode, time + 1)
                assert reward == episode["reward"][time]
                assert terminated == info["success"] == episode["success"][time]
                assert (terminated or truncated) == episode["ended"][time]


def _same(env: gymnasium.Env, observation: np.ndarray, episode: dict, time: int) -> None:
    assert hashlib.sha256(observation.tobytes()).hexdigest() == episode["image_sha256"][time]
    state = env.unwrapped.state
    assert [int(state.row), int(state.column)] == episode["arm"][time]
    assert bool(state.magnet) == episode["magnet"][time]
    grid = np.asarray(env.unwrapped.environment.cell_codes(state)) == BRICK
    np.testing.assert_array_equal(grid, np.array(episode["grid"][time], dtype=bool))
