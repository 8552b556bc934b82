"""From a plan, a TOML file, to the trials of a sweep: every configuration with every group of seeds.

A configuration gives each varied flag of `lodestone train` a value: all combinations of the grid's values, each with
every draw of the random search. A trial is the words after `lodestone train`; nothing here runs them.
"""

from __future__ import annotations

import math
import random
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from lodestone.errors import BadFile, InvalidConfig
from lodestone.files import read_file

MOST_TRIALS = 100_000
OF_THE_SWEEP = ("out", "seed", "seeds", "json", "help")
"""Flags of `lodestone train` that the sweep itself sets."""

Value = Any
"""Of a flag: a number, a truth value, a text, or a list of values."""
Configuration = tuple[tuple[str, Value], ...]
"""The varied flags, each with its value; lists are tuples."""


@dataclass(frozen=True)
class Plan:
    """What is to be tried."""

    agent: str
    environment: str
    seeds: int
    """Of every configuration: 0, 1, and so on."""
    seeds_per_trial: int
    """Trained at once, in one process."""
    train: dict[str, Value]
    """Flags of `lodestone train` that are the same for all."""
    grid: dict[str, list[Value]]
    """Values to combine."""
    draws: int
    """How many random configurations, for each of the grid's; without random values it is 1."""
    draw_seed: int
    values: dict[str, Value]
    """What is drawn for each flag: a list is a uniform choice, {low, high} a number between, {..., log = true} one
    whose logarithm is uniform. Within what was chosen, too. Between whole numbers, whole numbers are drawn."""


class Trial(NamedTuple):
    """One configuration with one group of seeds."""

    configuration: Configuration
    words: tuple[str, ...]
    """After `lodestone train`, but for --out."""


def read_plan(path: Path) -> Plan:
    """Raises `BadFile`, and `InvalidConfig` for what is no plan."""
    text = read_file(path)
    try:
        content = tomllib.loads(text.decode())
    except (ValueError, RecursionError) as error:
        raise BadFile(f"{path} is no TOML file: {str(error).rstrip('.')}.") from None
    return plan_of(content)


