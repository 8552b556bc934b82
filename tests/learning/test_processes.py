"""Two processes that share the seeds learn what one learns."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lodestone.agents.training import train_policy
from lodestone.api import Primitives, QLearningConfig, Rules, TwoRooms

SEEDS, STEPS = 5, 1000

PROGRAM = """
import sys
import jax
import numpy as np
from test_processes import train

address, process, out = sys.argv[1:]
jax.config.update("jax_num_cpu_devices", 2)
jax.distributed.initialize(address, num_processes=2, process_id=int(process))
assert (jax.process_count(), jax.device_count()) == (2, 4)
np.savez(out, *train())
"""


def train() -> tuple[np.ndarray, ...]:
    """What every seed has learned, and how its episodes ended."""
    environment = TwoRooms()
    options = Primitives(environment.action_names)
    policy, history = train_policy(QLearningConfig(), environment, options, Rules(step_limit=50), STEPS, range(SEEDS))
    return np.asarray(policy.learned), *(history.episodes(position).total_reward for position in range(SEEDS))


@pytest.mark.slow
def test_two_processes_learn_what_one_learns(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    started = [
        subprocess.Popen(
            [sys.executable, "-c", PROGRAM, address, str(process), str(tmp_path / f"{process}.npz")],
            cwd=Path(__file__).parent,
        )
        for process in range(2)
    ]
    assert [process.wait() for process in started] == [0, 0]
    alone = train()
    assert len(alone[0]) == SEEDS
    for process in range(2):
        with np.load(tmp_path / f"{process}.npz") as together:
            for one, two in zip(alone, together.values(), strict=True):
                np.testing.assert_array_equal(one, two)
