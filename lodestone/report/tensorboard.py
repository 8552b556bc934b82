"""Training runs for TensorBoard: the lines of metrics.jsonl once more, as its events.

They are made from what a run's folder says now, all anew each time. A writer beside the training would be left with
points that come twice: after a kill, `resume` goes back to a checkpoint and takes those steps again.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lodestone.agents.run import CONFIG, read_run
from lodestone.agents.run_folder import METRICS
from lodestone.errors import InvalidConfig
from lodestone.files import write_atomically
from lodestone.report.runs import damaged, read_rows

EVENTS = "events.out.tfevents.0.lodestone"
"""The name of a file of events, in which TensorBoard looks for "tfevents"."""

NUMBERS = ("mean_return", "mean_steps", "mean_decisions", "success_rate", "loss", "episodes", "decisions")
"""What is drawn over primitive steps, beside the calls and steps of each choice."""


def write_events(folder: Path) -> Path:
    """Write the events of a run's seeds, finished or not, into a folder inside the run's; returns that.

    Raises `BadFile`, `CannotWrite`, and `InvalidConfig` without tensorboardX.
    """
    try:
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.record_writer import RecordWriter
    except ImportError:
        raise InvalidConfig("Events for TensorBoard need tensorboardX: pip install 'lodestone[tensorboard]'.") from None
    seeds = read_run(folder).seeds
    began = (folder / CONFIG).stat().st_mtime
    path = folder / METRICS
    files: dict[Path, bytes] = {}
    for seed, rows in zip(seeds, read_rows(path, seeds), strict=True):
        try:
            events = [Event(wall_time=began + row["seconds"], step=row["steps"], summary=_summary(row)) for row in rows]
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
            raise damaged(path) from None
        with tempfile.TemporaryDirectory() as place:
            written = Path(place) / EVENTS
            records = RecordWriter(str(written))
            for event in (Event(wall_time=began, file_version="brain.Event:2"), *events):
                records.write(event.SerializeToString())
            records.close()
            files[folder / "tensorboard" / f"seed-{seed}" / EVENTS] = written.read_bytes()
    for target, content in files.items():
        write_atomically(target, content)
    return folder / "tensorboard"


def _summary(row: Mapping[str, Any]) -> Any:
    """The numbers of a line; what is not known yet is left out."""
    from tensorboardX.proto.summary_pb2 import Summary

    told = {name: row.get(name) for name in NUMBERS}
    for name in ("calls", "steps_of_calls"):
        told |= {f"{name}/{choice}": number for choice, number in row.get(name, {}).items()}
    values = [Summary.Value(tag=tag, simple_value=number) for tag, number in told.items() if number is not None]
    return Summary(value=values)
