from dataclasses import replace

import numpy as np
import pytest
from fake_comparison import GO_DOWN, LIFT, OPTIONS, make_playback
from rich.console import Console

from lodestone.agents.playing import Playback
from lodestone.report import terminal
from lodestone.report.stopping import on_arrival, with_a_say

ENDED = 5
"""The first step after the first call of lift."""


def without_terminations() -> Playback:
    return replace(make_playback(), termination=np.full_like(make_playback().termination, np.nan))


def lines(playback: Playback, capsys: pytest.CaptureFixture[str]) -> list[str]:
    terminal.show(playback, 0.0)
    return capsys.readouterr().out.splitlines()


def screens(playback: Playback, monkeypatch: pytest.MonkeyPatch) -> str:
    """What a terminal has been sent, all screens."""
    console = Console(force_terminal=True, width=120, height=100, record=True)
    monkeypatch.setattr(terminal, "Console", lambda: console)
    terminal.show(playback, 0.0)
    return console.export_text()


def test_options_that_always_stop_have_no_say() -> None:
    assert np.flatnonzero(with_a_say(make_playback())).tolist() == [GO_DOWN, LIFT]
    assert not with_a_say(without_terminations()).any()


def test_what_became_of_the_option_that_had_run() -> None:
    playback = make_playback()
    said = [on_arrival(playback, step) for step in range(ENDED + 2)]
    assert said == ["", *["β 0.03"] * 4, "lift had ended, β 0.98", ""]  # at last a primitive action had run


def test_an_option_may_end_though_it_would_go_on() -> None:
    """At its limit of steps, for one."""
    termination = make_playback().termination.copy()
    termination[ENDED, LIFT] = 0.02
    cut = replace(make_playback(), termination=termination)
    assert on_arrival(cut, ENDED) == "lift was stopped, β 0.02"
    termination[ENDED, LIFT] = np.nan
    assert on_arrival(cut, ENDED) == ""


def test_the_start_knows_of_no_option_before(capsys: pytest.CaptureFixture[str]) -> None:
    """Though lift runs last, too, and would be found before the first step by counting backwards."""
    playback = make_playback()
    last = replace(playback, option=np.full_like(playback.option, LIFT))
    assert on_arrival(last, 0) == ""
    assert lines(last, capsys)[0].startswith("step   1: lift begins, Q ")


def test_one_line_a_step_says_why_an_option_begins(capsys: pytest.CaptureFixture[str]) -> None:
    playback = make_playback()
    printed = lines(playback, capsys)
    assert len(printed) == len(playback.option)
    assert printed[1].startswith("step   2: lift goes on (β 0.03), Q ")
    assert printed[ENDED].startswith("step   6: right begins (lift had ended, β 0.98), Q ")
    assert printed[ENDED + 1].startswith("step   7: magnet-off begins, Q ")


def test_without_terminations_nothing_is_said(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    printed = lines(without_terminations(), capsys)
    assert printed[1].startswith("step   2: lift goes on, Q ")
    assert not any("β" in line for line in printed)
    assert "β" not in screens(without_terminations(), monkeypatch)


def test_the_table_has_a_column_of_terminations(monkeypatch: pytest.MonkeyPatch) -> None:
    playback = make_playback()
    two = replace(
        playback, option=playback.option[:2], chosen=playback.chosen[:2], pictures=playback.pictures[[0, 1, 1]]
    )
    rows = [line.split() for line in screens(two, monkeypatch).splitlines()]
    assert ["option", "Q", "β"] in rows
    final = rows[-len(OPTIONS) :]
    assert [row[0] for row in final] == list(OPTIONS)
    assert [row[2:] for row in final] == [["1.00"]] * 6 + [[], ["0.03"]]


def test_what_is_planned_is_shown(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    whole = make_playback()
    planning = replace(whole, ahead=tuple(f"up, a new plan ({step})" for step in range(len(whole.option))))
    printed = lines(planning, capsys)
    assert len(printed) == 2 * len(whole.option)
    assert printed[1].split() == ["then", "up,", "a", "new", "plan", "(0)"]
    assert "then up, a new plan (14)" in screens(planning, monkeypatch)
