"""What a training run leaves behind: config.json, metrics.jsonl and policy.safetensors in one folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lodestone import __version__
from lodestone.agents.saved import AnyPolicy, load_policy, save_policy
from lodestone.errors import CannotWrite
from lodestone.files import prepare_folder, write_json
from lodestone.learning.history import History

CONFIG, METRICS, POLICY = "config.json", "metrics.jsonl", "policy.safetensors"


def load_run(path: Path) -> AnyPolicy:
    """The policy of a run's folder, or of a policy file. Raises `BadFile`."""
    return load_policy(path / POLICY if path.is_dir() else path)


class RunFolder:
    """Writes one run."""

    def __init__(self, path: Path, config: dict[str, Any]) -> None:
        """Raises `CannotWrite` for a folder that cannot be written or that holds a run already."""
        if (path / CONFIG).exists():
            raise CannotWrite(f"{path} holds a run already; choose another output folder or remove it.")
        self.path = prepare_folder(path)
        write_json(path / CONFIG, {"lodestone": __version__, **config})
        self._metrics = (path / METRICS).open("a", encoding="utf-8")

    def log(self, history: History, seeds: tuple[int, ...]) -> None:
        """One line per seed about the last chunk and the last 50 episodes."""
        usage = history.usage[-1]
        for position, seed in enumerate(seeds):
            episodes = history.episodes(position)
            decisions, steps = history.taken(position)
            recent = slice(-50, None)
            line = {
                "seed": seed,
                "decisions": decisions,
                "steps": steps,
                "episodes": len(episodes.total_reward),
                "mean_return": _mean(episodes.total_reward[recent]),
                "mean_steps": _mean(episodes.length_steps[recent]),
                "mean_decisions": _mean(episodes.length_decisions[recent]),
                "success_rate": _mean(episodes.success[recent]),
                "loss": float(usage.loss[position]),
                "calls": dict(zip(history.choices, usage.calls[position].tolist(), strict=True)),
                "seconds": round(usage.seconds, 3),
            }
            self._metrics.write(json.dumps(line) + "\n")
        self._metrics.flush()

    def finish(self, policy: AnyPolicy) -> None:
        """Save what was learned."""
        self._metrics.close()
        save_policy(self.path / POLICY, policy)


def _mean(values: Any) -> float | None:
    """The mean over the last episodes; nothing before the first has ended."""
    return float(values.mean()) if len(values) else None
