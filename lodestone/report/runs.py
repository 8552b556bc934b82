"""What training runs have left behind, as findings to look at: curves, numbers side by side, options used."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from lodestone.agents.playing import Playback, episodes_to_judge, play_many, record
from lodestone.agents.run import CONFIG, Run, is_finished, load_run, read_run
from lodestone.agents.run_folder import METRICS
from lodestone.envs.host import Registered
from lodestone.envs.registry import describe_environment
from lodestone.errors import BadFile, EnvironmentFailed, InvalidConfig, TooManyStates
from lodestone.experiments.study import NumberTable, Panel, Series, Study
from lodestone.files import read_file, read_json
from lodestone.planning.solve import Optimum, optimum
from lodestone.report.page import number_text
from lodestone.report.statistics import RESAMPLES, estimate

POINTS = 150
"""Of a curve."""

NEAR = 0.9
"""Part of the way from the first mean return to the optimum (or, where none is known, to the best that was seen) that
counts as having learned."""

FEW_CHOICES = 16
"""Up to so many, a diagram shows how often each was taken."""


@dataclass(frozen=True)
class Lines:
    """The metrics of one seed, line by line: T lines; mean returns are of the last 50 episodes."""

    steps: Float[np.ndarray, " T"]
    decisions: Float[np.ndarray, " T"]
    seconds: Float[np.ndarray, " T"]
    mean_return: Float[np.ndarray, " T"]
    """Not a number before the first episode has ended."""
    calls: Float[np.ndarray, "T O"]
    """Of each choice, since the line before."""
    steps_of_calls: Float[np.ndarray, "T O"]
    """Primitive steps that these took; not numbers in the metrics of an older version."""


@dataclass(frozen=True)
class Learner:
    """Runs that differ in their seeds alone."""

    name: str
    folders: tuple[Path, ...]
    run: Run
    """The first of them."""
    choices: tuple[str, ...]
    seeds: tuple[Lines, ...]
    greedy: Float[np.ndarray, " S"] | None = None
    """What the greedy policies return, where that is known already."""

    @cached_property
    def place(self) -> str:
        """Where it learns, for people."""
        environment = self.run.environment
        if isinstance(environment, Registered):
            return environment.id
        told, plain = describe_environment(environment), describe_environment(type(environment)())
        changed = [
            f"{name.replace('_', ' ')} {value}"
            for name, value in told["parameters"].items()
            if value != plain["parameters"][name]
        ]
        return f"{told['name']} ({', '.join(changed)})" if changed else str(told["name"])


def read_learners(folders: Sequence[Path]) -> list[Learner]:
    """The runs in these folders, finished or not; those with equal settings are one learner.

    Raises `BadFile`, and `InvalidConfig` where a run is given twice.
    """
    found: dict[str, Learner] = {}
    for folder in folders:
        run = read_run(folder)
        told = {key: value for key, value in read_json(folder / CONFIG).items() if key not in ("seeds", "versions")}
        choices, lines = _read_metrics(folder / METRICS, run.seeds)
        key = json.dumps(told, sort_keys=True)
        if key not in found:
            found[key] = Learner(_name(folder), (folder,), run, choices, lines)
            continue
        known = found[key]
        given = {seed for each in known.folders for seed in read_run(each).seeds}
        if given & set(run.seeds):
            raise InvalidConfig(f"{folder} has the same settings and seed as {known.folders[-1]}.")
        found[key] = replace(known, folders=(*known.folders, folder), seeds=known.seeds + lines)
    names = [learner.name for learner in found.values()]
    return [
        learner if names.count(learner.name) == 1 else replace(learner, name=str(learner.folders[0]))
        for learner in found.values()
    ]


def _name(folder: Path) -> str:
    return folder.resolve().name


def read_rows(path: Path, seeds: Sequence[int]) -> tuple[list[dict[str, Any]], ...]:
    """Every seed's lines of the metrics, as many of each and at least one; what a run that is still going on has only
    half written is left out. Raises `BadFile`."""
    if not path.exists():
        raise BadFile(f"{path} cannot be read: there is nothing to report before a run's first progress.")
    *lines, _ = read_file(path).split(b"\n")
    rows: dict[int, list[dict[str, Any]]] = {seed: [] for seed in seeds}
    try:
        for line in lines:
            row = json.loads(line)
            rows[row["seed"]].append(row)
    except (ValueError, KeyError, TypeError, RecursionError):
        raise damaged(path) from None
    count = min(map(len, rows.values()))
    if not count:
        raise BadFile(f"{path} has no line of every seed yet.")
    return tuple(rows[seed][:count] for seed in seeds)


def damaged(path: Path) -> BadFile:
    """What to say of metrics that are not as they were written."""
    return BadFile(f"{path} is damaged: every line has to be the JSON object of one seed's progress.")


def _read_metrics(path: Path, seeds: Sequence[int]) -> tuple[tuple[str, ...], tuple[Lines, ...]]:
    """The choices, and every seed's lines. Raises `BadFile`."""
    rows = read_rows(path, seeds)
    try:
        choices = tuple(rows[0][0]["calls"])
        return choices, tuple(_lines(each, choices) for each in rows)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError):
        raise damaged(path) from None


