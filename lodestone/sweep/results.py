"""What the trials of a sweep came to: a row for each seed, configurations side by side, files and a page."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from lodestone.agents.playing import judge_greedily
from lodestone.agents.run import load_run, read_run
from lodestone.agents.run_folder import METRICS
from lodestone.errors import TooManyStates
from lodestone.experiments.study import NumberTable
from lodestone.files import read_json, write_atomically, write_json
from lodestone.planning.solve import optimum
from lodestone.report.page import number_text
from lodestone.report.statistics import estimate
from lodestone.sweep.plan import Configuration, Plan, Trial, label

RESULT = "result.json"
DRAWN, LISTED = 4, 100
"""So many configurations, the best ones, have curves on the page, and a line in its table."""

Row = dict[str, Any]
"""What one seed of one trial came to."""


class Standing(NamedTuple):
    """A configuration over all its seeds that have finished."""

    configuration: Configuration
    folders: tuple[Path, ...]
    seeds: int
    greedy_return: float
    """Interquartile mean, with its 95 % interval."""
    low: float
    high: float
    gap: float | None
    """The median distance of the greedy return from the optimum, where one is known."""
    seconds: float
    """Of training, all trials together."""


def judge_trial(folder: Path) -> None:
    """Write what a finished run came to. Raises `BadFile` and `CannotWrite`."""
    run = read_run(folder)
    greedy = judge_greedily(load_run(folder))
    try:
        best = optimum(run.environment).optimal_return
    except TooManyStates:
        best = None
    last = [json.loads(line) for line in (folder / METRICS).read_text().splitlines()[-len(run.seeds) :]]
    rows = [
        {
            "seed": seed,
            **{name: line[name] for name in ("steps", "decisions", "episodes", "seconds")},
            "greedy_return": float(greedy.total_reward[position]),
            "greedy_steps": float(greedy.steps[position]),
            "greedy_decisions": float(greedy.decisions[position]),
            "success": float(greedy.success[position]),
            "optimal_return": best,
            "gap": None if best is None else best - float(greedy.total_reward[position]),
        }
        for position, (seed, line) in enumerate(zip(run.seeds, last, strict=True))
    ]
    write_json(folder / RESULT, rows)


def read_rows(folder: Path) -> list[Row]:
    """What `judge_trial` wrote. Raises `BadFile`."""
    rows: list[Row] = read_json(folder / RESULT)
    return rows


def standings(finished: Mapping[Path, Trial]) -> list[Standing]:
    """The configurations of these trials, by their folders; the highest greedy return first."""
    folders: dict[Configuration, list[Path]] = {}
    for folder, trial in finished.items():
        folders.setdefault(trial.configuration, []).append(folder)
    return sorted((_standing(*each) for each in folders.items()), key=lambda each: -each.greedy_return)


def _standing(configuration: Configuration, folders: Sequence[Path]) -> Standing:
    trials = [read_rows(folder) for folder in folders]
    rows = [row for trial in trials for row in trial]
    middle, low, high = (float(each) for each in estimate(_greedy_returns(trials)))
    gaps = [row["gap"] for row in rows if row["gap"] is not None]
    return Standing(
        configuration=configuration,
        folders=tuple(folders),
        seeds=len(rows),
        greedy_return=middle,
        low=low,
        high=high,
        gap=float(np.median(gaps)) if gaps else None,
        seconds=sum(trial[0]["seconds"] for trial in trials),
    )


def _greedy_returns(trials: Iterable[Sequence[Row]]) -> Float[np.ndarray, " S"]:
    return np.array([row["greedy_return"] for trial in trials for row in trial])


def all_rows(finished: Mapping[Path, Trial]) -> list[Row]:
    """One for each seed: its trial, the varied flags as texts, what it came to."""
    return [
        {
            "trial": folder.name,
            **{flag: label(((flag, value),), "")[len(flag) + 1 :] for flag, value in trial.configuration},
            **row,
        }
        for folder, trial in finished.items()
        for row in read_rows(folder)
    ]


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Raises `CannotWrite`."""
    text = io.StringIO()
    table = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    write_atomically(path, text.getvalue().encode())


def write_report(folder: Path, plan: Plan, ranked: Sequence[Standing]) -> list[str]:
    """The picture and the page of `lodestone report` about the best configurations, under a table of more of them;
    returns their names. Raises `CannotWrite`."""
    from lodestone.report import runs, studies  # pictures are only needed here

    best = ranked[:DRAWN]
    names = {each.folders[0]: label(each.configuration, plan.agent) for each in best}
    learners = [
        replace(learner, name=names[learner.folders[0]], greedy=_greedy_returns(map(read_rows, learner.folders)))
        for learner in runs.read_learners([path for each in best for path in each.folders])
    ]
    study = runs.study_of(learners)
    study = replace(
        study,
        name="sweep",
        title=f"Sweep: {plan.agent} on {plan.environment}",
        summary=f"{study.summary}\n\nCurves and episodes are of the {len(best)} best of {len(ranked)} configurations; "
        "results.csv has every seed of all.",
        tables=(_ranking(plan, ranked[:LISTED]), *study.tables),
    )
    picture, page = "sweep.png", "report.html"
    studies.draw_study(study, folder / picture)
    studies.write_study_report(study, asdict(plan), folder / page)
    return [picture, page]


def _ranking(plan: Plan, ranked: Sequence[Standing]) -> NumberTable:
    rows = tuple(
        (
            label(each.configuration, plan.agent),
            float(each.seeds),
            each.greedy_return,
            f"{number_text(each.low)} to {number_text(each.high)}",
            "unknown" if each.gap is None else each.gap,
            each.seconds,
        )
        for each in ranked
    )
    columns = ("configuration", "seeds", "greedy return", "95 % interval", "median gap to the optimum", "seconds")
    return NumberTable("Configurations, the best first", columns, rows)
