"""`lodestone doctor`: what is installed here, what is missing, and how to get it."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import jax
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from lodestone import __version__
from lodestone.cli.parsing import parse
from lodestone.cli.printing import print_json

NEEDED = ("jax", "jaxlib", "equinox", "optax", "numpy", "scipy", "gymnasium", "safetensors", "matplotlib", "pillow")
EXTRAS = {
    "jax-cuda13-plugin": ("training on an NVIDIA GPU", "lodestone[cuda]"),
    "ray": ("`lodestone sweep`, on this machine or many", "lodestone[cluster]"),
    "pygame": ("pictures of Gymnasium's own environments", "pygame"),
    "minigrid": ("MiniGrid environments, as minigrid:ID", "minigrid"),
    "ale-py": ("Atari games, as lodestone.envs.atari:Atari/NAME-v5", "lodestone[atari]"),
    "stable-baselines3": ("benchmarks beside Stable-Baselines3, and its learners over options", "lodestone[bridges]"),
    "tensorboardX": ("runs for TensorBoard", "lodestone[tensorboard]"),
    "pytest": ("running the tests", "lodestone[dev]"),
}
"""Packages that not everyone needs: what for, and what to install."""


@dataclass(frozen=True)
class Doctor:
    """Say what is installed on this machine, what is missing, and how to get it."""

    json: bool = False
    """Print one JSON object."""


def run(words: list[str]) -> None:
    """Parse the words after `doctor` and look."""
    settings = parse(Doctor, "doctor", words)
    found = _look()
    if settings.json:
        print_json(found)
        return
    table = Table(title=f"Lodestone {found['lodestone']}, Python {found['python']}", title_justify="left")
    table.add_column("what")
    table.add_column("here")
    table.add_column("")
    table.add_row("devices", ", ".join(found["devices"]), f"{found['processors']} processors")
    for name, number in found["packages"].items():
        table.add_row(name, number or "missing", "" if number else f"pip install {name}")
    for name, extra in found["extras"].items():
        hint = "" if extra["version"] else f"; pip install '{extra['install']}'"
        table.add_row(name, extra["version"] or "-", escape(f"{extra['for']}{hint}"))
    Console().print(table)


def _look() -> dict[str, Any]:
    return {
        "lodestone": __version__,
        "python": platform.python_version(),
        "system": platform.platform(),
        "processors": os.cpu_count(),
        "devices": [f"{device.platform} {device.id} ({device.device_kind})" for device in jax.devices()],
        "packages": {name: _version(name) for name in NEEDED},
        "extras": {
            name: {"version": _version(name), "for": purpose, "install": what}
            for name, (purpose, what) in EXTRAS.items()
        },
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