def plan_of(content: Mapping[str, Any]) -> Plan:
    """The plan that a TOML file holds. Raises `InvalidConfig`."""
    content = dict(content)
    agent, environment = (_take(content, "the plan", name, str) for name in ("agent", "environment"))
    seeds = _take(content, "the plan", "seeds", int, 1)
    seeds_per_trial = _take(content, "the plan", "seeds-per-trial", int, seeds)
    train, grid, drawn = (_take(content, "the plan", name, dict, {}) for name in ("train", "grid", "random"))
    _nothing_left("the plan", content)
    values = _take(drawn, "[random]", "values", dict, {})
    draws = _take(drawn, "[random]", "draws", int, None if values else 1)
    draw_seed = _take(drawn, "[random]", "seed", int, 0)
    _nothing_left("[random]", drawn)
    for name, number in (("seeds", seeds), ("seeds-per-trial", seeds_per_trial), ("draws", draws)):
        if number < 1:
            raise InvalidConfig(f"{name} is {number}, but must be at least 1.")
    if draws > 1 and not values:
        raise InvalidConfig("[random] has draws, but no values to draw.")
    _check_flags(train, grid, values)
    for flag, value in train.items():
        _check_value(flag, value, ranges=False)
    for flag, choices in grid.items():
        if not isinstance(choices, list) or not choices:
            raise InvalidConfig(f"{flag} in [grid] has to be a list of at least one value.")
        _check_value(flag, choices, ranges=False)
    for flag, value in values.items():
        if not isinstance(value, dict | list) or not value:
            raise InvalidConfig(f"{flag} in [random.values] has to be a list of values, or a table of low and high.")
        _check_value(flag, value, ranges=True)
    groups = -(-seeds // seeds_per_trial)
    count = math.prod(map(len, grid.values())) * draws * groups
    if count > MOST_TRIALS:
        raise InvalidConfig(f"The plan makes {count:,} trials; {MOST_TRIALS:,} is the most.")
    return Plan(agent, environment, seeds, seeds_per_trial, train, grid, draws, draw_seed, values)


def configurations(plan: Plan) -> list[Configuration]:
    """Every combination once, the grid's last flag changing fastest, and then every draw."""
    rng = random.Random(plan.draw_seed)
    drawn = [{flag: _draw(value, rng, one_of=True) for flag, value in plan.values.items()} for _ in range(plan.draws)]
    combined = [dict(zip(plan.grid, values, strict=True)) for values in product(*plan.grid.values())]
    return list(dict.fromkeys(_configuration({**one, **two}) for one in combined for two in drawn))


def trials(plan: Plan) -> list[Trial]:
    """All of them, a configuration's groups of seeds next to one another."""
    return [
        Trial(
            configuration, (*words, "--seed", str(first), "--seeds", str(min(plan.seeds_per_trial, plan.seeds - first)))
        )
        for configuration in configurations(plan)
        for words in [_words(plan, configuration)]
        for first in range(0, plan.seeds, plan.seeds_per_trial)
    ]


def corners(plan: Plan) -> list[Trial]:
    """A few trials that show every value of the grid, every choice, and both ends of every range at least once.

    A flag that `lodestone train` refuses is refused here, without asking it about a thousand trials.
    """
    seen = {**plan.grid, **{flag: _extremes(value, one_of=True) for flag, value in plan.values.items()}}
    first = {flag: values[0] for flag, values in seen.items()}
    changed = [first, *({**first, flag: value} for flag, values in seen.items() for value in values[1:])]
    group = ("--seed", "0", "--seeds", str(min(plan.seeds, plan.seeds_per_trial)))
    return [
        Trial(configuration, (*_words(plan, configuration), *group)) for configuration in map(_configuration, changed)
    ]


def label(configuration: Configuration, otherwise: str) -> str:
    """For people; `otherwise` where nothing is varied."""
    return ", ".join(f"{flag} {' '.join(_texts(value))}".rstrip() for flag, value in configuration) or otherwise


def _words(plan: Plan, configuration: Configuration) -> tuple[str, ...]:
    flags = [*plan.train.items(), *configuration]
    return (plan.agent, plan.environment, *(word for flag, value in flags for word in _flag(flag, value)))


def _flag(flag: str, value: Value) -> list[str]:
    if isinstance(value, bool):
        return [f"--{flag}" if value else f"--no-{flag}"]
    return [f"--{flag}", *_texts(value)]


def _texts(value: Value) -> list[str]:
    if isinstance(value, list | tuple):
        return [text for each in value for text in _texts(each)]
    return [str(value)]


def _configuration(values: Mapping[str, Value]) -> Configuration:
    return tuple((flag, _frozen(value)) for flag, value in values.items())


def _frozen(value: Value) -> Value:
    return tuple(map(_frozen, value)) if isinstance(value, list | tuple) else value


# ------------------------------------------------------------------------------------------------------------- draws


def _draw(value: Value, rng: random.Random, one_of: bool = False) -> Value:
    """Of `random()` alone, whose stream no version of Python changes."""
    if isinstance(value, dict):
        return _number(value, rng.random())
    if not isinstance(value, list):
        return value
    if one_of:
        return _draw(value[int(rng.random() * len(value))], rng)
    return [_draw(each, rng) for each in value]


def _number(bounds: Mapping[str, Any], part: float) -> float | int:
    """The number at a part, from 0 up to 1, of the way from low to high."""
    low, high = bounds["low"], bounds["high"]
    whole = isinstance(low, int) and isinstance(high, int)
    if whole and not bounds.get("log"):
        return low + min(int(part * (high - low + 1)), high - low)
    if bounds.get("log"):
        number = math.exp(math.log(low) + part * (math.log(high) - math.log(low)))
    else:
        number = low + part * (high - low)
    readable = round(number) if whole else float(f"{number:.6g}")
    return min(max(readable, low), high)


def _extremes(value: Value, one_of: bool = False) -> list[Value]:
    """What can be drawn, of ranges both ends."""
    if isinstance(value, dict):
        return [_number(value, 0.0), _number(value, 1.0)]
    if not isinstance(value, list):
        return [value]
    if one_of:
        return [end for each in value for end in _extremes(each)]
    ends = [_extremes(each) for each in value]
    return [[each[0] for each in ends], [each[-1] for each in ends]] if any(len(each) > 1 for each in ends) else [value]


# ------------------------------------------------------------------------------------------------------------ checks


def _take(content: dict[str, Any], place: str, name: str, kind: type, otherwise: Any = None) -> Any:
    value = content.pop(name, otherwise)
    if value is None:
        raise InvalidConfig(f"{name} is missing in {place}.")
    if type(value) is not kind:
        raise InvalidConfig(f"{name} in {place} has to be {_KINDS[kind]}.")
    return {**value} if isinstance(value, dict) else value


_KINDS: dict[type, str] = {str: "a text", int: "a whole number", dict: "a table"}


def _nothing_left(place: str, content: Mapping[str, Any]) -> None:
    for name in content:
        raise InvalidConfig(f"There is no setting {name!r} in {place}.")


def _check_flags(*tables: Mapping[str, Any]) -> None:
    flags = [flag for table in tables for flag in table]
    for flag in flags:
        if not re.fullmatch(r"[a-z][a-z0-9-]*", flag):
            raise InvalidConfig(f"{flag!r} is no flag of `lodestone train`: they are written like learning-rate.")
        if flag in OF_THE_SWEEP:
            raise InvalidConfig(f"The sweep itself sets {flag}: it cannot be a flag in the plan.")
        if flags.count(flag) > 1:
            raise InvalidConfig(f"{flag} is given twice: a flag is in [train], in [grid] or in [random.values].")


def _check_value(flag: str, value: Value, ranges: bool) -> None:
    if isinstance(value, list):
        for each in value:
            _check_value(flag, each, ranges)
    elif isinstance(value, dict) and ranges:
        _check_range(flag, value)
    elif isinstance(value, str) and value.startswith("-"):
        raise InvalidConfig(f"{flag} cannot be {value!r}, which would be another flag.")
    elif not isinstance(value, bool | int | float | str):
        raise InvalidConfig(f"{flag} has to be made of numbers, texts, truth values and lists of them.")


def _check_range(flag: str, bounds: Mapping[str, Any]) -> None:
    low, high, log = bounds.get("low"), bounds.get("high"), bounds.get("log", False)
    fits = set(bounds) <= {"low", "high", "log"} and type(low) in (int, float) and type(high) in (int, float)
    if not fits or type(log) is not bool:
        raise InvalidConfig(f"{flag} has a range that is not of the form {{low = 0.1, high = 1.0, log = true}}.")
    assert low is not None
    assert high is not None
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InvalidConfig(f"{flag} has a range from {low} to {high}: low must be below high, both finite.")
    if log and low <= 0:
        raise InvalidConfig(f"{flag} has a logarithmic range from {low}, which must be above 0.")
