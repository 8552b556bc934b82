"""Curves of training that several experiments show."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from lodestone.experiments.study import Panel, Series
from lodestone.learning.history import History, running_mean

WINDOW = 50
"""Episodes whose mean return is shown."""


def returns_in_training(
    title: str, histories: Mapping[str, History], steps: int, best: float, y_range: tuple[float, float]
) -> Panel:
    """Mean returns over the primitive steps of a run, of every learner's seeds, beside the optimum."""
    x = np.linspace(0, steps, 150)

    def rows(history: History) -> Float[np.ndarray, "N X"]:
        curves = []
        for seed in range(history.seeds):
            episodes = history.episodes(seed)
            means = np.insert(running_mean(episodes.total_reward, WINDOW), 0, np.nan)
            curves.append(means[np.searchsorted(episodes.steps, x, side="right")])
        return np.stack(curves)

    return Panel(
        title,
        "primitive steps",
        f"return, mean of {WINDOW} episodes",
        tuple(Series(name, x, rows(history)) for name, history in histories.items()),
        references=((f"optimum {best:.4g}", best),),
        y_range=y_range,
    )
