"""DQN in environments that live in Python, side by side in one run.

Lodestone's DQN against Stable-Baselines3's on CartPole and on the NumPy magnet arm, each by its Gymnasium id: the same
layers, batch size, copies of the environment and one update a step, measured in turn.

    python benchmarks/hosts.py [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import gymnasium

sys.path.insert(0, str(Path(__file__).parents[1]))  # for a checkout that is not installed

from numpy_magnet_arm import NumpyMagnetArm  # beside this file

from lodestone.agents.dqn import DQNConfig, dqn
from lodestone.devices import use_all_cores
from lodestone.envs.host import Registered, visit
from lodestone.learning.loop import train
from lodestone.learning.networks import NetworkConfig
from lodestone.options.base import primitives
from lodestone.options.execution import Rules

ARM = "NumpyMagnetArm-v0"
HIDDEN = {"CartPole-v1": (64, 64), ARM: (128,)}
"""Layers for each environment."""
BATCH, STARTS, RATE = 32, 100, 1e-3


def register_arm() -> None:
    """Make Gymnasium know the arm."""
    gymnasium.register(ARM, entry_point=NumpyMagnetArm)


def lodestone_updates_per_second(name: str, copies: int, updates: int) -> float:
    """Compilation excluded."""
    config = DQNConfig(
        network=NetworkConfig((), (), (), HIDDEN[name]),
        double=False,
        learning_rate=((0.0, RATE),),
        batch_size=BATCH,
        replay_capacity=50_000,
        learning_starts=STARTS,
        epsilon=((0.0, 0.3),),
        environments=copies,
        decisions_per_round=copies,
        updates_per_round=copies,
    )
    environment, chunk = Registered(name), updates // copies
    with visit(environment):
        algorithm = dqn(config, environment, primitives(environment), Rules(), 2 * updates)
        first, second = (progress.seconds for _, progress in train(algorithm, [0], 2 * chunk, chunk))
    return chunk * copies / (second - first)


def stable_baselines_updates_per_second(name: str, copies: int, updates: int) -> float:
    """Steps of DQN.learn, after a warm-up."""
    from stable_baselines3 import DQN
    from stable_baselines3.common.env_util import make_vec_env

    model = DQN(
        "MlpPolicy",
        make_vec_env(name, copies),
        learning_rate=RATE,
        buffer_size=50_000,
        learning_starts=STARTS,
        batch_size=BATCH,
        train_freq=1,
        gradient_steps=copies,
        target_update_interval=200,
        exploration_initial_eps=0.3,
        exploration_final_eps=0.3,
        policy_kwargs={"net_arch": list(HIDDEN[name])},
        device="cpu",
    )
    model.learn(500)
    started = time.perf_counter()
    model.learn(updates, reset_num_timesteps=False)
    return updates / (time.perf_counter() - started)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--updates", type=int, default=2000, help="updates per measurement, of which the best of three")
    arguments = parser.parse_args()
    use_all_cores()
    register_arm()
    found = {}
    for name in HIDDEN:
        for copies in (1, 8):
            ours = peer = 0.0
            for _ in range(3):  # in turn, so that what else the machine does slows both
                ours = max(ours, lodestone_updates_per_second(name, copies, arguments.updates))
                peer = max(peer, stable_baselines_updates_per_second(name, copies, arguments.updates))
            row = f"{name}, {copies} {'copy' if copies == 1 else 'copies'}"
            found[row] = {"updates/s": ours, "updates/s, Stable-Baselines3": peer, "ratio": ours / peer}
            if not arguments.json:
                print(
                    f"{row:30s} {ours:8.0f} updates/s, Stable-Baselines3 {peer:8.0f}, ratio {ours / peer:.2f}",
                    flush=True,
                )
    if arguments.json:
        print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
