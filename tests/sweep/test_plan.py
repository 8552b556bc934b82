"""From a plan to trials: combinations, draws, groups of seeds, and what is refused."""

from __future__ import annotations

import math
import time
import tomllib
from pathlib import Path

import pytest

from lodestone.errors import BadFile, InvalidConfig
from lodestone.sweep.plan import Trial, configurations, corners, label, plan_of, read_plan, trials

START = 'agent = "q-learning"\nenvironment = "two-rooms"\n'


def planned(text: str) -> list[Trial]:
    return trials(plan_of(tomllib.loads(START + text)))


def test_every_combination_is_tried_with_every_group_of_seeds():
    found = planned(
        "seeds = 5\nseeds-per-trial = 2\n[train]\nsteps = 300\n[grid]\nlearning-rate = [[0, 0.5], [0, 0.1]]\n"
        "primitives = [true, false]\n"
    )
    same = ("q-learning", "two-rooms", "--steps", "300", "--learning-rate", "0")
    assert [trial.words for trial in found] == [
        (*same, rate, flag, "--seed", str(first), "--seeds", str(count))
        for rate in ("0.5", "0.1")
        for flag in ("--primitives", "--no-primitives")
        for first, count in ((0, 2), (2, 2), (4, 1))
    ]
    assert label(found[0].configuration, "") == "learning-rate 0 0.5, primitives True"


def test_the_grid_is_crossed_with_the_draws():
    plan = (
        "[grid]\nsteps = [100, 200]\n[random]\ndraws = 3\n[random.values]\nepsilon = [[0, {low = 0.0, high = 1.0}]]\n"
    )
    found = [dict(trial.configuration) for trial in planned(plan)]
    assert [each["steps"] for each in found] == [100] * 3 + [200] * 3
    assert [each["epsilon"] for each in found[:3]] == [each["epsilon"] for each in found[3:]]
    assert len({each["epsilon"] for each in found}) == 3
    assert planned(plan) == planned(plan)
    assert planned(plan) != planned(plan.replace("draws = 3", "draws = 3\nseed = 1"))


def test_draws_keep_within_their_bounds_and_spread_as_asked():
    found = planned(
        "[random]\ndraws = 2000\n[random.values]\na = {low = 0.0123456, high = 1.0, log = true}\n"
        "b = {low = -1.5, high = 2.5}\nc = {low = 1, high = 3}\nd = {low = 1, high = 100, log = true}\n"
        'e = ["x", "y"]\n'
    )
    a, b, c, d, e = zip(*([value for _, value in trial.configuration] for trial in found), strict=True)
    assert len(found) == 2000
    assert min(a) >= 0.0123456
    assert max(a) <= 1
    assert sum(math.log(each) for each in a) / 2000 == pytest.approx(math.log(0.0123456) / 2, abs=0.1)
    assert (min(b) >= -1.5, max(b) <= 2.5) == (True, True)
    assert sum(b) / 2000 == pytest.approx(0.5, abs=0.1)
    assert [c.count(each) / 2000 for each in (1, 2, 3)] == pytest.approx([1 / 3] * 3, abs=0.05)
    assert {type(each) for each in d} == {int}
    assert sum(each <= 10 for each in d) / 2000 == pytest.approx(0.5, abs=0.06)
    assert e.count("x") / 2000 == pytest.approx(0.5, abs=0.05)


def test_a_configuration_that_is_drawn_twice_is_tried_once():
    assert len(planned("[random]\ndraws = 50\n[random.values]\nsteps = [1, 2, 2.0]\n")) == 2


def test_corners_show_every_value_and_both_ends_of_a_range():
    plan = plan_of(
        tomllib.loads(
            START + "[grid]\na = [1, 2, 3]\nb = [true, false]\n[random]\ndraws = 9\n[random.values]\n"
            "c = [[0, {low = 0.1, high = 0.9}], 5]\nd = {low = 1.0, high = 4.0, log = true}\n"
        )
    )
    shown = [dict(trial.configuration) for trial in corners(plan)]
    assert {each["a"] for each in shown} == {1, 2, 3}
    assert {each["c"] for each in shown} == {(0, 0.1), (0, 0.9), 5}
    assert {each["d"] for each in shown} == {1.0, 4.0}
    assert len(shown) == 1 + 2 + 1 + 2 + 1


def test_a_thousand_trials_are_planned_at_once():
    started = time.perf_counter()
    found = planned(
        "seeds = 2\nseeds-per-trial = 1\n[random]\ndraws = 500\n[random.values]\na = {low = 0.0, high = 1e9}\n"
    )
    assert len(found) == 1000
    assert time.perf_counter() - started < 2


REFUSED = [
    ("seeds = 0", "seeds is 0, but must be at least 1."),
    ("seeds = 1.5", "seeds in the plan has to be a whole number."),
    ("seeds = true", "seeds in the plan has to be a whole number."),
    ("speed = 1", "There is no setting 'speed' in the plan."),
    ("grid = 1", "grid in the plan has to be a table."),
    ("[grid]\nsteps = 100", "steps in [grid] has to be a list of at least one value."),
    ("[grid]\nsteps = []", "steps in [grid] has to be a list of at least one value."),
    ("[train]\nsteps = 1\n[grid]\nsteps = [2]", "steps is given twice"),
    ("[train]\nout = 'x'", "The sweep itself sets out"),
    ("[train]\nlearning_rate = 1", "'learning_rate' is no flag of `lodestone train`"),
    ("[train]\nagent = '--out'", "agent cannot be '--out', which would be another flag."),
    ("[train]\na = {low = 1, high = 2}", "a has to be made of numbers, texts, truth values and lists of them."),
    ("[train]\na = 2020-01-01", "a has to be made of numbers"),
    ("[random]\ndraws = 2", "[random] has draws, but no values to draw."),
    ("[random.values]\na = [1]", "draws is missing in [random]."),
    ("[random]\ndraws = 2\n[random.values]\na = 1", "a in [random.values] has to be a list of values, or a table"),
    ("[random]\ndraws = 2\n[random.values]\na = {low = 1}", "a has a range that is not of the form"),
    (
        "[random]\ndraws = 2\n[random.values]\na = {low = 1, high = 2, step = 1}",
        "a has a range that is not of the form",
    ),
    ("[random]\ndraws = 2\n[random.values]\na = {low = 2, high = 1}", "a has a range from 2 to 1"),
    ("[random]\ndraws = 2\n[random.values]\na = {low = 0.0, high = 1.0, log = true}", "which must be above 0."),
    ("seeds = 1000000\nseeds-per-trial = 1", "The plan makes 1,000,000 trials; 100,000 is the most."),
]


@pytest.mark.parametrize(("text", "sentence"), REFUSED)
def test_what_is_no_plan_is_refused_in_a_sentence(text, sentence):
    with pytest.raises(InvalidConfig) as refused:
        planned(text)
    assert sentence in str(refused.value)


def test_a_plan_needs_an_agent():
    with pytest.raises(InvalidConfig, match="agent is missing in the plan"):
        plan_of({})


def test_a_file_that_is_no_plan(tmp_path):
    path = tmp_path / "plan.toml"
    with pytest.raises(BadFile, match="cannot be read"):
        read_plan(path)
    path.write_bytes(b"\xff\x00")
    with pytest.raises(BadFile, match="/dev/full cannot be read: it is no file"):
        read_plan(Path("/dev/full"))
    with pytest.raises(BadFile, match="is no TOML file"):
        read_plan(path)


def test_nothing_varied_is_one_configuration():
    assert configurations(plan_of(tomllib.loads(START))) == [()]
    assert label((), "q-learning") == "q-learning"
