import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_comparison import GATES, OPTIONS, SETTINGS, make_comparison, make_playback
from page_parser import HOSTILE, Page

from lodestone.experiments.comparison import Comparison, Gate
from lodestone.report.html import write_player, write_report
from lodestone.report.results import agent_rows
from lodestone.report.stopping import on_arrival


def report(path: Path, comparisons: list[Comparison], gates: tuple[Gate, ...] = GATES) -> tuple[str, Page]:
    write_report(comparisons, gates, SETTINGS, path)
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert page.open == []
    return text, page


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, Page]:
    path = tmp_path_factory.mktemp("report") / "report.html"
    comparisons = [make_comparison("figure-2", seeds=10), make_comparison("figure-3", seeds=10)]
    return path, *report(path, comparisons)


def test_two_figures_of_ten_seeds_are_small(written: tuple[Path, str, Page]) -> None:
    path, _, page = written
    assert path.stat().st_size < 5_000_000
    assert page.tags.count("svg") == 2 * (4 + 2)
    assert list(path.parent.iterdir()) == [path]


def test_the_file_asks_for_nothing_else(written: tuple[Path, str, Page]) -> None:
    _, text, page = written
    assert "http:" not in text
    assert "https:" not in text
    assert "@import" not in text
    for name in ("src", "href", "xlink:href", "srcset", "data", "action"):
        assert all(value.startswith(("data:", "#")) for value in page.values(name)), name
    assert all(target.startswith("#") for target in re.findall(r"url\(([^)]*)\)", text))


def test_ids_are_unique_and_references_meet_them(written: tuple[Path, str, Page]) -> None:
    _, text, page = written
    ids = page.values("id")
    assert len(ids) == len(set(ids))
    references = page.values("xlink:href") + re.findall(r"url\(([^)]*)\)", text)
    assert references
    assert {reference[1:] for reference in references} <= set(ids)


def test_what_is_shown(written: tuple[Path, str, Page]) -> None:
    _, text, page = written
    shown = " ".join(page.texts)
    for expected in (
        "lodestone reproduce --seeds 6 --out report",
        "6 min 53 s",
        "2 of 4",
        "96.7%",
        "dqn.learning_rate",
    ):
        assert expected in shown
    assert text.count('class="badge passed"') == 2
    assert text.count('class="badge failed"') == 2
    comparison = make_comparison("figure-2", seeds=10)
    for agent in comparison.agents:
        for row in agent_rows(agent, comparison.thresholds):
            assert row.label in shown
            if row.unit == "decisions" and row.label.startswith("Mean return"):
                assert f"{row.summary.iqm:,.0f} " in shown


def test_the_player_has_the_whole_episode(written: tuple[Path, str, Page]) -> None:
    _, _, page = written
    data = json.loads(page.scripts[0])
    playback = make_playback()
    steps = len(playback.option)
    assert len(data["frame"]) == steps + 1
    assert max(data["frame"]) + 1 == len(data["frames"])
    assert data["option"] == playback.option.tolist()
    assert data["reward"] == playback.total_reward.tolist()
    np.testing.assert_allclose(data["values"], playback.values, atol=1e-3)
    assert len(data["colours"]) == len(data["textColours"]) == len(playback.option_names)
    assert page.values("max") == [str(steps)] * 2


def test_equal_pictures_are_stored_once_and_missing_values_are_null(tmp_path: Path) -> None:
    playback = make_playback()
    values = playback.values.copy()
    values[0, :3] = np.nan, -np.inf, np.inf
    still = replace(playback, pictures=np.repeat(playback.pictures[:1], len(playback.pictures), axis=0), values=values)
    comparison = replace(make_comparison(seeds=2, budget=3000), playback=still)
    _, page = report(tmp_path / "report.html", [comparison], gates=())
    data = json.loads(page.scripts[0], parse_constant=lambda name: pytest.fail(name))
    assert len(data["frames"]) == 1
    assert data["values"][0][:3] == [None] * 3


def test_terminations_stand_beside_the_values(tmp_path: Path) -> None:
    playback = make_playback()
    write_player(playback, tmp_path / "player.html")
    page = Page((tmp_path / "player.html").read_text(encoding="utf-8"))
    data = json.loads(page.scripts[0])
    expected = [[None if np.isnan(beta) else round(beta, 3) for beta in row] for row in playback.termination.tolist()]
    assert data["termination"] == expected
    assert data["termination"][1][OPTIONS.index("go-down")] is None
    assert data["hasSay"] == [False] * 6 + [True] * 2
    assert data["onArrival"] == [on_arrival(playback, step) for step in range(len(playback.option))]
    assert "player stopping" in page.values("class")
    assert {"Q(s, option)", "β(s)"} <= set(page.texts)


@pytest.mark.parametrize("everywhere", [np.nan, 1.0])
def test_no_terminations_are_shown_where_they_have_no_say(everywhere: float, tmp_path: Path) -> None:
    playback = make_playback()
    silent = replace(playback, termination=np.full_like(playback.termination, everywhere))
    write_player(silent, tmp_path / "player.html")
    page = Page((tmp_path / "player.html").read_text(encoding="utf-8"))
    data = json.loads(page.scripts[0])
    assert data["termination"] is None
    assert set(data["onArrival"]) == {""}
    assert "player" in page.values("class")
    assert not any("β" in text for text in page.texts)
    assert "Q(s, option)" in page.texts


def test_hostile_names_are_text(tmp_path: Path) -> None:
    comparison = make_comparison(seeds=2, budget=3000)
    agents = tuple(
        replace(agent, name=HOSTILE, option_names=(HOSTILE,) * len(agent.option_names)) for agent in comparison.agents
    )
    playback = replace(
        comparison.playback,
        agent=HOSTILE,
        option_names=(HOSTILE,) * len(comparison.playback.option_names),
        action_names=(HOSTILE,) * len(comparison.playback.action_names),
    )
    options = tuple(replace(option, name=HOSTILE) for option in comparison.options)
    hostile = replace(comparison, name=HOSTILE, title=HOSTILE, agents=agents, playback=playback, options=options)
    path = tmp_path / "report.html"
    write_report([hostile], (Gate(HOSTILE, 1.0, HOSTILE, True),), {"command": HOSTILE, HOSTILE: HOSTILE}, path)
    page = Page(path.read_text(encoding="utf-8"))
    assert page.open == []
    assert page.tags.count("script") == 2  # the player's data and the player
    assert page.tags.count("img") == 1
    assert not page.values("onerror")
    assert json.loads(page.scripts[0])["options"][0] == HOSTILE
    assert any(HOSTILE in text for text in page.texts)


def test_a_run_without_options_gates_or_settings(tmp_path: Path) -> None:
    comparison = make_comparison(seeds=2, budget=3000)
    flat = replace(comparison, agents=comparison.agents[:1], options=(), playback=None)
    nothing = replace(flat, name="figure-3", agents=())
    path = tmp_path / "report.html"
    write_report([flat, nothing], (), {}, path)
    page = Page(path.read_text(encoding="utf-8"))
    assert page.open == []
    assert not {"Gates", "Settings", "Pretraining of the options"} & set(page.texts)


def test_a_player_alone(tmp_path: Path) -> None:
    write_player(replace(make_playback(), agent=HOSTILE), tmp_path / "player.html")
    page = Page((tmp_path / "player.html").read_text(encoding="utf-8"))
    assert page.open == []
    assert page.tags.count("script") == 2
    assert f"{HOSTILE}, seed 0" in page.texts  # the title
