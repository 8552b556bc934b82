import json
import math
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from fake_comparison import GATES, SETTINGS
from fake_study import make_study
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from page_parser import HOSTILE, Page
from PIL import Image

from lodestone.errors import CannotWrite
from lodestone.experiments.study import NumberTable, Panel, Series, Study
from lodestone.report.curves import panel_svg
from lodestone.report.palette import AGENTS
from lodestone.report.results import results_json
from lodestone.report.statistics import interquartile_mean
from lodestone.report.studies import (
    draw_study,
    draw_study_panel,
    goes_beyond,
    looks,
    name_references,
    save_study,
    series_curve,
    series_end,
    study_json,
    svg_of,
    write_study_report,
)

X = np.arange(1.0, 1001.0)


def one_panel(**changes: object) -> Panel:
    return replace(make_study(50).panels[0], **changes)


def drawn(panel: Panel) -> Axes:
    """The axes of one panel, as a figure has them."""
    axes = Figure().subplots()
    curves = [series_curve(series, panel.log_x) for series in panel.series]
    draw_study_panel(axes, panel, curves, looks(replace(make_study(5), panels=(panel,)))[0])
    name_references(axes, panel, curves)
    return axes


def page_of(study: Study, path: Path) -> tuple[str, Page]:
    write_study_report(study, SETTINGS, path)
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert page.open == []
    return text, page


@pytest.mark.parametrize("log_x", [False, True])
def test_a_curve_is_thinned_not_altered(log_x: bool) -> None:
    seeds = np.random.default_rng(0).normal(size=(5, 1000))
    curve = series_curve(Series("a", X, seeds), log_x)
    assert (curve.x[0], curve.x[-1]) == (1.0, 1000.0)
    assert 50 <= len(curve.x) <= 160
    assert (np.diff(curve.x) > 0).all()
    np.testing.assert_array_equal(curve.seeds, seeds[:, curve.x.astype(int) - 1])
    np.testing.assert_array_equal(curve.iqm, interquartile_mean(seeds)[curve.x.astype(int) - 1])


def test_a_logarithmic_axis_has_no_zero() -> None:
    series = Series("a", np.array([0.0, 1.0, 10.0]), np.ones((2, 3)))
    assert series_curve(series, log_x=True).x.tolist() == [1.0, 10.0]
    assert series_curve(series).x.tolist() == [0.0, 1.0, 10.0]


def test_a_curve_begins_where_every_seed_has_a_number() -> None:
    seeds = np.array([[np.nan, np.nan, 1.0, 2.0], [np.nan, 3.0, 3.0, 4.0]])
    curve = series_curve(Series("a", np.arange(4.0), seeds))
    np.testing.assert_array_equal(curve.iqm, [np.nan, np.nan, 2.0, 3.0])


def test_the_end_is_the_last_x_with_all_seeds() -> None:
    seeds = np.array([[1.0, 2.0, np.nan], [1.0, 6.0, 7.0]])
    assert series_end(Series("a", np.arange(3.0), seeds)) == (1.0, 4.0, 2.0, 6.0)
    assert series_end(Series("a", np.arange(3.0), seeds * np.nan)) is None
    never = series_end(Series("a", np.arange(3.0), np.full((4, 3), -np.inf)))
    assert never is not None
    assert (never.x, never.iqm) == (2.0, -math.inf)


def test_what_lies_beyond_is_drawn_at_the_edge() -> None:
    seeds = np.tile(np.where(X < 300, -np.inf, np.where(X < 600, -500.0, 5.0)), (4, 1))
    panel = one_panel(series=(Series("a", X, seeds),), y_range=(-60.0, 12.0))
    axes = drawn(panel)
    for line in axes.lines[:5]:  # four seeds and their mean
        heights = np.asarray(line.get_ydata())
        assert set(heights) == {-60.0, 5.0}
    low, high = axes.get_ylim()
    assert -65 < low < -60 < 12 < high < 15
    assert goes_beyond(panel)
    everything = replace(panel, y_range=None)
    assert min(np.asarray(drawn(everything).lines[0].get_ydata())) == -500.0
    assert goes_beyond(everything)
    assert not goes_beyond(replace(everything, series=(Series("a", X, np.ones((4, 1000))),)))


def test_nothing_finite_is_drawn_without_a_warning() -> None:
    for value in (-np.inf, np.nan):
        panel = one_panel(series=(Series("a", X, np.full((4, 1000), value)),), y_range=None)
        assert drawn(panel).lines
    nowhere = Series("a", np.zeros(3), np.ones((4, 3)))
    assert drawn(one_panel(series=(nowhere,), log_x=True)).lines


