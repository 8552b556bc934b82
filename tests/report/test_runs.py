"""Runs as a page: what its curves and tables say is what the metrics say."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lodestone.agents.q_learning import QLearningConfig
from lodestone.agents.run import Run, save_run
from lodestone.cli import main
from lodestone.envs.chain import Chain
from lodestone.errors import BadFile, InvalidConfig
from lodestone.experiments.study import NumberTable
from lodestone.options.base import Primitives
from lodestone.options.execution import Rules
from lodestone.report.runs import read_learners, study_of

CHAIN = Chain()


def write(folder: Path, returns: dict[int, list[float | None]], discount: float = 0.9) -> Path:
    """An unfinished run whose seeds had these mean returns after 100, 200 and so on steps."""
    folder.mkdir()
    run = Run(QLearningConfig(), CHAIN, Rules(discount), Primitives(CHAIN.action_names), 1000, tuple(returns))
    save_run(folder, run)
    lines = []
    for chunk in range(max(map(len, returns.values()))):
        for seed, values in returns.items():
            if chunk < len(values):
                steps = 100 * (chunk + 1)
                calls = {"left": 25 * seed, "right": 100 - 25 * seed}
                lasted = {"left": calls["left"], "right": 3 * calls["right"]}
                told = {"seed": seed, "steps": steps, "decisions": steps // 2, "seconds": steps / 10, "calls": calls}
                told |= {"steps_of_calls": lasted}
                lines.append(json.dumps({**told, "mean_return": values[chunk]}) + "\n")
    (folder / "metrics.jsonl").write_text("".join(lines))
    return folder


def table(tables: tuple[NumberTable, ...], title: str) -> dict[str, tuple]:
    (found,) = (each for each in tables if title in each.title)
    return {str(row[0]): row[1:] for row in found.rows}


def test_curves_and_numbers_are_those_of_the_metrics(tmp_path):
    good = write(tmp_path / "good", {0: [None, 0.1, 0.3, 0.3], 1: [0.0, 0.1, 0.2, 0.4]})
    bad = write(tmp_path / "bad", {0: [0.0, 0.0, 0.0], 1: [0.0, 0.0, 0.35]}, discount=0.5)
    study = study_of(read_learners([good, bad]))
    assert (study.seeds, study.playbacks) == (2, ())
    curve = study.panels[0].series[0]
    assert (curve.name, curve.x[0], curve.x[-1]) == ("good", 0, 400)
    np.testing.assert_allclose(
        curve.seeds[0], np.interp(curve.x, [200, 300, 400], [0.1, 0.3, 0.3], left=np.nan), equal_nan=True
    )
    (reference,) = study.panels[0].references
    assert reference[1] == pytest.approx(0.208, abs=1e-3)  # the chain's optimum
    usage = next(panel for panel in study.panels if panel.title == "good: choices taken")
    np.testing.assert_allclose(usage.series[0].seeds[1][100], 0.25)
    lengths = next(panel for panel in study.panels if panel.title == "good: how long choices last")
    np.testing.assert_allclose([series.seeds[1][100] for series in lengths.series], [1, 3])
    assert np.isnan(lengths.series[0].seeds[0]).all()  # never called
    ends = table(study.tables, "where they ended")
    assert ends["good"][0] == 2
    assert ends["good"][1].startswith("0.35 [0.3, 0.4]")
    assert ends["good"][2] == "not finished"
    improvement = table(study.tables, "probability of improvement")
    assert improvement["good over bad"][0].startswith("0.75 [")  # of four pairs .3 is above 0 alone, .4 above both
    assert improvement["bad over good"][0].startswith("0.25 [")
    times = table(study.tables, "until the mean return was 0.187, 90% of the way")
    assert times["good"] == ("300 [300, 300]", "150 [150, 150]", "30 [30, 30]", "2 of 2")
    assert times["bad"][0].startswith("∞ [")
    assert times["bad"][3] == "1 of 2"


def test_runs_that_differ_in_their_seeds_are_one_learner(tmp_path):
    one, other = write(tmp_path / "one", {0: [0.1]}), write(tmp_path / "other", {1: [0.2], 2: [0.3, 0.4]})
    (learner,) = read_learners([one, other])
    assert learner.name == "one"
    assert [lines.mean_return.tolist() for lines in learner.seeds] == [[0.1], [0.2], [0.3]]
    with pytest.raises(InvalidConfig, match="same settings and seed"):
        read_learners([one, write(tmp_path / "third", {0: [0.5]})])


def test_what_cannot_be_reported_is_said(tmp_path):
    run = write(tmp_path / "run", {0: [0.1]})
    whole = json.loads((run / "metrics.jsonl").read_text().splitlines()[0])
    for text, message in (("", "no line of every seed"), ("{}\n", "is damaged"), ('{"seed": 9}\n', "is damaged")):
        (run / "metrics.jsonl").write_text(text)
        with pytest.raises(BadFile, match=message):
            read_learners([run])
    for name in ("steps", "seconds", "mean_return", "calls"):
        nested = {choice: [number] for choice, number in whole["calls"].items()} if name == "calls" else [whole[name]]
        (run / "metrics.jsonl").write_text(json.dumps(whole | {name: nested}) + "\n")
        with pytest.raises(BadFile, match="is damaged"):
            read_learners([run])
    (run / "metrics.jsonl").unlink()
    with pytest.raises(BadFile, match="nothing to report"):
        read_learners([run])


def test_the_command_writes_a_page_with_an_episode(tmp_path, capsys):
    for seed in (0, 1):
        words = [
            "train",
            "q-learning",
            "chain",
            "--steps",
            "2000",
            "--seed",
            str(seed),
            "--out",
            str(tmp_path / str(seed)),
        ]
        assert main(words) == 0
    capsys.readouterr()
    assert main(["report", str(tmp_path / "0"), str(tmp_path / "1"), "--out", str(tmp_path / "page"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["seeds"] == 2
    page = (tmp_path / "page" / "report.html").read_text()
    assert 'class="player"' in page
    assert "median gap to the optimum" in page
    assert (tmp_path / "page" / "runs.png").stat().st_size > 10_000
    assert main(["report", str(tmp_path / "nothing")]) == 2
    assert "nothing" in capsys.readouterr().err
