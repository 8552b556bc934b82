"""From what trials came to, to one table: rows for seeds, configurations in order."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from lodestone.files import write_json
from lodestone.sweep.plan import Trial
from lodestone.sweep.results import RESULT, all_rows, standings, write_csv


def finished(folder: Path, optimal: float | None = 10.0) -> dict[Path, Trial]:
    """Three configurations of four seeds in trials of two."""
    found = {}
    for number, (rate, returns) in enumerate(
        [(0.5, (1, 2)), (0.5, (3, 100)), (0.1, (7, 7)), (0.1, (8, 9)), (0.9, (-5, 0)), (0.9, (0, 5))], start=1
    ):
        path, first = folder / f"{number:04}", 2 * (number % 2 == 0)
        rows = [
            {
                "seed": first + at,
                "seconds": 1.5,
                "greedy_return": each,
                "gap": None if optimal is None else optimal - each,
            }
            for at, each in enumerate(returns)
        ]
        write_json(path / RESULT, rows)
        found[path] = Trial((("learning-rate", (0, rate)), ("options", ())), ("q-learning", "two-rooms"))
    return found


def test_the_best_configuration_comes_first(tmp_path):
    best, middle, worst = standings(finished(tmp_path))
    assert [dict(each.configuration)["learning-rate"] for each in (best, middle, worst)] == [
        (0, 0.1),
        (0, 0.5),
        (0, 0.9),
    ]
    assert [path.name for path in middle.folders] == ["0001", "0002"]
    assert (middle.seeds, middle.seconds) == (4, 3.0)
    assert [each.greedy_return for each in (best, middle, worst)] == [7.5, 2.5, 0.0]  # of the middle two seeds
    assert [each.gap for each in (best, middle, worst)] == [2.5, 7.5, 10.0]
    assert worst.low <= worst.greedy_return <= worst.high
    assert {each.gap for each in standings(finished(tmp_path, optimal=None))} == {None}


def test_the_table_has_a_line_for_each_seed(tmp_path):
    rows = all_rows(finished(tmp_path))
    write_csv(tmp_path / "results.csv", rows)
    with (tmp_path / "results.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    assert len(read) == 12
    assert read[3] == {
        "trial": "0002",
        "learning-rate": "0 0.5",
        "options": "",
        "seed": "3",
        "seconds": "1.5",
        "greedy_return": "100",
        "gap": "-90.0",
    }
    assert [int(row["seed"]) for row in read] == [0, 1, 2, 3] * 3
    assert float(read[-1]["gap"]) == pytest.approx(5.0)
