"""What happened while training, on the host: every finished episode of every seed, and which options were used."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from lodestone.learning.loop import Chunk
from lodestone.learning.named_arrays import Arrays, take


class Episodes(NamedTuple):
    """All finished episodes of one seed, in order; arrays of length E."""

    decisions: Int[np.ndarray, " E"]
    """Decisions taken by the seed when the episode ended."""
    steps: Int[np.ndarray, " E"]
    """Primitive steps taken by then."""
    total_reward: Float[np.ndarray, " E"]
    length_steps: Int[np.ndarray, " E"]
    length_decisions: Int[np.ndarray, " E"]
    success: np.ndarray
    """Whether the environment ended the episode, rather than a limit."""


class Usage(NamedTuple):
    """What one chunk used, per seed and option."""

    decisions: Int[np.ndarray, " S"]
    """Decisions of each seed since the start of training, at the chunk's end."""
    calls: Int[np.ndarray, "S O"]
    steps: Int[np.ndarray, "S O"]
    """Primitive steps under each option."""
    loss: Float[np.ndarray, " S"]
    """Mean loss."""
    seconds: float


class History:
    """Grows chunk by chunk."""

    def __init__(self, seeds: int, choices: tuple[str, ...]) -> None:
        """`choices`: the names of what the learner chooses from, which the logs count."""
        self.choices = choices
        self.seeds = seeds
        self._episodes: list[list[np.ndarray]] = [[] for _ in range(seeds)]
        self._taken = np.zeros((seeds, 2), dtype=np.int64)  # decisions, steps
        self.usage: list[Usage] = []
        self.restored = 0
        """Chunks that another process brought."""

    def add(self, chunk: Chunk) -> None:
        """Append what a chunk brought."""
        log = jax.tree.map(np.asarray, chunk.log)
        seeds = log.valid.shape[0]
        calls = np.zeros((seeds, len(self.choices)), dtype=np.int64)
        steps = np.zeros((seeds, len(self.choices)), dtype=np.int64)
        for seed in range(seeds):
            decisions = jax.tree.map(lambda leaf, seed=seed: leaf[seed][log.valid[seed]], log._replace(loss=None))
            calls[seed] = np.bincount(decisions.option, minlength=len(self.choices))
            steps[seed] = np.bincount(decisions.option, weights=decisions.steps, minlength=len(self.choices))
            columns = (
                self._taken[seed, 0] + 1 + np.arange(len(decisions.option)),
                self._taken[seed, 1] + np.cumsum(decisions.steps),
                decisions.episode_return,
                decisions.episode_steps,
                decisions.episode_decisions,
                decisions.terminated,
            )
            ended = decisions.episode_ended
            self._episodes[seed].append(np.stack([column[ended].astype(np.float64) for column in columns]))
            self._taken[seed] += (len(decisions.option), int(decisions.steps.sum()))
        self.usage.append(
            Usage(self._taken[:, 0].copy(), calls, steps, np.asarray(log.loss).mean(axis=1), chunk.seconds)
        )

    def episodes(self, seed: int) -> Episodes:
        """The finished episodes of the seed with this position."""
        rows = self._rows(seed)
        whole = rows.astype(np.int64)
        return Episodes(whole[0], whole[1], rows[2], whole[3], whole[4], rows[5] > 0)

    def _rows(self, seed: int) -> Float[np.ndarray, "6 E"]:
        return np.concatenate(self._episodes[seed], axis=1) if self._episodes[seed] else np.zeros((6, 0))

    def arrays(self) -> Arrays:
        """Everything, by name."""
        episodes = {f"episodes/{seed}": self._rows(seed) for seed in range(self.seeds)}
        usage = {f"usage/{name}": np.stack([getattr(each, name) for each in self.usage]) for name in Usage._fields}
        return {"taken": self._taken.copy(), **episodes, **usage}

    def restore(self, arrays: Arrays) -> None:
        """Become what gave these arrays, after at least one chunk. Raises `BadFile`."""
        seeds, options, whole = self.seeds, len(self.choices), np.int64
        taken = take(arrays, "taken", (seeds, 2), whole)
        episodes = [take(arrays, f"episodes/{seed}", (6, None), np.float64) for seed in range(seeds)]
        seconds = take(arrays, "usage/seconds", (None,), np.float64)
        chunks = len(seconds)
        usage = zip(
            take(arrays, "usage/decisions", (chunks, seeds), whole),
            take(arrays, "usage/calls", (chunks, seeds, options), whole),
            take(arrays, "usage/steps", (chunks, seeds, options), whole),
            take(arrays, "usage/loss", (chunks, seeds), np.float32),
            seconds.tolist(),
            strict=True,
        )
        self._taken, self._episodes = taken, [[rows] for rows in episodes]
        self.usage, self.restored = [Usage(*row) for row in usage], chunks

    @property
    def seconds(self) -> float:
        """Wall-clock time of the run so far."""
        return self.usage[-1].seconds if self.usage else 0.0

    def taken(self, seed: int) -> tuple[int, int]:
        """(decisions, primitive steps) of one seed."""
        return int(self._taken[seed, 0]), int(self._taken[seed, 1])


def running_mean(values: Float[np.ndarray, " E"], window: int) -> Float[np.ndarray, " E"]:
    """Mean of the last `window` values; not a number before there are so many."""
    means = np.full(len(values), np.nan)
    if len(values) >= window:
        sums = np.cumsum(np.insert(values, 0, 0.0))
        means[window - 1 :] = (sums[window:] - sums[:-window]) / window
    return means


def first_above(episodes: Episodes, threshold: float, window: int = 50) -> int | None:
    """Position of the first episode at which the mean return of the last `window` episodes exceeds `threshold`."""
    above = running_mean(episodes.total_reward, window) > threshold
    return int(np.argmax(above)) if above.any() else None