def test_references_are_named_beside_one_another() -> None:
    """Also those so close that their names would meet; those outside of the range are left out."""
    close = tuple((f"the reference {number}", 7.0 + 0.2 * number) for number in range(4))
    panel = one_panel(references=(*close, ("far below", -1000.0), ("unknown", math.nan)))
    axes = drawn(panel)
    assert [text.get_text() for text in axes.texts] == [name for name, _ in close]
    boxes = [text.get_window_extent() for text in axes.texts]
    assert not any(one.overlaps(other) for number, one in enumerate(boxes) for other in boxes[:number])


def test_a_name_keeps_clear_of_the_curve() -> None:
    """A curve just above the line: under it. One on either side of its left half: to the right."""
    seeds = np.tile(np.where(X < 600, 7.0, -50.0), (2, 1))
    panel = one_panel(series=(Series("a", X, seeds),), references=(("optimum", 5.0),))
    (text,) = drawn(panel).texts
    assert (text.get_ha(), text.get_va()) == ("left", "top")
    crowded = Series("b", X, np.tile(np.where(X < 600, 3.0, -50.0), (2, 1)))
    (text,) = drawn(replace(panel, series=(*panel.series, crowded))).texts
    assert text.get_ha() == "right"


def test_the_same_name_has_the_same_colour() -> None:
    study = make_study(5)
    first, second = study.panels
    swapped = replace(second, series=second.series[::-1])
    one, other = looks(replace(study, panels=(first, swapped)))
    assert [look.colour for look in one] == list(AGENTS[:3])
    assert one == other[::-1]


def test_more_series_than_colours_differ() -> None:
    names = [f"learner {number}" for number in range(8)]
    panel = one_panel(series=tuple(Series(name, X, np.ones((2, 1000))) for name in names))
    (found,) = looks(replace(make_study(5), panels=(panel,)))
    assert len(set(found)) == 8
    assert [look.dotted for look in found] == [False] * 6 + [True] * 2


@pytest.mark.parametrize("panels", [1, 2, 3, 4, 5])
def test_the_figure_is_written(panels: int, tmp_path: Path) -> None:
    study = make_study(30)
    draw_study(replace(study, panels=(study.panels * 3)[:panels]), tmp_path / "new" / "a.png")
    with Image.open(tmp_path / "new" / "a.png") as picture:
        assert min(picture.size) > 700


def test_one_legend_if_all_panels_show_the_same(tmp_path: Path) -> None:
    study = make_study(30)
    first, second = study.panels
    for panels, legends in ((study.panels, 1), ((first, replace(second, series=second.series[:2])), 2)):
        draw_study(replace(study, panels=panels), tmp_path / "a.svg")
        ElementTree.parse(tmp_path / "a.svg")
        assert (tmp_path / "a.svg").read_text().count("MAXQ-Q, whole states</text>") == legends
        text, _ = page_of(replace(study, panels=panels), tmp_path / "a.html")
        assert text.count('<ul class="legend">') == legends


def test_what_a_page_shows(tmp_path: Path) -> None:
    study = make_study(60)
    text, page = page_of(study, tmp_path / "report.html")
    shown = " ".join(page.texts)
    for expected in ("2 of 4", "6 min 53 s", "Task graphs against flat learning.", "14,000", "∞", "dqn.learning_rate"):
        assert expected in shown
    assert page.tags.count("svg") == 2 + 1
    for panel in study.panels:
        assert shown.count(panel.title) >= 2
        for series in panel.series:
            end = series_end(series)
            assert end is not None
            assert f"{end.iqm:.3g} " in shown
    assert "http:" not in text
    assert "<?xml" not in text
    ids = page.values("id")
    assert len(ids) == len(set(ids))
    references = page.values("xlink:href") + re.findall(r"url\(([^)]*)\)", text)
    assert {reference[1:] for reference in references} <= set(ids)


def test_charts_and_machines_follow_the_page(tmp_path: Path) -> None:
    text, _ = page_of(make_study(60), tmp_path / "report.html")
    figures = "".join(re.findall(r"<figure>.*?</figure>", text, flags=re.DOTALL))
    assert not re.findall(r"#(?:[0-9a-f]{6}|[0-9a-f]{3})\b", figures)
    assert 'stroke="var(--ink)"' in figures


