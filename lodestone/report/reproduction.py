"""The folder that `lodestone reproduce` fills: written anew whenever a learner has finished, so that an interruption
loses nothing that is."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from time import perf_counter
from typing import Any

import jax

from lodestone import __version__
from lodestone.agents.saved import save_options, save_policy
from lodestone.experiments.comparison import Gate
from lodestone.experiments.magnet_tower import Trained, gates
from lodestone.files import write_json
from lodestone.report.animation import write_gif
from lodestone.report.curves import draw_learning_curves
from lodestone.report.html import write_report
from lodestone.report.results import results_json


def provenance(command: str) -> dict[str, object]:
    """Settings that say where results come from: the command, the machine and the versions of what ran."""
    return {
        "command": command,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {jax.default_backend()}",
        "versions": f"lodestone {__version__}, jax {jax.__version__}, python {platform.python_version()}",
    }


class Reproduction:
    """What has finished so far, and its files."""

    def __init__(self, folder: Path, preset: str, seeds: int, figure: str) -> None:
        self._folder = folder
        self._preset = preset
        self._started = perf_counter()
        self._trained: dict[str, Trained] = {}
        self._settings = {
            **provenance(f"lodestone reproduce --figure {figure} --preset {preset} --seeds {seeds} --out {folder}"),
            "preset": preset,
            "seeds": seeds,
        }
        self.files: list[str] = []

    @property
    def finished(self) -> list[str]:
        """The learners that have finished."""
        return [f"{name} {agent.name}" for name, one in self._trained.items() for agent in one.comparison.agents]

    def gates(self) -> list[Gate]:
        """The numbers that must come out, as far as they are in."""
        return gates(list(self._trained.values()), self._preset)

    def results(self) -> dict[str, Any]:
        """The content of results.json."""
        comparisons = [one.comparison for one in self._trained.values()]
        return results_json(comparisons, self.gates(), self._timed_settings())

    def save(self, trained: Trained) -> None:
        """Write every file that this figure changes. Raises `CannotWrite`."""
        comparison = trained.comparison
        self._trained[comparison.name] = trained
        assert comparison.playback is not None  # a learner has finished
        draw_learning_curves(comparison, self._path(f"{comparison.name}.png"))
        write_gif(comparison.playback, self._path(f"{comparison.name}.gif"))
        environment = next(iter(trained.policies.values())).environment
        save_options(self._path(f"{comparison.name}-options.safetensors"), trained.options, environment)
        for name, policy in trained.policies.items():
            save_policy(self._path(f"{comparison.name}-{name.lower().replace(' ', '-')}.safetensors"), policy)
        write_json(self._path("results.json"), self.results())
        comparisons = [one.comparison for one in self._trained.values()]
        write_report(comparisons, self.gates(), self._timed_settings(), self._path("report.html"))

    def _timed_settings(self) -> dict[str, object]:
        return self._settings | {"seconds": perf_counter() - self._started}

    def _path(self, name: str) -> Path:
        if name not in self.files:
            self.files.append(name)
        return self._folder / name