def _lines(rows: Sequence[Mapping[str, Any]], choices: tuple[str, ...]) -> Lines:
    def numbers(values: list[Any], axes: int) -> np.ndarray:
        found = np.array(values, dtype=np.float64)  # None is not a number
        if found.ndim != axes:
            raise ValueError("There is a list in the place of a number.")
        return found

    def column(name: str) -> Float[np.ndarray, " T"]:
        return numbers([row[name] for row in rows], 1)

    def of_choices(name: str) -> Float[np.ndarray, "T O"]:
        return numbers([[row[name][choice] for choice in choices] for row in rows], 2)

    calls = of_choices("calls")
    tell = all("steps_of_calls" in row for row in rows)
    steps_of_calls = of_choices("steps_of_calls") if tell else np.full_like(calls, np.nan)
    return Lines(column("steps"), column("decisions"), column("seconds"), column("mean_return"), calls, steps_of_calls)


def study_of(learners: Sequence[Learner]) -> Study:
    """Curves and numbers of some learners, those of one environment beside one another."""
    places = list(dict.fromkeys(learner.place for learner in learners))
    panels: list[Panel] = []
    tables: list[NumberTable] = []
    for place in places:
        here = [learner for learner in learners if learner.place == place]
        best = _optimum(here[0])
        panels += _curves(place, here, best)
        tables.append(_ends(place, here, best))
        tables.append(_times(place, here, best))
        if len(here) > 1:
            tables.append(_improvements(place, here))
    for learner in learners:
        if 1 < len(learner.choices) <= FEW_CHOICES:
            panels.append(_usage(learner))
            panels += _lengths(learner)
    return Study(
        name="runs",
        title="Training runs",
        summary="Mean returns are of the last 50 episodes of training, exploration included.",
        seeds=max(len(learner.seeds) for learner in learners),
        panels=tuple(panels),
        tables=tuple(tables),
        gates=(),
        playbacks=tuple(playback for learner in learners if (playback := _playback(learner)) is not None),
    )


def _optimum(learner: Learner) -> Optimum | None:
    try:
        return optimum(learner.run.environment)
    except TooManyStates:
        return None


