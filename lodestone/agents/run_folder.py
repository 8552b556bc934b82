"""A training run's folder, in which the run survives whatever ends its process.

What is trained comes first (`agents/run.py`); metrics.jsonl and checkpoints/ grow with the run; policy.safetensors
ends it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Self, TextIO

import numpy as np

from lodestone.agents.policies import AnyPolicy
from lodestone.agents.run import CONFIG, OPTIONS, POLICY, START, Run, is_finished, read_run, save_run, unfinished
from lodestone.agents.saved import save_policy
from lodestone.errors import CannotWrite
from lodestone.files import lock, prepare_folder, write_atomically
from lodestone.learning.checkpoints import Checkpoints
from lodestone.learning.history import History

METRICS, CHECKPOINTS, LOCK = "metrics.jsonl", "checkpoints", ".lock"


class RunFolder:
    """Writes one run, while no other process does. A context manager."""

    def __init__(self, path: Path) -> None:
        """Raises `CannotWrite`, also while another process writes there."""
        self.path = prepare_folder(path)
        self._lock = lock(path / LOCK)
        self._metrics: TextIO | None = None
        self._logged = 0
        """Chunks that are in the metrics."""
        for name in (CONFIG, OPTIONS, START, METRICS, POLICY):
            for half_written in path.glob(f".{name}.*.tmp"):
                half_written.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        if self._metrics is not None:
            with suppress(OSError):  # of lines that could not be written, which was said
                self._metrics.close()
        self._lock.close()

    def begin(self, run: Run) -> None:
        """Write what is trained. Raises `CannotWrite`, also for a folder that holds a run already."""
        if (self.path / CONFIG).exists():
            if is_finished(self.path):
                raise CannotWrite(f"{self.path} holds a run already; choose another output folder or remove it.")
            raise CannotWrite(unfinished(self.path))
        save_run(self.path, run)

    def read(self) -> Run:
        """What is trained. Raises `BadFile`."""
        return read_run(self.path)

    def checkpoints(self, every: float, tell: Callable[[str], None]) -> Checkpoints:
        """Those of the run as it was begun."""
        files = (self.path / name for name in (CONFIG, OPTIONS, START))
        digest = hashlib.sha256(b"".join(file.read_bytes() for file in files if file.exists()))
        return Checkpoints(self.path / CHECKPOINTS, digest.hexdigest(), every, tell)

    def log(self, history: History, seeds: tuple[int, ...]) -> None:
        """One line per seed about each chunk that has none yet. Raises `CannotWrite`.

        The first time the file is written anew, from the history: what a process logged after its last checkpoint, and
        the line that it was killed in, are gone, and all before is there.
        """
        lines = [
            json.dumps(_metrics(history, chunk, position, seed)) + "\n"
            for chunk in range(self._logged, len(history.usage))
            for position, seed in enumerate(seeds)
        ]
        path = self.path / METRICS
        try:
            if self._metrics is None:
                write_atomically(path, "".join(lines).encode())
                self._metrics = path.open("a", encoding="utf-8")
            else:
                self._metrics.writelines(lines)
                self._metrics.flush()
        except OSError as error:
            raise CannotWrite(f"Cannot write {path}: {error.strerror or error}.") from None
        self._logged = len(history.usage)

    def finish(self, policy: AnyPolicy) -> None:
        """Save what was learned. Raises `CannotWrite`."""
        save_policy(self.path / POLICY, policy)


def _metrics(history: History, chunk: int, position: int, seed: int) -> dict[str, Any]:
    """About a chunk, and the last 50 episodes that were over by its end."""
    usage, episodes = history.usage[chunk], history.episodes(position)
    decisions = int(usage.decisions[position])
    over = int(np.searchsorted(episodes.decisions, decisions, side="right"))
    recent = slice(max(over - 50, 0), over)
    return {
        "seed": seed,
        "decisions": decisions,
        "steps": sum(int(each.steps[position].sum()) for each in history.usage[: chunk + 1]),
        "episodes": over,
        "mean_return": _mean(episodes.total_reward[recent]),
        "mean_steps": _mean(episodes.length_steps[recent]),
        "mean_decisions": _mean(episodes.length_decisions[recent]),
        "success_rate": _mean(episodes.success[recent]),
        "loss": float(usage.loss[position]),
        "calls": dict(zip(history.choices, usage.calls[position].tolist(), strict=True)),
        "steps_of_calls": dict(zip(history.choices, usage.steps[position].tolist(), strict=True)),
        "seconds": round(usage.seconds, 3),
    }


def _mean(values: Any) -> float | None:
    """The mean over the last episodes; nothing before the first has ended."""
    return float(values.mean()) if len(values) else None
