"""Runs as TensorBoard's events: what is read back is what the metrics say, once."""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path
from typing import Any

import pytest

from lodestone.agents.q_learning import QLearningConfig
from lodestone.agents.run import Run, save_run
from lodestone.cli import main
from lodestone.envs.chain import Chain
from lodestone.errors import BadFile
from lodestone.options.base import Primitives
from lodestone.options.execution import Rules

CHAIN = Chain()


@pytest.fixture
def run(tmp_path) -> Path:
    """An unfinished run of two seeds."""
    folder = tmp_path / "run"
    folder.mkdir()
    save_run(folder, Run(QLearningConfig(), CHAIN, Rules(0.9), Primitives(CHAIN.action_names), 1000, (3, 5)))
    return folder


def line(seed: int, chunk: int, mean_return: float | None) -> str:
    """Of metrics."""
    told: dict[str, Any] = {"seed": seed, "steps": 100 * chunk, "decisions": 90 * chunk, "episodes": chunk - 1}
    told |= {"mean_return": mean_return, "loss": 0.5 / chunk, "seconds": 2.0 * chunk}
    return json.dumps(told | {"calls": {"left": seed, "right": 100 - seed}}) + "\n"


def log(folder: Path, returns: list[float | None]) -> None:
    """Metrics whose seeds had these mean returns, chunk after chunk, and a line of which half has been written."""
    lines = [line(seed, 1 + at, value) for at, value in enumerate(returns) for seed in (3, 5)]
    (folder / "metrics.jsonl").write_text("".join(lines) + line(3, 99, 0.0)[:30])


def read(folder: Path, seed: int) -> list[tuple[int, float, dict[str, float]]]:
    """Step, wall time and numbers of each event: a length, four bytes about it, the event, four bytes about that."""
    from tensorboardX.proto.event_pb2 import Event

    (file,) = (folder / "tensorboard" / f"seed-{seed}").iterdir()
    content, found = file.read_bytes(), []
    while content:
        (length,) = struct.unpack_from("<Q", content)
        event = Event.FromString(content[12 : 12 + length])
        found.append((event.step, event.wall_time, {one.tag: one.simple_value for one in event.summary.value}))
        content = content[16 + length :]
    return found


def test_events_are_the_metrics_also_after_a_resumed_run(run, capsys):
    pytest.importorskip("tensorboardX")
    began = (run / "config.json").stat().st_mtime
    # A run of three chunks is killed, goes on from the first, and takes another way.
    for returns in ([None, 0.25, 0.5], [None, 0.125], [None, 0.125, 0.75, 1.0]):
        log(run, returns)
        assert main(["tensorboard", str(run)]) == 0
        for seed in (3, 5):
            version, *events = read(run, seed)
            assert version == (0, began, {})
            assert [step for step, *_ in events] == [100 * (1 + at) for at in range(len(returns))]
            assert [time - began for _, time, _ in events] == pytest.approx(
                [2.0 * (1 + at) for at in range(len(returns))]
            )
            assert [numbers.get("mean_return") for *_, numbers in events] == returns
            _, _, second = events[1]
            assert second == {
                "mean_return": returns[1],
                "loss": 0.25,
                "episodes": 1,
                "decisions": 180,
                "calls/left": seed,
                "calls/right": 100 - seed,
            }
    assert "tensorboard --logdir" in capsys.readouterr().out


def test_bad_metrics_are_refused_and_nothing_is_written(run):
    pytest.importorskip("tensorboardX")
    from lodestone.report.tensorboard import write_events

    for text in (line(3, 1, 0.5) + line(5, 1, 0.5).replace("0.5", '"0.5"'), "{}\n", line(4, 1, 0.5)):
        (run / "metrics.jsonl").write_text(text)
        with pytest.raises(BadFile, match="is damaged"):
            write_events(run)
    assert not (run / "tensorboard").exists()


def test_without_tensorboardx_a_sentence_says_what_to_install(run, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX.proto.event_pb2", None)
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    log(run, [0.5])
    assert main(["tensorboard", str(run)]) == 2
    told = capsys.readouterr().err
    assert told == "lodestone: Events for TensorBoard need tensorboardX: pip install 'lodestone[tensorboard]'.\n"
