import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from fake_comparison import GATES, SETTINGS, make_comparison

from lodestone.errors import CannotWrite
from lodestone.files import json_safe, write_json
from lodestone.learning.history import Episodes
from lodestone.report.results import (
    Moment,
    agent_rows,
    first_reached,
    first_success,
    results_json,
    summarise,
)


def episodes(total_reward: list[float], success: list[bool]) -> Episodes:
    count = np.arange(1, len(success) + 1)
    return Episodes(10 * count, 20 * count, np.array(total_reward), 20 * count**0, 10 * count**0, np.array(success))


def test_first_moments() -> None:
    some = episodes([0.0] * 50 + [100.0] * 50, [False] * 60 + [True] * 40)
    assert first_success(some) == Moment(610, 1220)
    # The mean of the last 50 is 2 after the 51st episode; it must be exceeded.
    assert first_reached(some, 1.9) == Moment(510, 1020)
    assert first_reached(some, 2.0) == Moment(520, 1040)
    assert first_reached(some, 100.0) is None
    assert first_success(episodes([0.0], [False])) is None
    assert first_success(episodes([], [])) is None


def test_a_seed_that_never_got_there_counts_as_last() -> None:
    most = summarise([5.0, 3.0, None, 4.0])
    assert (most.iqm, most.reached, most.seeds) == (4.5, 3, 4)
    assert most.high == math.inf
    assert summarise([None, None, 1.0, None]).iqm == math.inf


def test_rows_agree_with_the_seeds() -> None:
    comparison = make_comparison(seeds=8, budget=8000)
    agent = comparison.agents[0]  # one of its seeds fails
    rows = {(row.label, row.unit): row.summary for row in agent_rows(agent, comparison.thresholds)}
    assert rows["Greedy episode", "primitive steps"].reached == 7
    assert rows["Gap to the optimum", "return"].reached == 8
    gaps = np.sort([each.gap for each in agent.greedy])
    np.testing.assert_allclose(rows["Gap to the optimum", "return"].iqm, gaps[2:6].mean())
    assert ("Mean return above 80", "decisions") in rows


def test_results_survive_json(tmp_path: Path) -> None:
    comparison = make_comparison(seeds=3, budget=8000)
    never = replace(comparison, thresholds=(50.0, 1e9))
    results = results_json([never], GATES, SETTINGS | {"weird": float("inf"), "path": tmp_path})
    write_json(tmp_path / "new" / "results.json", results)
    text = (tmp_path / "new" / "results.json").read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    assert json.loads(text) == results

    figure = results["figures"][0]
    assert figure["name"] == "figure-2"
    assert figure["optimum"] == {"return": 87.0, "steps": 13, "decisions": 7}
    agent, run = figure["agents"][0], comparison.agents[0]
    assert agent["seconds"] == run.seconds
    assert [seed["seed"] for seed in agent["seeds"]] == [0, 1, 2]
    seed = agent["seeds"][2]
    expected = first_success(run.episodes[2])
    assert expected is not None
    assert seed["first_success"] == {"decisions": expected.decisions, "steps": expected.steps}
    assert seed["thresholds"].keys() == {"50", "1e+09"}
    assert seed["thresholds"]["1e+09"] is None
    assert seed["final"] == {"steps": 200, "decisions": 200, "return": -200.0, "success": False}
    assert seed["gap"] == 287.0
    assert results["gates"][0] == {
        "name": GATES[0].name,
        "measured": 13.0,
        "required": "<= 13",
        "passed": True,
    }
    assert results["gates"][3]["measured"] is None
    assert results["settings"]["weird"] is None
    assert results["settings"]["path"] == str(tmp_path)
    assert results["settings"]["dqn"]["hidden"] == [64, 64]


def test_json_safe_knows_what_settings_are_made_of() -> None:
    class Pair(NamedTuple):
        left: float
        right: float

    @dataclass(frozen=True)
    class Config:
        rate: float
        sizes: tuple[int, ...]

    value = {
        1: Config(np.float32(0.5), (1, 2)),
        "pair": Pair(math.nan, -math.inf),
        "array": np.array([[1.0, np.nan]]),
        "flags": [np.bool_(True), None],
    }
    assert json_safe(value) == {
        "1": {"rate": 0.5, "sizes": [1, 2]},
        "pair": {"left": None, "right": None},
        "array": [[1.0, None]],
        "flags": [True, None],
    }


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "results.json"
    write_json(path, {"old": 1})

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(CannotWrite, match="No space left"):
        write_json(path, {"new": 2})
    assert json.loads(path.read_text()) == {"old": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CannotWrite, match="Cannot write"):
        write_json(tmp_path / "file" / "results.json", {})
