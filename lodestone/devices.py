"""Using the machine: seeds are spread over JAX devices, and a CPU counts as one until it is asked to be several."""

from __future__ import annotations

import os

import jax


def use_all_cores() -> None:
    """Make every CPU core a device, so that seeds train side by side.

    Call it before JAX computes anything; later it has no effect.
    """
    try:
        jax.config.update(
            "jax_num_cpu_devices", len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
        )
    except RuntimeError:
        return
