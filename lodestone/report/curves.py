"""Learning curves and option usage, as figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Num
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from lodestone.experiments.comparison import AgentRun, Comparison
from lodestone.files import write_atomically
from lodestone.learning.history import Episodes, Usage, running_mean
from lodestone.report.palette import GRID, INK, MUTED, PAPER, agent_colours, option_colours
from lodestone.report.statistics import estimate

WINDOW = 30
"""Episodes in a running mean; the authors smooth so."""
POINTS = 160
"""x values of a curve, and at most so many of a usage diagram."""

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "text.color": INK,
    "text.parse_math": False,  # a dollar sign in a name is a dollar sign
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "savefig.dpi": 200,
    "svg.fonttype": "none",
    "svg.hashsalt": "lodestone",
}


# ---------------------------------------------------------------------------------------------------------- numbers


class Curve(NamedTuple):
    """One quantity of one agent during training: S seeds, X common x values."""

    x: Float[np.ndarray, " X"]
    seeds: Float[np.ndarray, "S X"]
    """Not a number before a seed's first episode has ended."""
    iqm: Float[np.ndarray, " X"]
    low: Float[np.ndarray, " X"]
    high: Float[np.ndarray, " X"]


class Axis(NamedTuple):
    """What the x axis of a panel counts."""

    label: str
    of: Callable[[Episodes], Num[np.ndarray, " E"]]


class Quantity(NamedTuple):
    """What the y axis of a panel shows."""

    label: str
    of: Callable[[Episodes], Num[np.ndarray, " E"]]


DECISIONS = Axis("decisions", lambda episodes: episodes.decisions)
STEPS = Axis("primitive steps", lambda episodes: episodes.steps)
RETURN = Quantity("episode return", lambda episodes: episodes.total_reward)
LENGTH = Quantity("episode length (decisions)", lambda episodes: episodes.length_decisions)
"""As the paper counts: an option is one action."""


def smooth(values: Num[np.ndarray, " E"], window: int = WINDOW) -> Float[np.ndarray, " E"]:
    """Mean of the last `window` values; before there are so many, of all values so far.

    Early episodes are the longest: the first thirty of a slow learner can be a fifth of its training, which a curve
    that waits for a whole window would not show.
    """
    first = np.cumsum(values[: window - 1]) / np.arange(1, min(window, len(values) + 1))
    return np.concatenate([first, running_mean(values, window)[window - 1 :]])


def at(
    x: Num[np.ndarray, " E"], values: Num[np.ndarray, " E"], grid: Float[np.ndarray, " X"]
) -> Float[np.ndarray, " X"]:
    """The last value known at each grid point, never a later one; not a number where there is none yet."""
    return np.insert(values.astype(np.float64), 0, np.nan)[np.searchsorted(x, grid, side="right")]


def learning_curve(episodes: Sequence[Episodes], axis: Axis, quantity: Quantity) -> Curve:
    """The smoothed quantity of every seed on common x values, up to where the first seed's episodes end.

    The interquartile mean begins where every seed has finished an episode. Without an episode of every seed the curve
    is not a number throughout.
    """
    xs = [axis.of(each) for each in episodes]
    grid = np.linspace(0.0, min(x[-1] if len(x) else 0 for x in xs), POINTS)
    seeds = np.stack([at(x, smooth(quantity.of(each)), grid) for x, each in zip(xs, episodes, strict=True)])
    return Curve(grid, seeds, *estimate(seeds))


def usage_shares(
    usage: Sequence[Usage],
) -> tuple[Float[np.ndarray, " X"], Float[np.ndarray, "X O"]]:
    """(decisions so far, share of the decisions that went to each option since the last point), means over the seeds.

    Neighbouring chunks are put together until at most `POINTS` are left.
    """
    groups = np.array_split(np.arange(len(usage)), min(len(usage), POINTS))
    decisions, shares = [], []
    for group in groups:
        calls = sum(usage[index].calls for index in group)
        total = calls.sum(axis=1, keepdims=True)
        decided = total[:, 0] > 0
        if decided.any():
            decisions.append(usage[group[-1]].decisions.mean())
            shares.append((calls[decided] / total[decided]).mean(axis=0))
    return np.array(decisions), np.array(shares)


# ---------------------------------------------------------------------------------------------------------- panels


def has_options(agent: AgentRun) -> bool:
    """Whether the agent chooses from more than primitive actions."""
    return len(agent.option_names) > agent.primitives


def draw_curve(axes: Axes, curve: Curve, colour: str, **of_mean: Any) -> None:
    """Thin lines for single seeds, a band, and the interquartile mean, which takes further settings of a line."""
    axes.plot(curve.x, curve.seeds.T, color=colour, linewidth=0.5, alpha=0.3)
    axes.fill_between(curve.x, curve.low, curve.high, color=colour, alpha=0.2, linewidth=0)
    axes.plot(curve.x, curve.iqm, color=colour, linewidth=1.8, **of_mean)


def draw_panel(axes: Axes, comparison: Comparison, axis: Axis, quantity: Quantity) -> None:
    """Every agent's interquartile mean with its band, every seed as a thin line, and the exact optimum."""
    for agent, colour in zip(comparison.agents, agent_colours(len(comparison.agents)), strict=True):
        curve = learning_curve(agent.episodes, axis, quantity)
        draw_curve(axes, curve, colour, label=agent.name)
    if quantity is LENGTH:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    for value, label, below in _optima(comparison, quantity):
        axes.axhline(value, color=INK, linewidth=1.1, linestyle=(0, (4, 2.5)))
        axes.annotate(
            label,
            (0.0, value),  # on the left, where learning curves are still far from the optimum
            (4, -3 if below else 3),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            ha="left",
            va="top" if below else "bottom",
            fontsize=8,
            zorder=1.5,  # above the grid, under the curves
            bbox={"facecolor": PAPER, "alpha": 0.7, "edgecolor": "none", "pad": 1},
        )
    axes.margins(y=0.09)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.xaxis.set_major_formatter(FuncFormatter(thousands))
    axes.set_xlabel(axis.label)
    axes.set_ylabel(quantity.label)


