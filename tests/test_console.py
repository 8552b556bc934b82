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
