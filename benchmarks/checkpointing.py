"""What checkpoints cost: the share of a run's time that one a minute takes, with a replay of a million transitions.

A run of DQN over options goes on in pieces, every other one with a checkpoint at its beginning that is written while
the piece is trained; a piece ends when both are done. The difference of the medians is what a checkpoint costs.

    python benchmarks/checkpointing.py [--json]
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import median

import jax
import numpy as np

from lodestone.agents.dqn import DQNConfig, dqn
from lodestone.devices import use_all_cores
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.learning.checkpoints import Checkpoints
from lodestone.learning.history import History
from lodestone.learning.loop import train
from lodestone.learning.networks import NetworkConfig
from lodestone.options.base import Capped, Primitives, Union
from lodestone.options.catalogue import scripted_options
from lodestone.options.execution import Rules

ARM = MagnetArm(rows=6, columns=4, bricks=4, tower_height=4)
OPTIONS = Union((Primitives(ARM.action_names), Capped(scripted_options(ARM, ("go-down", "lift")), 21)))
CONFIG = DQNConfig(NetworkConfig((3,), (3,), (16,), (128,)), reward_scale=0.2, learning_starts=1000)
REPLAY = 1_000_000
MINUTE = 60.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--seeds", type=int, default=2, help="seeds trained at once, each with a replay of its own")
    parser.add_argument("--pieces", type=int, default=10, help="pieces of each kind")
    parser.add_argument("--rounds", type=int, default=400, help="rounds of 8 updates in a piece")
    arguments = parser.parse_args()
    use_all_cores()
    algorithm = dqn(replace(CONFIG, replay_capacity=REPLAY), ARM, OPTIONS, Rules(decision_limit=200), 2 * REPLAY)
    history = History(arguments.seeds, OPTIONS.names)
    with tempfile.TemporaryDirectory() as folder, Checkpoints(Path(folder), "benchmark", every=0.0) as checkpoints:
        pieces: dict[bool, list[float]] = {False: [], True: []}
        copies: list[float] = []
        chunks = train(
            algorithm, range(arguments.seeds), (2 + 2 * arguments.pieces) * arguments.rounds, arguments.rounds
        )
        for number, (carry, chunk) in enumerate(chunks):
            history.add(chunk)
            checkpoints.wait()
            now = time.perf_counter()
            if number > 1:
                pieces[number % 2 == 0].append(now - before)
            before = now
            if number % 2:
                checkpoints.after_chunk(carry, history, chunk.rounds)
                copies.append(time.perf_counter() - before)
        written = max(path.stat().st_size for path in Path(folder).iterdir())
    cost = median(pieces[True]) - median(pieces[False])
    found = {
        "MB of a checkpoint": written / 1e6,
        "s of a piece without a checkpoint": median(pieces[False]),
        "s of a piece with one": median(pieces[True]),
        "s that training waits for the copy": median(copies),
        "% of a run's time, one a minute": 100 * cost / MINUTE,
    }
    if arguments.json:
        print(json.dumps(found, indent=2))
    else:
        print(f"{jax.device_count()} devices, {arguments.seeds} seeds, replays of {REPLAY:,} transitions")
        for name, value in found.items():
            print(f"{name:40s} {np.format_float_positional(value, precision=3, fractional=False):>10s}")


if __name__ == "__main__":
    main()
