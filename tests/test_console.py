"""The estimate of the time left."""

from __future__ import annotations

import pytest

from lodestone import console
from lodestone.console import ConsoleProgress


@pytest.fixture
def clock(monkeypatch):
    class Clock:
        now = 100.0

    monkeypatch.setattr(console, "monotonic", lambda: Clock.now)
    return Clock


def test_the_estimate_comes_from_work_that_was_done(clock, capsys):
    with ConsoleProgress(200.0) as progress:
        progress.begin("first", 100.0)
        clock.now += 10
        progress.advance(10.0, "half a job")
        progress.begin("second", 100.0)  # the first stage ended early: 90 units took no time
    lines = capsys.readouterr().err.strip().splitlines()
    assert [" ".join(line.split()) for line in lines] == [
        "0% first estimating compiling",
        "5% first about 3:10 left half a job",
        "50% second about 1:40 left compiling",
    ]


def test_work_of_another_process_says_nothing_about_the_speed(clock, capsys):
    with ConsoleProgress(200.0) as progress:
        progress.begin("first", 100.0)
        clock.now += 10
        progress.skip(60.0)
        progress.advance(70.0, "on it")
        progress.begin("second", 100.0)
    lines = capsys.readouterr().err.strip().splitlines()
    assert "about 2:10 left" in lines[1]  # 130 units, of which 10 took 10 seconds
    assert "about 1:40 left" in lines[2]
