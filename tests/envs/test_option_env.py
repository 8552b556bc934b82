"""Options as actions of a Gymnasium environment, against the arithmetic done by hand."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from lodestone.envs.option_env import HostOption, OptionEnv
from lodestone.errors import InvalidConfig, NoOptionAvailable


class Stairs(gymnasium.Env):
    """Action 3 climbs, action 2 stays; every step pays how high it ends. The 5th stair is the end, a limit is at 6
    steps."""

    observation_space = spaces.Discrete(6)
    action_space = spaces.Discrete(2, start=2)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self.height, self.time = 0, 0
        return 0, {"action_mask": np.array([0, 1], np.int8)}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        self.height, self.time = self.height + action - 2, self.time + 1
        info = {"action_mask": np.array([1, 1], np.int8)}
        return self.height, float(self.height), self.height == 5, self.time == 6, info


TO_THREE = HostOption("to three", lambda seen, info: 3, lambda seen, info: seen == 3, lambda seen, info: seen < 3)
UP = HostOption("up", lambda seen, info: 3, lambda seen, info: 0.0)
WAIT = HostOption("wait", lambda seen, info: 2, lambda seen, info: 0.0)


def test_an_option_runs_to_its_end_and_is_discounted_inside():
    stairs = OptionEnv(Stairs(), [TO_THREE, UP, WAIT], discount=0.5)
    assert stairs.option_names == ("0", "1", "to three", "up", "wait")
    _, info = stairs.reset(seed=0)
    assert info["action_mask"].tolist() == [0, 1, 1, 1, 1]
    seen, reward, terminated, truncated, info = stairs.step(2)
    assert (seen, reward, terminated, truncated) == (3, 1 + 0.5 * 2 + 0.25 * 3, False, False)
    assert (info["steps"], info["discount"], info["total_reward"]) == (3, 0.125, 6.0)
    assert info["action_mask"].tolist() == [1, 1, 0, 1, 1]
    seen, reward, terminated, truncated, info = stairs.step(3)
    assert (seen, reward, terminated, truncated, info["steps"]) == (5, 4 + 0.5 * 5, True, False, 2)


def test_one_that_a_limit_cuts_bootstraps_from_itself():
    stairs = OptionEnv(Stairs(), [UP, WAIT], discount=0.5)
    stairs.reset(seed=0)
    assert stairs.step(1)[4]["steps"] == 1
    _, reward, terminated, truncated, info = stairs.step(3)
    assert (terminated, truncated, info["steps"], info["discount"]) == (False, True, 5, 0.5**5)
    assert reward == pytest.approx(sum(0.5**i for i in range(5)))
    assert info["action_mask"].tolist() == [0, 0, 0, 1]


def test_a_cap_and_chance_end_options():
    half = HostOption("half", lambda seen, info: 2, lambda seen, info: 0.5, max_steps=3)
    stairs = OptionEnv(Stairs(), [half], discount=1.0, primitives=False)
    lengths = []
    for seed in range(400):
        stairs.reset(seed=seed)
        lengths.append(stairs.step(0)[4]["steps"])
    np.testing.assert_allclose(np.bincount(lengths, minlength=4) / 400, [0, 0.5, 0.25, 0.25], atol=0.1)


def test_what_is_wrong_is_said():
    with pytest.raises(InvalidConfig, match="nothing to choose"):
        OptionEnv(Stairs(), [], 0.9, primitives=False)
    with pytest.raises(InvalidConfig, match="discount"):
        OptionEnv(Stairs(), [UP], 1.5)
    with pytest.raises(InvalidConfig, match="at least one step"):
        HostOption("none", lambda seen, info: 2, lambda seen, info: 1.0, max_steps=0)
    stairs = OptionEnv(Stairs(), [TO_THREE], 0.9, primitives=False)
    stairs.reset(seed=0)
    with pytest.raises(gymnasium.error.InvalidAction):
        stairs.step(1)
    with pytest.raises(NoOptionAvailable):
        stairs.step(0)
    odd = OptionEnv(Stairs(), [HostOption("odd", lambda seen, info: 2, lambda seen, info: 2.0)], 0.9)
    odd.reset(seed=0)
    with pytest.raises(InvalidConfig, match=r"termination of odd is 2\.0"):
        odd.step(2)