def _optima(comparison: Comparison, quantity: Quantity) -> list[tuple[float, str, bool]]:
    """(value, label, label below the line) of the exact optima that belong to a quantity."""
    if quantity is RETURN:
        return [(comparison.optimal_return, f"optimum {comparison.optimal_return:g}", False)]
    steps, decisions = comparison.optimal_steps, comparison.optimal_decisions
    with_options = [has_options(agent) for agent in comparison.agents]
    optima = []
    if not all(with_options):
        optima.append((steps, f"optimum {steps:g} (primitive actions)", False))
    if any(with_options):
        optima.append((decisions, f"optimum {decisions:g} (with options)", True))
    return optima


def thousands(value: float, _: int) -> str:
    """The tick label of a count."""
    return f"{value / 1000:g}k" if abs(value) >= 1000 else f"{value:g}"


def draw_usage_panel(axes: Axes, agent: AgentRun, colours: Sequence[str]) -> None:
    """Share of the agent's decisions that went to each option, stacked."""
    decisions, shares = usage_shares(agent.usage)
    from_zero = np.insert(decisions, 0, 0.0)
    shares = np.concatenate([shares[:1], shares])  # a share belongs to the time before its point
    axes.stackplot(from_zero, shares.T, labels=agent.option_names, colors=colours, linewidth=0, step="pre")
    axes.set_xlim(0, decisions[-1])
    axes.set_ylim(0, 1)
    axes.grid(False)
    axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.xaxis.set_major_formatter(FuncFormatter(thousands))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0%}"))
    axes.set_xlabel(DECISIONS.label)
    axes.set_ylabel("share of decisions")


def agent_option_colours(agent: AgentRun) -> tuple[str, ...]:
    """One colour per option of the agent, primitive actions in slate."""
    return option_colours(agent.option_names, agent.option_names[: agent.primitives])


# ---------------------------------------------------------------------------------------------------------- figures


def draw_learning_curves(comparison: Comparison, path: str | Path) -> None:
    """Write a figure of 2 x 2 panels: return and episode length, over decisions and over primitive steps.

    The format follows from the ending of `path`. Raises `CannotWrite`.
    """
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.6, 6.6), layout="constrained")
        panels = figure.subplots(2, 2, sharey="row", sharex="col")
        for row, quantity in zip(panels, (RETURN, LENGTH), strict=True):
            for axes, axis in zip(row, (DECISIONS, STEPS), strict=True):
                draw_panel(axes, comparison, axis, quantity)
                axes.label_outer()
        handles, labels = panels[0, 0].get_legend_handles_labels()
        seeds = max(len(agent.seeds) for agent in comparison.agents)
        figure.legend(
            handles,
            labels,
            loc="outside upper left",
            ncols=3,
            title=comparison.title,
            title_fontproperties={"size": 12, "weight": "bold"},
            alignment="left",
        )
        figure.supxlabel(
            f"Lines: interquartile mean over {seeds} seeds; bands: 95 % bootstrap interval; thin lines: single seeds. "
            f"Running mean of {WINDOW} episodes.",
            x=0.01,
            ha="left",
            fontsize=8,
            color=MUTED,
        )
        save_figure(figure, path)


def draw_option_usage(comparison: Comparison, path: str | Path) -> None:
    """Write a figure with one panel per agent: share of its decisions per option over training, mean over seeds.

    The format follows from the ending of `path`. Raises `CannotWrite`.
    """
    agents = comparison.agents
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.6, 0.8 + 2.5 * len(agents)), layout="constrained")
        for axes, agent in zip(figure.subplots(len(agents), squeeze=False)[:, 0], agents, strict=True):
            draw_usage_panel(axes, agent, agent_option_colours(agent))
            axes.set_title(agent.name)
            handles, labels = axes.get_legend_handles_labels()
            # In the order of the areas, seen from above.
            axes.legend(handles[::-1], labels[::-1], loc="center left", bbox_to_anchor=(1.01, 0.5))
        figure.suptitle(f"{comparison.title}: options used", x=0.01, ha="left", fontsize=12, fontweight="bold")
        save_figure(figure, path)


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure in the format of the path's ending. Raises `CannotWrite`."""
    path = Path(path)
    content = BytesIO()
    figure.savefig(content, format=path.suffix.removeprefix(".") or "png")
    write_atomically(path, content.getvalue())


def panel_svg(draw: Callable[[Axes], None], width: float = 4.5, height: float = 2.9) -> str:
    """An SVG element of one panel, in inches, that `draw` fills; its background is transparent."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width, height))
        # Fixed margins rather than a computed layout: panels under one another line up.
        draw(figure.subplots(gridspec_kw={"left": 0.16, "right": 0.955, "bottom": 0.155, "top": 0.97}))
        content = BytesIO()
        figure.savefig(
            content, format="svg", transparent=True, metadata=dict.fromkeys(("Creator", "Date", "Format", "Type"))
        )
    svg = content.getvalue().decode()
    return svg[svg.index("<svg") :]
