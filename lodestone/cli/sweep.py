"""`lodestone sweep PLAN`: train many configurations, each on many seeds, on many processors or machines."""

from __future__ import annotations

import os
import sys
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table
from tyro.conf import Positional

from lodestone.agents.run import CONFIG, is_finished
from lodestone.agents.run_folder import RunFolder
from lodestone.cli.parsing import parse
from lodestone.cli.printing import print_json
from lodestone.cli.train import parse_train, run_of, train_run
from lodestone.console import ConsoleProgress
from lodestone.errors import CannotWrite, InvalidConfig, LodestoneError
from lodestone.files import json_safe, lock, prepare_folder, read_json, write_json
from lodestone.sweep.plan import Plan, Trial, corners, label, read_plan, trials
from lodestone.sweep.results import (
    RESULT,
    Standing,
    all_rows,
    judge_trial,
    standings,
    write_csv,
    write_report,
)
from lodestone.sweep.running import require_answer, require_ray, run_all

FORMAT, SWEEP, LOCK = 1, "sweep.json", ".lock"

SHOWN = 12
"""So many configurations are shown on the terminal, the best ones."""


@dataclass(frozen=True)
class Sweep:
    """Train every configuration of a plan, a TOML file, on all its seeds: on this machine's processors, or on a Ray
    cluster. The same command goes on with a sweep that was ended early; what has finished is not trained again."""

    plan: Positional[Path]
    """The plan; docs/sweeps.md says what is in it."""
    out: Path
    """Folder for the sweep: its trials, results.csv, results.json, report.html. On a cluster all machines have to see
    it at this path."""
    address: str | None = None
    """Of a running Ray cluster, HOST:PORT, or auto, where this machine belongs to one. Default: this machine."""
    workers: int | None = None
    """Trials trained at a time on this machine. Default: one for each processor."""
    retries: int = 3
    """How many times a trial whose process dies is taken up again."""
    json: bool = False
    """Print one JSON object at the end."""

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise InvalidConfig(f"workers is {self.workers}, but must be at least 1.")
        if self.workers is not None and self.address is not None:
            raise InvalidConfig("workers is for this machine, but address names a cluster, which has its own.")
        if self.retries < 0:
            raise InvalidConfig(f"retries is {self.retries}, but must be 0 or more.")


class Piece(NamedTuple):
    """A trial, and where it is trained."""

    trial: Trial
    folder: Path
    here: Path
    """Where the paths in its words begin."""


def run(words: list[str]) -> None:
    """Parse the words after `sweep` and train."""
    _sweep(parse(Sweep, "sweep", words))


def _sweep(settings: Sweep) -> None:
    plan = read_plan(settings.plan)
    for trial in corners(plan):
        run_of(parse_train(list(trial.words)))
    require_ray()
    if settings.address not in (None, "auto"):
        require_answer(settings.address)
    folder, every = settings.out.absolute(), trials(plan)
    with lock(prepare_folder(folder) / LOCK):
        _begin(folder, plan, every)
        width = max(4, len(str(len(every))))
        here = Path.cwd()
        pieces = [
            Piece(trial, folder / "trials" / f"{number:0{width}}", here) for number, trial in enumerate(every, start=1)
        ]
        try:
            failed = _train_all(settings, pieces)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"interrupted; the same command goes on with the sweep in {folder}.") from None
        _finish(settings, folder, plan, pieces, failed)


def _begin(folder: Path, plan: Plan, every: list[Trial]) -> None:
    """Write what is to be trained, before anything is. Raises `CannotWrite` for a folder with another sweep."""
    content = json_safe({"format": FORMAT, "plan": asdict(plan), "trials": [trial.words for trial in every]})
    path = folder / SWEEP
    if not path.exists():
        write_json(path, content)
    elif read_json(path) != content:
        raise CannotWrite(f"{folder} holds a sweep of another plan; choose another output folder or remove it.")


def _train_all(settings: Sweep, pieces: list[Piece]) -> dict[Path, str]:
    """Train what is left; returns the sentences about the trials that failed, by their folders."""
    left = [piece for piece in pieces if not (piece.folder / RESULT).exists()]
    failed: dict[Path, str] = {}
    if not left:
        return failed
    # Ray tells of a process that died on standard output, where --json writes.
    with ConsoleProgress(len(pieces)) as progress, redirect_stdout(sys.stderr):
        progress.begin(f"sweep of {len(pieces)} trials", len(pieces))
        done = len(pieces) - len(left)
        progress.skip(done)
        for piece, sentence in run_all(train_trial, left, settings.address, settings.workers, settings.retries):
            if sentence is not None:
                failed[piece.folder] = sentence
            done += 1
            progress.advance(done, f"{done:,} of {len(pieces):,} over{f', {len(failed):,} failed' if failed else ''}")
    return dict(sorted(failed.items()))


def train_trial(piece: Piece) -> str | None:
    """Train a trial, or what is left of it, and judge it; returns why it failed. Runs in a process that may die."""
    os.chdir(piece.here)
    try:
        with RunFolder(piece.folder) as folder:
            if not (piece.folder / CONFIG).exists():
                folder.begin(run_of(parse_train(list(piece.trial.words))))
            if not is_finished(piece.folder):
                policy, _ = train_run(folder.read(), folder)
                folder.finish(policy)
            judge_trial(piece.folder)
    except LodestoneError as error:
        return str(error)
    except SystemExit:  # which said why on standard error, where nobody looks
        return f"`lodestone train {' '.join(piece.trial.words)}` is refused."
    return None


def _finish(settings: Sweep, folder: Path, plan: Plan, pieces: list[Piece], failed: dict[Path, str]) -> None:
    finished = {piece.folder: piece.trial for piece in pieces if piece.folder not in failed}
    ranked, rows = standings(finished), all_rows(finished)
    content: dict[str, Any] = {
        "plan": asdict(plan),
        "trials": len(pieces),
        "failed": {path.name: sentence for path, sentence in failed.items()},
        "configurations": [{**each._asdict(), "configuration": dict(each.configuration)} for each in ranked],
        "rows": rows,
        "out": str(folder),
    }
    write_json(folder / "results.json", content)
    files = ["results.json"]
    if rows:
        write_csv(folder / "results.csv", rows)
        files += ["results.csv", *write_report(folder, plan, ranked)]
    if settings.json:
        print_json({**content, "files": files})
    else:
        _print(plan, ranked)
        for path, sentence in failed.items():
            print(f"Trial {path.name} failed: {sentence}")
        print(f"Wrote {', '.join(files)} in {folder}.")
    if failed:
        raise SystemExit(1)


def _print(plan: Plan, ranked: list[Standing]) -> None:
    some = f", the {SHOWN} best of {len(ranked)} configurations" if len(ranked) > SHOWN else ""
    table = Table(title=f"{plan.agent} on {plan.environment}{some}", title_justify="left")
    table.add_column("configuration")
    for column in ("seeds", "greedy return", "95 % interval", "median gap", "seconds"):
        table.add_column(column, justify="right")
    for each in ranked[:SHOWN]:
        table.add_row(
            label(each.configuration, plan.agent),
            str(each.seeds),
            f"{each.greedy_return:.4g}",
            f"{each.low:.4g} to {each.high:.4g}",
            "unknown" if each.gap is None else f"{each.gap:.4g}",
            f"{each.seconds:.0f}",
        )
    Console().print(table)
