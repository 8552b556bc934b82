"""`lodestone tensorboard RUN...`: training runs for TensorBoard."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from lodestone.cli.parsing import parse
from lodestone.cli.printing import print_json
from lodestone.errors import InvalidConfig


@dataclass(frozen=True)
class TensorBoard:
    """Write the metrics of training runs, finished or not, as events for TensorBoard; once more is always right, as it
    replaces what it has written before."""

    runs: Positional[tuple[Path, ...]]
    """Folders of `lodestone train --out`; the events go into a folder tensorboard in each."""
    json: bool = False
    """Print one JSON object."""


def run(words: list[str]) -> None:
    """Parse the words after `tensorboard` and write."""
    _write(parse(TensorBoard, "tensorboard", words))


def _write(settings: TensorBoard) -> None:
    from lodestone.report.tensorboard import write_events  # pictures, which it is beside, are only needed here

    if not settings.runs:
        raise InvalidConfig("`lodestone tensorboard` needs the folder of at least one run.")
    written = [write_events(folder) for folder in settings.runs]
    if settings.json:
        print_json({"written": written})
        return
    for folder in written:
        print(f"Wrote {folder}; `tensorboard --logdir {folder}` shows it.")
