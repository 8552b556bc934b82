"""How fast the magnet arm runs, beside a plain NumPy Gymnasium version of it.

    python benchmarks/environment.py          # a table
    python benchmarks/environment.py --json   # the same, for a program

Random actions, environments that end begin anew, all rewards and ends computed. "Pictures" means that the uint8 picture
of every state is written to memory. Lodestone runs one batch on each processor core; NumPy runs one environment on one
core, and its row for all cores is that number times the cores: more than any worker processes could reach.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

sys.path.insert(0, str(Path(__file__).parents[1]))  # for a checkout that is not installed

from benchmarks.numpy_magnet_arm import NumpyMagnetArm
from lodestone.envs.base import sample_initial, sample_step
from lodestone.envs.gymnasium import GymnasiumVectorEnv
from lodestone.envs.magnet_arm import MagnetArm

SIZES = {"4x3": (4, 3, 3, 3), "6x4": (6, 4, 4, 4)}
BATCH = 1024
"""Copies on each core."""
STEPS = 500
"""Steps of every copy in one compiled call."""
REPEATS = 5
"""The best of so many runs counts: the others tell what else the machine was doing."""


def seconds(run: Callable[[], object]) -> float:
    """Of the fastest of `REPEATS` runs, after one that compiles."""
    run()
    taken = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        run()
        taken.append(time.perf_counter() - start)
    return min(taken)


def compiled_rate(arm: MagnetArm, pictures: bool, cores: int) -> float:
    """Steps a second of a compiled loop on `cores` cores."""

    def step(carry: tuple, _: None) -> tuple[tuple, None]:
        state, bits, _, paid = carry
        bits = bits * jnp.uint32(1664525) + jnp.uint32(1013904223)
        action = ((bits >> 8) % arm.num_actions).astype(jnp.int32)
        after = sample_step(arm, jax.random.key(0), state, action)
        start = sample_initial(arm, jax.random.key(0))
        state = jax.tree.map(partial(jnp.where, after.terminated), start, after.state)
        picture = arm.observe(state) if pictures else jnp.uint8(0)
        return (state, bits, picture, paid + after.reward), None

    def rollout(bits: jax.Array) -> tuple:
        start = sample_initial(arm, jax.random.key(0))
        picture = arm.observe(start) if pictures else jnp.uint8(0)
        carry = (start, bits, picture, jnp.float32(0))
        return jax.lax.scan(step, carry, None, length=STEPS)[0]

    mesh = Mesh(np.array(jax.devices()[:cores]), ("core",))
    rows = PartitionSpec("core")
    run = jax.jit(jax.shard_map(jax.vmap(rollout), mesh=mesh, in_specs=rows, out_specs=rows, check_vma=False))
    bits = jax.device_put(jax.random.bits(jax.random.key(1), cores * BATCH), NamedSharding(mesh, rows))
    return cores * BATCH * STEPS / seconds(lambda: jax.block_until_ready(run(bits)))


def gymnasium_rate(arm: MagnetArm) -> float:
    """Steps a second of `GymnasiumVectorEnv`, stepped from Python, on one device."""
    envs = GymnasiumVectorEnv(arm, BATCH, step_limit=200)
    envs.reset(seed=0)
    actions = np.random.default_rng(0).integers(6, size=(20, BATCH))
    return actions.size / seconds(lambda: [envs.step(action) for action in actions])


def numpy_rate(size: tuple[int, int, int, int], pictures: bool) -> float:
    """Steps a second of one NumPy environment."""
    env = NumpyMagnetArm(*size, pictures=pictures)
    actions = np.random.default_rng(0).integers(6, size=5_000).tolist()

    def run() -> None:
        env.reset()
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    return len(actions) / seconds(run)


def measure(cores: int) -> dict[str, dict[str, float]]:
    """All rates, in steps a second, and the ratios to NumPy on as many cores."""
    rates = {}
    for name, size in SIZES.items():
        for pictures in (False, True):
            arm = MagnetArm(*size)
            ours, theirs = compiled_rate(arm, pictures, cores), numpy_rate(size, pictures)
            row = {"lodestone": ours, "numpy": theirs * cores, "ratio": ours / (theirs * cores)}
            if pictures:
                row["gymnasium_vector"] = gymnasium_rate(arm)
            rates[f"{name}, {'with' if pictures else 'without'} pictures"] = row
    return rates


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cores", type=int, default=os.cpu_count(), help="processor cores to use (default: all)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args()
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_num_cpu_devices", options.cores)

    rates = measure(options.cores)
    if options.json:
        print(json.dumps({"cores": options.cores, "batch": BATCH, "steps_per_second": rates}, indent=2))
        return
    print(f"Million steps a second on {options.cores} cores, {BATCH} copies on each")
    print(f"{'':24}{'Lodestone':>12}{'NumPy':>10}{'ratio':>10}{'vector env, 1 device':>22}")
    for name, row in rates.items():
        through = f"{row['gymnasium_vector'] / 1e6:>24.2f}" if "gymnasium_vector" in row else ""
        print(f"{name:24}{row['lodestone'] / 1e6:>12.1f}{row['numpy'] / 1e6:>10.3f}{row['ratio']:>9.0f}x{through}")


if __name__ == "__main__":
    main()
