"""Other libraries learn over options: `OptionEnv` under Stable-Baselines3's DQN, against the exact values."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from lodestone.envs.option_env import HostOption, OptionEnv

pytest.importorskip("stable_baselines3", reason="needs `pip install 'lodestone[bridges]'`")

import torch
from stable_baselines3 import DQN
from stable_baselines3.common.buffers import ReplayBuffer

pytestmark = pytest.mark.filterwarnings("default")  # theirs

CELLS, MIDDLE, DISCOUNT = 9, 4, 0.9


class Corridor(gymnasium.Env):
    """Left and right; the last cell pays 1 and is the end. Begins anywhere else."""

    observation_space = spaces.Discrete(CELLS)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self.cell, self.time = int(self.np_random.integers(CELLS - 1)), 0
        return self.cell, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        self.cell, self.time = max(self.cell + (1 if action else -1), 0), self.time + 1
        end = self.cell == CELLS - 1
        return self.cell, float(end), end, self.time >= 12, {}


TO_MIDDLE = HostOption("to the middle", lambda seen, info: int(seen <= MIDDLE), lambda seen, info: seen == MIDDLE)


def exact() -> np.ndarray:
    """Q of left, right and the option, in every cell but the last."""
    values = DISCOUNT ** np.arange(CELLS - 2, -1, -1.0)
    cells = np.arange(CELLS - 1)
    right = np.append(DISCOUNT * values[1:], 1.0)
    left = DISCOUNT * values[np.maximum(cells - 1, 0)]
    steps = np.where(cells == MIDDLE, 2, abs(cells - MIDDLE))  # from the middle there and back
    return np.stack([left, right, DISCOUNT**steps * values[MIDDLE]], axis=1)


class OptionBuffer(ReplayBuffer):
    """Keeps the discount of every option beside its transition, as `info` tells it."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.factors = np.zeros((self.buffer_size, self.n_envs), np.float32)

    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: list[dict[str, Any]]) -> None:
        self.factors[self.pos] = [info["discount"] for info in infos]
        super().add(obs, next_obs, action, reward, done, infos)

    def _get_samples(self, batch_inds: np.ndarray, env: Any = None) -> NamedTuple:
        sampled = super()._get_samples(batch_inds, env)
        return sampled._replace(discounts=self.to_torch(self.factors[batch_inds, 0]).reshape(-1, 1))


def test_dqn_learns_the_values_of_options():
    """Of a table: a network without hidden layers on cells that are one of n."""
    torch.set_num_threads(1)
    corridor = OptionEnv(Corridor(), [TO_MIDDLE], DISCOUNT)
    model = DQN(
        "MlpPolicy",
        corridor,
        learning_rate=lambda left: 0.03 * left,
        buffer_size=3000,
        learning_starts=300,
        batch_size=64,
        gamma=0.1,  # what is not used, as every option has its own
        train_freq=2,
        target_update_interval=50,
        exploration_initial_eps=1.0,
        exploration_final_eps=1.0,
        policy_kwargs={"net_arch": []},
        replay_buffer_class=OptionBuffer,
        seed=0,
        device="cpu",
    )
    model.learn(6000)
    cells, _ = model.policy.obs_to_tensor(np.arange(CELLS - 1))
    np.testing.assert_allclose(model.q_net(cells).detach().numpy(), exact(), atol=0.05)
