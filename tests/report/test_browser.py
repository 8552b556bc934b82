"""Reports in a real browser: no script fails, nothing is wider than a phone, and the player plays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from browser import CHROMIUM, Browser, browser
from fake_comparison import make_playback
from fake_study import make_study
from page_parser import HOSTILE

from lodestone.report.html import write_player
from lodestone.report.studies import write_study_report

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs a browser: apt-get install chromium")

DESKTOP, PHONE = 1280, 390
"""Widths."""
LONG = "a_name_without_a_space_" * 8


@pytest.fixture(scope="module")
def chromium(tmp_path_factory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("browser")) as found:
        yield found


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    """A page with everything that a study can have, under names that are hard to place."""
    study = make_study(60)
    first, second = study.panels
    series = tuple(replace(one, name=name) for one, name in zip(first.series, (LONG, HOSTILE, "short"), strict=True))
    table = replace(study.tables[0], rows=(*study.tables[0].rows, (LONG, 1.0, 2.0, HOSTILE)))
    told = {"command": f"lodestone report {LONG}", "machine": "a machine", "seconds": 12.3, LONG: LONG}
    path = tmp_path_factory.mktemp("page") / "report.html"
    study = replace(
        study,
        title=f"A study of {LONG}",
        panels=(replace(first, series=series), second),
        tables=(table,),
        playbacks=(make_playback(), replace(make_playback(), agent=LONG)),
    )
    write_study_report(study, told, path)
    return path


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [DESKTOP, PHONE])
def test_nothing_is_wider_than_the_page(width, dark, report, chromium):
    chromium.open(report, width, dark=dark)
    assert chromium.value("document.documentElement.scrollWidth") == chromium.value("innerWidth") == width
    assert chromium.errors == []
    paper, ink = (chromium.value(f"getComputedStyle(document.body).{name}") for name in ("backgroundColor", "color"))
    assert (lightness(paper) < lightness(ink)) == dark
    assert abs(lightness(paper) - lightness(ink)) > 150


def lightness(colour: str) -> float:
    """Of rgb(...), to 255."""
    return sum(map(float, colour.removeprefix("rgb(").removesuffix(")").split(","))) / 3


def test_the_player_goes_where_it_is_sent(chromium, tmp_path):
    playback = make_playback()
    write_player(playback, tmp_path / "player.html")
    chromium.open(tmp_path / "player.html", PHONE)
    steps = len(playback.option)
    said, picture = "document.querySelector('.player output').textContent", "document.querySelector('.player img').src"
    assert chromium.value(said) == f"step 1 of {steps}"
    first = chromium.value(picture)
    chromium.value(
        "(s => { s.value = 3; s.dispatchEvent(new Event('input')); })(document.querySelector('.player input'))"
    )
    assert chromium.value(said) == f"step 4 of {steps}"
    assert chromium.value(picture) != first
    assert chromium.value("document.querySelector('.player .pill').textContent") == "lift"
    for key, expected in (
        ("ArrowRight", f"step 5 of {steps}"),
        ("End", f"end, {steps} steps"),
        ("Home", f"step 1 of {steps}"),
    ):
        chromium.value(
            f"document.querySelector('.player').dispatchEvent(new KeyboardEvent('keydown', {{key: '{key}'}}))"
        )
        assert chromium.value(said) == expected
    for _ in range(2):
        chromium.value("document.querySelector('.player .play').click()")
    assert chromium.value("document.querySelector('.player .play').textContent") == "Play"
    assert chromium.errors == []


FRAMES = """new Promise(done => {
  const slider = document.querySelector(".player input"), last = Number(slider.max), times = [];
  function frame(time) {
    times.push(time);
    slider.value = times.length % (last + 1);
    slider.dispatchEvent(new Event("input"));
    if (times.length < 61) requestAnimationFrame(frame);
    else done(60000 / (times[60] - times[0]));
  }
  requestAnimationFrame(frame);
})"""
"""Frames a second, each of which shows another step."""


@pytest.mark.slow
def test_the_player_holds_thirty_frames_a_second(report, chromium):
    chromium.open(report, DESKTOP)
    assert max(chromium.value(FRAMES) for _ in range(3)) > 30