def test_hostile_names_are_text(tmp_path: Path) -> None:
    study = make_study(20)
    panels = tuple(
        replace(
            panel,
            title=HOSTILE,
            x_label=HOSTILE,
            y_label=HOSTILE,
            series=tuple(replace(series, name=HOSTILE) for series in panel.series[:1]),
            references=((HOSTILE, 7.0),),
        )
        for panel in study.panels
    )
    table = NumberTable(HOSTILE, (HOSTILE,), ((HOSTILE,),))
    machines = (replace(study.machines[0], title=HOSTILE),)
    hostile = replace(
        study, name="a", title=HOSTILE, summary=HOSTILE, panels=panels, tables=(table,), machines=machines
    )
    _, page = page_of(hostile, tmp_path / "report.html")
    assert page.tags.count("script") == 1  # the page's own
    assert page.tags.count("img") == 0
    assert not page.values("onerror")
    assert sum(HOSTILE in text for text in page.texts) >= 8


def test_a_column_of_numbers_stands_right_even_with_words(tmp_path: Path) -> None:
    table = NumberTable("t", ("who", "how many"), (("a", 3), ("b", "none")))
    text, _ = page_of(replace(make_study(5), tables=(table,)), tmp_path / "report.html")
    assert '<td class="number">3</td>' in text
    assert '<td class="number">none</td>' in text
    assert '<th scope="row">a</th>' in text


def test_results_are_json() -> None:
    study = make_study(60)
    never = Series("never", X, np.full((3, 1000), -np.inf))
    unknown = Series("unknown", X, np.full((3, 1000), np.nan))
    panel = replace(study.panels[0], series=(*study.panels[0].series, never, unknown))
    found = json.loads(json.dumps(study_json(replace(study, panels=(panel,)), SETTINGS), allow_nan=False))
    assert found["gates"] == results_json([], GATES, {})["gates"]
    assert found["gates"][0] == {"name": GATES[0].name, "measured": 13.0, "required": "<= 13", "passed": True}
    assert found["tables"][0]["rows"][1] == ["MAXQ-Q, whole states", 14000, None, "task graph"]
    assert found["panels"][0]["references"][0] == {"name": "optimum 7.93", "value": 7.93}
    ends = {series["name"]: series["end"] for series in found["panels"][0]["series"]}
    assert ends["never"] == {"x": 1000.0, "iqm": None, "low": None, "high": None}
    assert ends["unknown"] is None
    end = ends["Q-learning, flat"]
    assert end["x"] == 5000.0
    assert end["low"] < end["iqm"] < end["high"]
    assert (found["name"], found["seeds"], found["settings"]["seconds"]) == ("fake", 20, 412.7)


def test_a_study_is_saved(tmp_path: Path) -> None:
    study = make_study(30)
    files = save_study(tmp_path / "out", study, SETTINGS)
    assert files == ["fake.png", "fake-1.svg", "results.json", "report.html"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(files)
    assert (tmp_path / "out" / "fake-1.svg").read_text() == svg_of(study.machines[0])
    assert json.loads((tmp_path / "out" / "results.json").read_text()) == study_json(study, SETTINGS)
    assert "An invented study" in (tmp_path / "out" / "report.html").read_text()


def test_a_study_of_numbers_only_is_saved(tmp_path: Path) -> None:
    study = replace(make_study(5), panels=(), machines=(), gates=())
    assert save_study(tmp_path, study, {}) == ["results.json", "report.html"]
    page = Page((tmp_path / "report.html").read_text())
    assert page.open == []
    assert not {"Gates", "Curves", "Machines", "Settings"} & set(page.texts)


def test_a_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(CannotWrite):
        save_study(tmp_path / "file", make_study(5), {})
    assert (tmp_path / "file").read_text() == "mine"


def test_few_points_are_marked() -> None:
    few = one_panel(series=(Series("a", X[:3], np.ones((2, 3))),))
    many = one_panel(series=(Series("a", X, np.ones((2, 1000))),))
    assert drawn(few).lines[2].get_marker() == "o"
    assert drawn(many).lines[2].get_marker() == "None"


def test_names_are_drawn_as_they_are() -> None:
    """Dollar signs would enclose a formula."""
    panel = one_panel(x_label="$\\frac{$ <b>", references=(("$\\frac{$ <b>", 3.0),))

    def draw(axes: Axes) -> None:
        curves = [series_curve(series) for series in panel.series]
        draw_study_panel(axes, panel, curves, looks(replace(make_study(5), panels=(panel,)))[0])
        name_references(axes, panel, curves)

    assert panel_svg(draw).count(">$\\frac{$ &lt;b&gt;</text>") == 2
