from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from fake_comparison import make_comparison, make_episodes
from matplotlib.axes import Axes
from PIL import Image

from lodestone.learning.history import Episodes, Usage
from lodestone.report.curves import (
    DECISIONS,
    LENGTH,
    RETURN,
    STEPS,
    at,
    draw_learning_curves,
    draw_option_usage,
    draw_panel,
    learning_curve,
    panel_svg,
    smooth,
    usage_shares,
)
from lodestone.report.statistics import interquartile_mean

NO_EPISODES = Episodes(*(np.zeros(0, dtype=np.int64) for _ in Episodes._fields))


@pytest.mark.parametrize("count", [0, 1, 5, 29, 30, 31, 100])
def test_smooth_is_the_mean_of_the_last_window(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    expected = [values[max(end - 30, 0) : end].mean() for end in range(1, count + 1)]
    np.testing.assert_allclose(smooth(values), expected, rtol=1e-9, atol=1e-12)


def test_at_gives_the_last_known_value() -> None:
    grid = np.array([0.0, 2.9, 3.0, 4.0, 7.0, 100.0])
    np.testing.assert_array_equal(at(np.array([3, 7]), np.array([10, 20]), grid), [np.nan, np.nan, 10, 10, 20, 20])


def test_a_curve_does_not_look_into_the_future() -> None:
    """Changing what happened after some x changes nothing up to there."""
    rng = np.random.default_rng(2)
    episodes = [make_episodes(rng, 13, 0.4, 1.6, 5000) for _ in range(3)]
    half = 2500
    changed = [each._replace(total_reward=np.where(each.decisions > half, 1e6, each.total_reward)) for each in episodes]
    before, after = (learning_curve(each, DECISIONS, RETURN) for each in (episodes, changed))
    early = before.x <= half
    np.testing.assert_array_equal(before.seeds[:, early], after.seeds[:, early])
    assert (after.seeds[:, -1] > 1e5).all()


@pytest.mark.parametrize("axis", [DECISIONS, STEPS])
def test_curve_of_constant_seeds(axis: object) -> None:
    def constant(value: float, decisions: int) -> Episodes:
        count = np.arange(1, 101)
        one = np.ones(100, dtype=np.int64)
        return Episodes(decisions * count, 3 * decisions * count, value * one, 3 * one, one, one > 0)

    curve = learning_curve([constant(1.0, 10), constant(2.0, 12), constant(6.0, 15)], axis, RETURN)  # type: ignore[arg-type]
    assert curve.x[-1] == (1000 if axis is DECISIONS else 3000)  # where the first seed ends
    started = curve.x >= (15 if axis is DECISIONS else 45)
    np.testing.assert_allclose(curve.iqm[started], 3.0)
    assert np.isnan(curve.iqm[~started]).all()
    np.testing.assert_allclose(curve.low[started], 1.0)
    np.testing.assert_allclose(curve.high[started], 6.0)


def test_curve_is_the_interquartile_mean_of_its_seeds() -> None:
    agent = make_comparison(seeds=6, budget=8000).agents[1]
    curve = learning_curve(agent.episodes, STEPS, LENGTH)
    np.testing.assert_array_equal(curve.iqm, interquartile_mean(curve.seeds))
    known = ~np.isnan(curve.iqm)
    assert (curve.low[known] <= curve.iqm[known]).all()
    assert (curve.iqm[known] <= curve.high[known]).all()


def test_usage_shares_are_means_over_seeds() -> None:
    def chunk(decisions: int, calls: list[list[int]]) -> Usage:
        return Usage(np.array([decisions, decisions]), np.array(calls), np.array(calls), np.zeros(2), 1.0)

    decisions, shares = usage_shares(
        [chunk(4, [[4, 0], [1, 3]]), chunk(8, [[0, 4], [0, 4]]), chunk(8, [[0, 0], [0, 0]])]
    )
    np.testing.assert_array_equal(decisions, [4, 8])
    np.testing.assert_allclose(shares, [[0.625, 0.375], [0.0, 1.0]])


def test_many_chunks_become_few_points_that_lose_no_decision() -> None:
    calls = np.random.default_rng(0).integers(1, 9, size=(1000, 3, 4))
    taken = calls.sum(axis=2).cumsum(axis=0)
    usage = [Usage(taken[index], calls[index], calls[index], np.zeros(3), 1.0) for index in range(1000)]
    decisions, shares = usage_shares(usage)
    assert len(decisions) <= 160
    assert decisions[-1] == taken[-1].mean()
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)


def test_figures_are_written(tmp_path: Path) -> None:
    comparison = make_comparison(budget=8000)
    for draw in (draw_learning_curves, draw_option_usage):
        draw(comparison, tmp_path / "new" / "figure.png")
        with Image.open(tmp_path / "new" / "figure.png") as picture:
            assert min(picture.size) > 800
    draw_option_usage(comparison, tmp_path / "figure.svg")
    assert ElementTree.parse(tmp_path / "figure.svg").getroot().tag.endswith("svg")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["figure.svg", "new"]


def test_a_run_too_short_for_an_episode_is_drawn(tmp_path: Path) -> None:
    comparison = make_comparison(seeds=2, budget=3000)
    agents = tuple(replace(agent, episodes=(agent.episodes[0], NO_EPISODES)) for agent in comparison.agents)
    draw_learning_curves(replace(comparison, agents=agents), tmp_path / "figure.png")
    assert (tmp_path / "figure.png").exists()


def test_names_are_drawn_as_they_are() -> None:
    """Dollar signs would enclose a formula."""
    comparison = make_comparison(seeds=2, budget=3000)
    agents = tuple(replace(agent, name="$\\frac{$ <b>") for agent in comparison.agents)

    def draw(axes: Axes) -> None:
        draw_panel(axes, replace(comparison, agents=agents), DECISIONS, RETURN)
        axes.legend()

    assert panel_svg(draw).count(">$\\frac{$ &lt;b&gt;</text>") == 2
