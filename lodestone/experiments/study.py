"""What an experiment has to show when it is not a comparison of towers: curves over seeds, tables, numbers to reach.

One shape for all of them, so that figures, the report and `results.json` are written once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lodestone.agents.playing import Playback
from lodestone.experiments.comparison import Gate
from lodestone.learning.progress import Progress
from lodestone.planning.joint import JointProcess


@dataclass(frozen=True)
class Series:
    """One learner's curve."""

    name: str
    x: Float[np.ndarray, " X"]
    seeds: Float[np.ndarray, "S X"]
    """One row per seed; not a number where a seed has no value."""


@dataclass(frozen=True)
class Panel:
    """One diagram: the interquartile mean over seeds of each series, with its 95 % interval."""

    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    references: tuple[tuple[str, float], ...] = ()
    """Exact values drawn as horizontal lines: (name, height)."""
    log_x: bool = False
    y_range: tuple[float, float] | None = None
    """Lowest and highest value shown; early learners can be far below what matters."""


@dataclass(frozen=True)
class NumberTable:
    """Exact or measured numbers."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str | float, ...], ...]


@dataclass(frozen=True)
class LearnedMachines:
    """Machines with what a learned policy does in them."""

    title: str
    process: JointProcess
    visits: Float[np.ndarray, "N U"]
    """How often an episode takes each edge of each choice, expected."""


@dataclass(frozen=True)
class Study:
    """What one experiment has found."""

    name: str
    """As in `lodestone reproduce --experiment NAME`."""
    title: str
    summary: str
    """What is compared and what is to be seen, in a few sentences."""
    seeds: int
    panels: tuple[Panel, ...]
    tables: tuple[NumberTable, ...]
    gates: tuple[Gate, ...]
    machines: tuple[LearnedMachines, ...] = ()
    playbacks: tuple[Playback, ...] = ()
    """Episodes to click through."""


@dataclass(frozen=True)
class Experiment:
    """An experiment that can be run by name."""

    name: str
    title: str
    seeds: int
    """How many by default."""
    work: float
    """What `run` reports as progress in all, the same for any number of seeds; any unit."""
    run: Callable[[int, Progress], Study]
    """run(seeds, progress) -> what was found."""
