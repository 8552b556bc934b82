"""Training speed, side by side in one run.

Lodestone's DQN against Stable-Baselines3's on the same environment, with the same network, batch size and one update a
step; seeds together; options against flat; the share of the machine's own matrix-product rate.

    python benchmarks/training.py [--json]
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from lodestone.agents.dqn import DQNConfig, dqn
from lodestone.devices import use_all_cores
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.learning.loop import train
from lodestone.options.base import Capped, Options, Primitives, Union
from lodestone.options.catalogue import scripted_options
from lodestone.options.execution import Rules

ARM = MagnetArm()
SINGLE = DQNConfig(
    double=False, learning_starts=100, environments=1, decisions_per_round=1, updates_per_round=1, epsilon=((0.0, 0.3),)
)
"""The paper's network, one environment, one update a decision."""
BATCHED = replace(SINGLE, environments=8, decisions_per_round=8, updates_per_round=8)


def updates_per_second(config: DQNConfig, options: Options, seeds: int, updates: int) -> float:
    """Of all seeds together, compilation excluded: the best of three chunks."""
    chunk = max(1, updates // config.updates_per_round)
    algorithm = dqn(config, ARM, options, Rules(decision_limit=200), 5 * updates)
    best, before = 0.0, None
    for _, progress in train(algorithm, range(seeds), 5 * chunk, chunk):
        if before is not None and progress.rounds > 2 * chunk:
            best = max(best, seeds * chunk * config.updates_per_round / (progress.seconds - before))
        before = progress.seconds
    return best


def stable_baselines_updates_per_second(updates: int) -> float:
    """Steps of DQN.learn with one update a step, after a warm-up."""
    import gymnasium
    import torch
    from stable_baselines3 import DQN
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

    class PaperNetwork(BaseFeaturesExtractor):
        """The same convolutions with TensorFlow's SAME padding."""

        def __init__(self, space: gymnasium.Space) -> None:
            super().__init__(space, 256)
            layers: list[torch.nn.Module] = []
            channels, height, width = space.shape
            for kernel, stride, outputs in ((8, 4, 32), (4, 2, 64), (3, 1, 64)):
                pads = []
                for length in (width, height):
                    total = max((-(-length // stride) - 1) * stride + kernel - length, 0)
                    pads += [total // 2, total - total // 2]
                layers += [torch.nn.ZeroPad2d(tuple(pads)), torch.nn.Conv2d(channels, outputs, kernel, stride)]
                layers.append(torch.nn.ReLU())
                channels, height, width = outputs, -(-height // stride), -(-width // stride)
            layers += [torch.nn.Flatten(), torch.nn.Linear(channels * height * width, 256), torch.nn.ReLU()]
            self.layers = torch.nn.Sequential(*layers)

        def forward(self, pictures: torch.Tensor) -> torch.Tensor:
            return self.layers(pictures)

    from numpy_magnet_arm import NumpyMagnetArm  # beside this file

    environment = NumpyMagnetArm(step_limit=200)
    model = DQN(
        "CnnPolicy",
        environment,
        buffer_size=50_000,
        learning_starts=100,
        batch_size=32,
        train_freq=1,
        gradient_steps=1,
        target_update_interval=200,
        policy_kwargs={"features_extractor_class": PaperNetwork, "net_arch": []},
    )
    model.learn(500)
    started = time.perf_counter()
    model.learn(updates, reset_num_timesteps=False)
    return updates / (time.perf_counter() - started)


def matrix_product_rate() -> float:
    """FLOP/s of a large float32 product on all devices."""
    size, devices = 1024, jax.device_count()
    blocks = jnp.ones((devices, size, size))
    product = jax.pmap(lambda block: jax.lax.fori_loop(0, 10, lambda _, x: (x @ block) / size, block))
    product(blocks).block_until_ready()
    started = time.perf_counter()
    product(blocks).block_until_ready()
    return devices * 10 * 2 * size**3 / (time.perf_counter() - started)


def flops_per_update() -> float:
    """Of the paper's network at 4x3 on a batch of 32: one forward pass of the target, one forward and twice that back
    of the network, counting only kernel elements that meet the picture."""
    products = 0
    height, width, channels = 12, 9, 3
    for kernel, stride, outputs in ((8, 4, 32), (4, 2, 64), (3, 1, 64)):
        met = 1
        for length in (height, width):
            count = -(-length // stride)
            before = max((count - 1) * stride + kernel - length, 0) // 2
            starts = [position * stride - before for position in range(count)]
            met *= sum(min(kernel, length - start) - max(0, -start) for start in starts)
        products += met * channels * outputs
        height, width, channels = -(-height // stride), -(-width // stride), outputs
    products += height * width * channels * 256 + 256 * 6
    return 4 * 32 * 2 * products


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--updates", type=int, default=2000, help="updates per measurement")
    arguments = parser.parse_args()
    use_all_cores()
    primitives = Primitives(ARM.action_names)
    with_options = Union((primitives, Capped(scripted_options(ARM, ("go-down", "lift")), 21)))
    one = updates_per_second(SINGLE, primitives, 1, arguments.updates)
    eight = updates_per_second(BATCHED, primitives, 8, arguments.updates // 4)
    optioned = updates_per_second(BATCHED, with_options, 8, arguments.updates // 4)
    rate = matrix_product_rate()
    found = {
        "updates/s, one seed": one,
        "updates/s, eight seeds together": eight,
        "updates/s, eight seeds together, with options": optioned,
        "options / flat": optioned / eight,
        "GFLOP/s of a large matrix product": rate / 1e9,
        "share of that rate, eight seeds": eight * flops_per_update() / rate,
    }
    try:
        peer = stable_baselines_updates_per_second(min(arguments.updates, 2000))
    except ImportError:
        print("Stable-Baselines3 is not installed (pip install -e '.[benchmarks]'); its rows are left out.")
    else:
        found |= {
            "updates/s, Stable-Baselines3": peer,
            "one seed / Stable-Baselines3": one / peer,
            "eight seeds together / Stable-Baselines3": eight / peer,
        }
    if arguments.json:
        print(json.dumps(found, indent=2))
    else:
        for name, value in found.items():
            print(f"{name:48s} {np.format_float_positional(value, precision=3, fractional=False):>10s}")


if __name__ == "__main__":
    main()