def _curves(place: str, learners: Sequence[Learner], best: Optimum | None) -> list[Panel]:
    units = {"steps": "primitive steps", "decisions": "decisions", "seconds": "seconds of training, all seeds together"}
    late = np.concatenate([lines.mean_return[len(lines.steps) // 4 :] for each in learners for lines in each.seeds])
    late = late[np.isfinite(late)]
    lowest = late.min() if late.size else 0.0
    highest = max(late.max() if late.size else 1.0, best.optimal_return if best else -np.inf)
    shown = (float(lowest), float(highest)) if highest > lowest else None
    return [
        Panel(
            title=f"{place}: return",
            x_label=label,
            y_label="mean return",
            series=tuple(_series(each, unit) for each in learners),
            references=(("optimum", best.optimal_return),) if best else (),
            y_range=shown,
        )
        for unit, label in units.items()
    ]


def _series(learner: Learner, unit: str) -> Series:
    """On one axis for all seeds, as far as every seed got."""
    x = np.linspace(0, min(getattr(lines, unit)[-1] for lines in learner.seeds), POINTS)
    rows = [_between(x, getattr(lines, unit), lines.mean_return) for lines in learner.seeds]
    return Series(learner.name, x, np.stack(rows))


def _between(x: Float[np.ndarray, " X"], at: Float[np.ndarray, " T"], values: Float[np.ndarray, " T"]) -> np.ndarray:
    known = np.isfinite(values)
    if not known.any():
        return np.full(len(x), np.nan)
    return np.interp(x, at[known], values[known], left=np.nan)


def _ends(place: str, learners: Sequence[Learner], best: Optimum | None) -> NumberTable:
    rows: list[tuple[str | float, ...]] = []
    for learner in learners:
        last = np.array([lines.mean_return[-1] for lines in learner.seeds])
        greedy = _greedy_returns(learner)
        gap = "" if best is None or greedy is None else number_text(best.optimal_return - float(np.median(greedy)))
        rows.append(
            (
                learner.name,
                float(len(learner.seeds)),
                _estimate(last),
                "not finished" if greedy is None else _estimate(greedy),
                gap,
                float(sum(float(lines.steps[-1]) for lines in learner.seeds)),
            )
        )
    columns = ("learner", "seeds", "mean return at the end", "greedy return", "median gap to the optimum", "steps, all")
    return NumberTable(f"{place}: where they ended", columns, tuple(rows))


def _greedy_returns(learner: Learner) -> Float[np.ndarray, " S"] | None:
    if learner.greedy is not None:
        return learner.greedy
    if not all(is_finished(folder) for folder in learner.folders):
        return None
    found = []
    for folder in learner.folders:
        policy = load_run(folder)
        played = play_many(policy, jax.random.key(0), episodes_to_judge(policy))
        found.append(np.asarray(played.total_reward, dtype=np.float64).mean(axis=1))
    return np.concatenate(found)


def _times(place: str, learners: Sequence[Learner], best: Optimum | None) -> NumberTable:
    everything = [lines.mean_return for each in learners for lines in each.seeds]
    known = [values[np.isfinite(values)] for values in everything if np.isfinite(values).any()]
    first = min((values[0] for values in known), default=np.nan)
    top = best.optimal_return if best else max((values.max() for values in known), default=np.nan)
    threshold = float(first + NEAR * (top - first))
    rows = []
    for learner in learners:
        reached = [np.flatnonzero(lines.mean_return >= threshold) for lines in learner.seeds]
        cells = []
        for unit in ("steps", "decisions", "seconds"):
            when = [
                getattr(lines, unit)[at[0]] if at.size else np.inf
                for lines, at in zip(learner.seeds, reached, strict=True)
            ]
            cells.append(_estimate(np.array(when)))
        rows.append((learner.name, *cells, f"{sum(bool(at.size) for at in reached)} of {len(reached)}"))
    title = f"{place}: until the mean return was {number_text(threshold)}, {NEAR:.0%} of the way"
    columns = ("learner", "primitive steps", "decisions", "seconds", "seeds that got there")
    return NumberTable(title, columns, tuple(rows))


def _improvements(place: str, learners: Sequence[Learner]) -> NumberTable:
    """Agarwal et al. (2021): the probability that a seed of one learner does better than a seed of another."""
    rows = []
    for one, other in permutations(learners, 2):
        ours, theirs = (np.array([lines.mean_return[-1] for lines in each.seeds]) for each in (one, other))
        better = (ours[:, None] > theirs[None]) + 0.5 * (ours[:, None] == theirs[None])
        rng = np.random.default_rng(0)
        picked, against = (rng.integers(len(each), size=(RESAMPLES, len(each))) for each in (ours, theirs))
        drawn = np.sort([better[np.ix_(a, b)].mean() for a, b in zip(picked, against, strict=True)])
        low, high = float(drawn[RESAMPLES // 40]), float(drawn[-1 - RESAMPLES // 40])
        rows.append((f"{one.name} over {other.name}", _interval(float(better.mean()), low, high)))
    columns = ("", "probability that a seed ends higher")
    return NumberTable(f"{place}: probability of improvement", columns, tuple(rows))


def _estimate(values: Float[np.ndarray, " S"]) -> str:
    """The interquartile mean, with its interval where there are several seeds."""
    middle, low, high = (float(each) for each in estimate(values))
    return number_text(middle) if len(values) == 1 else _interval(middle, low, high)


def _interval(middle: float, low: float, high: float) -> str:
    return f"{number_text(middle)} [{number_text(low)}, {number_text(high)}]"


def _usage(learner: Learner) -> Panel:
    shares = [lines.calls / np.maximum(lines.calls.sum(axis=1, keepdims=True), 1) for lines in learner.seeds]
    return Panel(
        title=f"{learner.name}: choices taken",
        x_label="primitive steps",
        y_label="share of decisions",
        series=_by_choice(learner, shares),
        y_range=(0.0, 1.0),
    )


def _lengths(learner: Learner) -> list[Panel]:
    """One, if some choice takes more than a step and the metrics tell."""
    with np.errstate(all="ignore"):  # none were called: not a number
        lengths = [lines.steps_of_calls / lines.calls for lines in learner.seeds]
    if not any((each > 1).any() for each in lengths):
        return []
    series = _by_choice(learner, lengths)
    return [
        Panel(
            title=f"{learner.name}: how long choices last",
            x_label="primitive steps",
            y_label="mean steps of a call",
            series=series,
        )
    ]


def _by_choice(learner: Learner, values: Sequence[Float[np.ndarray, "T O"]]) -> tuple[Series, ...]:
    """A curve of each choice, from the values of every seed."""
    x = np.linspace(0, min(lines.steps[-1] for lines in learner.seeds), POINTS)
    return tuple(
        Series(
            choice,
            x,
            np.stack(
                [_between(x, lines.steps, each[:, at]) for lines, each in zip(learner.seeds, values, strict=True)]
            ),
        )
        for at, choice in enumerate(learner.choices)
    )


def _playback(learner: Learner) -> Playback | None:
    """A greedy episode of its first seed; None of a run that is not finished, or that has no pictures."""
    if not is_finished(learner.folders[0]):
        return None
    try:
        return record(load_run(learner.folders[0]), 0, jax.random.key(0), learner.name)
    except EnvironmentFailed:
        return None
