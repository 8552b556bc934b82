"""An experiment's findings as a figure, a page, JSON, and the folder that holds them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from html import escape
from itertools import pairwise
from pathlib import Path
from textwrap import fill
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from lodestone.experiments.study import LearnedMachines, NumberTable, Panel, Series, Study
from lodestone.files import json_safe, write_atomically, write_json
from lodestone.report.curves import POINTS, STYLE, Curve, draw_curve, panel_svg, save_figure, thousands
from lodestone.report.html import player
from lodestone.report.machine_picture import edge_counts, hierarchy_svg
from lodestone.report.page import (
    AGENT_COLOURS,
    DRAWING_COLOURS,
    PAGE_COLOURS,
    chart_figure,
    gates_section,
    header,
    interval_text,
    joined,
    number_text,
    settings_section,
    table_head,
    write_page,
)
from lodestone.report.palette import AGENTS, INK, MUTED, PAPER
from lodestone.report.statistics import estimate

FEW = 12
"""A curve of at most so many points is drawn with a mark at each."""

TITLE_WIDTH = 50
"""Characters of a panel's title that fit over it."""


# ---------------------------------------------------------------------------------------------------------- numbers


class End(NamedTuple):
    """A curve's interquartile mean and 95 % interval at the last x at which every seed has a number."""

    x: float
    iqm: float
    low: float
    high: float


def series_curve(series: Series, log_x: bool = False) -> Curve:
    """The estimate over seeds at no more x values than can be seen; on a logarithmic axis only where x is positive.

    As in every curve of ours it begins where all seeds have a number.
    """
    keep = np.flatnonzero(series.x > 0) if log_x else np.arange(len(series.x))
    x = series.x[keep]
    if len(x) > POINTS:
        wanted = (np.geomspace if log_x else np.linspace)(x[0], x[-1], POINTS)
        # Rounding can put the last wanted value a little beyond the last x.
        keep = keep[np.unique(np.searchsorted(x, wanted).clip(max=len(x) - 1))]
    seeds = series.seeds[:, keep].astype(np.float64)
    return Curve(series.x[keep].astype(np.float64), seeds, *estimate(seeds))


def series_end(series: Series) -> End | None:
    """None where no x has a number from every seed."""
    known = np.flatnonzero(~np.isnan(series.seeds).any(axis=0))
    if not known.size:
        return None
    last = known[-1]
    return End(float(series.x[last]), *(float(each) for each in estimate(series.seeds[:, last].astype(np.float64))))


def shown_range(panel: Panel) -> tuple[float, float]:
    """The lowest and the highest value that a panel shows: as asked, or of all finite numbers."""
    if panel.y_range is not None:
        return panel.y_range
    values = np.concatenate([series.seeds.ravel() for series in panel.series])
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)


def goes_beyond(panel: Panel) -> bool:
    """Whether some seed's values lie outside what the panel shows."""
    low, high = shown_range(panel)
    return any(bool(((series.seeds < low) | (series.seeds > high)).any()) for series in panel.series)


# ----------------------------------------------------------------------------------------------------------- panels


class Look(NamedTuple):
    """How a series is told from others."""

    colour: str
    dotted: bool
    """Beyond the palette's colours, these come again with dots."""


def one_legend(study: Study) -> bool:
    """Whether all panels show the same series."""
    return len({tuple(series.name for series in panel.series) for panel in study.panels}) == 1


def looks(study: Study) -> tuple[tuple[Look, ...], ...]:
    """Per panel, one look per series: the same name looks the same everywhere if there are colours enough for that."""
    names = list(dict.fromkeys(series.name for panel in study.panels for series in panel.series))
    everywhere = one_legend(study) or len(names) <= len(AGENTS)
    found = []
    for panel in study.panels:
        known = names if everywhere else [series.name for series in panel.series]
        indices = (known.index(series.name) for series in panel.series)
        found.append(tuple(Look(AGENTS[index % len(AGENTS)], index >= len(AGENTS)) for index in indices))
    return tuple(found)


def draw_study_panel(axes: Axes, panel: Panel, curves: Sequence[Curve], chosen: Sequence[Look]) -> None:
    """Every series with its band and its seeds, and the lines of the references; what lies beyond the shown range is
    drawn at its edge."""
    low, high = shown_range(panel)
    for series, curve, look in zip(panel.series, curves, chosen, strict=True):
        inside = Curve(curve.x, *(np.clip(values, low, high) for values in curve[1:]))
        style: Any = (0, (1, 1)) if look.dotted else "-"
        marker = "o" if len(curve.x) <= FEW else None
        draw_curve(axes, inside, look.colour, label=series.name, linestyle=style, marker=marker, markersize=3.5)
    for _, value in _shown_references(panel):
        axes.axhline(value, color=INK, linewidth=1.1, linestyle=(0, (4, 2.5)))
    if panel.y_range is None:
        axes.margins(y=0.09)
    else:
        room = 0.03 * (high - low)  # a curve along the edge stays whole
        axes.set_ylim(low - room, high + room)
    _set_x_axis(axes, panel, curves)
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)


def _shown_references(panel: Panel) -> list[tuple[str, float]]:
    low, high = panel.y_range or (-np.inf, np.inf)
    return [(name, value) for name, value in panel.references if np.isfinite(value) and low <= value <= high]


def _set_x_axis(axes: Axes, panel: Panel, curves: Sequence[Curve]) -> None:
    x = np.concatenate([curve.x for curve in curves])
    if panel.log_x:
        axes.set_xscale("log")
        decades = np.log10(x.max() / x.min()) if x.size else 1.0
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if decades < 2 else (1.0,)))
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.xaxis.set_major_locator(MaxNLocator(6))
        if x.size and 0 <= x.min() <= 0.1 * x.max():
            axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(FuncFormatter(thousands))


def name_references(axes: Axes, panel: Panel, curves: Sequence[Curve]) -> None:
    """Write the names of the references at their lines, where they cover least. The axes have their final size."""
    references = _shown_references(panel)
    heights = axes.transData.transform([(1.0, value) for _, value in references])[:, 1] if references else ()
    drawn = [_pixels(axes, curve) for curve in curves]
    taken: list[Any] = []
    for (name, value), own in zip(references, heights, strict=True):
        best, lowest = None, np.inf
        for side in ("left", "center", "right"):
            for below in (False, True):
                text = _at_line(axes, name, value, side, below)
                box = text.get_window_extent()
                crossed = [height for height in heights if height != own and box.y0 < height < box.y1]
                cost = sum(
                    (
                        100 * sum(box.overlaps(other) for other in taken),
                        50 * (box.y0 < axes.bbox.y0 or box.y1 > axes.bbox.y1),
                        10 * len(crossed),
                        *(box.count_contains(points) / max(len(points), 1) for points in drawn),
                    )
                )
                if cost < lowest:
                    if best is not None:
                        best.remove()
                    best, lowest = text, cost
                else:
                    text.remove()
        if best is not None:
            taken.append(best.get_window_extent())


def _pixels(axes: Axes, curve: Curve) -> Float[np.ndarray, "points 2"]:
    """A curve as points: those of its seeds and, close to one another, those of its interquartile mean."""
    low, high = axes.get_ylim()
    every = np.stack(np.broadcast_arrays(curve.x, curve.seeds.clip(low, high)), axis=-1)
    mean = axes.transData.transform(np.stack([curve.x, curve.iqm.clip(low, high)], axis=1))
    between = [np.linspace(start, end, 20) for start, end in pairwise(mean[~np.isnan(mean).any(axis=1)])]
    return np.concatenate([axes.transData.transform(every.reshape(-1, 2)), *between])


def _at_line(axes: Axes, name: str, value: float, side: str, below: bool) -> Annotation:
    place = {"left": 0.0, "center": 0.5, "right": 1.0}[side]
    return axes.annotate(
        name,
        (place, value),
        (4 - 8 * place, -3 if below else 3),
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        ha=side,
        va="top" if below else "bottom",
        fontsize=8,
        zorder=1.5,  # above the grid, under the curves
        bbox={"facecolor": PAPER, "alpha": 0.7, "edgecolor": "none", "pad": 1},
    )


def _caption(study: Study) -> str:
    """How to read the diagrams."""
    text = (
        f"Thick lines: interquartile mean over {study.seeds} seeds; bands: its 95 % bootstrap interval; thin lines: "
        "single seeds"
    )
    if any(panel.references for panel in study.panels):
        text += "; dashed: exact values"
    if any(goes_beyond(panel) for panel in study.panels):
        text += ". What lies beyond a diagram's range is drawn at its edge"
    return f"{text}."


# ----------------------------------------------------------------------------------------------------------- figure


def draw_study(study: Study, path: str | Path) -> None:
    """Write one figure of all panels, of which there is at least one: up to three in a row.

    The format follows from the ending of `path`. Raises `CannotWrite`.
    """
    count = len(study.panels)
    columns = 2 if count == 4 else min(count, 3)
    rows = -(-count // columns)
    shared = one_legend(study)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(max(4.4 * columns, 6.4), 0.7 + (3.3 if shared else 3.8) * rows), layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in grid[count:]:
            axes.remove()
        every = [[series_curve(series, panel.log_x) for series in panel.series] for panel in study.panels]
        for axes, panel, curves, chosen in zip(grid, study.panels, every, looks(study), strict=False):
            draw_study_panel(axes, panel, curves, chosen)
            axes.set_title(fill(panel.title, TITLE_WIDTH))
            if not shared:
                axes.legend(loc="upper left", bbox_to_anchor=(0, -0.17), borderaxespad=0, ncols=2, fontsize=8)
        handles, names = grid[0].get_legend_handles_labels() if shared else ([], [])
        figure.legend(
            handles,
            names,
            loc="outside upper left",
            ncols=4,
            title=study.title,
            title_fontproperties={"size": 12, "weight": "bold"},
            alignment="left",
        )
        figure.supxlabel(_caption(study), x=0.01, ha="left", fontsize=8, color=MUTED, wrap=True)
        figure.draw_without_rendering()  # makes the layout: names stand clear of curves only in axes of known size
        for axes, panel, curves in zip(grid, study.panels, every, strict=False):
            name_references(axes, panel, curves)
        save_figure(figure, path)


# ------------------------------------------------------------------------------------------------------------- page


def write_study_report(study: Study, settings: Mapping[str, object], path: str | Path) -> None:
    """Write the page of a study. Of `settings`, "command", "seconds" and "machine" are shown at the top; machines are
    drawn with what was learned in them.

    Raises `CannotWrite`.
    """
    parts = [header(study.title, f"Lodestone report · {study.name}", study.gates, [study.seeds], settings)]
    parts += [f"<p>{escape(paragraph)}</p>" for paragraph in study.summary.split("\n\n")]
    if study.gates:
        parts.append(gates_section(study.gates))
    if study.panels:
        parts += ["<h2>Curves</h2>", _curves(study), _ends(study)]
    if study.tables:
        parts += ["<h2>Numbers</h2>", *(_table(table) for table in study.tables)]
    if study.machines:
        parts.append("<h2>Machines</h2>")
        parts += [_drawing(each.title, svg_of(each), number) for number, each in enumerate(study.machines)]
    if study.playbacks:
        parts += ["<h2>Episodes</h2>", *map(player, study.playbacks)]
    parts.append(settings_section(settings))
    write_page(study.title, "\n".join(parts), path)


def _curves(study: Study) -> str:
    shared = one_legend(study)
    charts = []
    for number, (panel, chosen) in enumerate(zip(study.panels, looks(study), strict=True)):
        svg = panel_svg(partial(_fill, panel=panel, chosen=chosen))
        label = f"{panel.y_label} over {panel.x_label}: {panel.title}"
        chart = chart_figure(svg, f"panel-{number}", label, PAGE_COLOURS | AGENT_COLOURS)
        charts.append(f"<div><h3>{escape(panel.title)}</h3>{'' if shared else _legend(panel, chosen)}{chart}</div>")
    return (
        f'<div class="card">\n{_legend(study.panels[0], looks(study)[0]) if shared else ""}'
        f'<div class="charts bottoms">\n{joined(charts)}</div>\n<p class="muted">{_caption(study)}</p>\n</div>'
    )


def _fill(axes: Axes, panel: Panel, chosen: Sequence[Look]) -> None:
    curves = [series_curve(series, panel.log_x) for series in panel.series]
    draw_study_panel(axes, panel, curves, chosen)
    name_references(axes, panel, curves)


def _legend(panel: Panel, chosen: Sequence[Look]) -> str:
    entries = []
    for series, look in zip(panel.series, chosen, strict=True):
        colour = AGENT_COLOURS[look.colour]
        style = f"border: 2px dotted {colour}" if look.dotted else f"background: {colour}"
        entries.append(f'<li><span class="swatch" style="{style}"></span>{escape(series.name)}</li>')
    return f'<ul class="legend">\n{joined(entries)}</ul>\n'


def _ends(study: Study) -> str:
    """What every curve came to."""
    rows = []
    for panel in study.panels:
        for number, series in enumerate(panel.series):
            label = f'<th scope="rowgroup" rowspan="{len(panel.series)}">{escape(panel.title)}</th>'
            end = series_end(series)
            at = "" if end is None else f"{number_text(end.x, 4)} {escape(panel.x_label)}"
            text = "not measured" if end is None else interval_text(*end[1:])
            rows.append(
                f'<tr class="{"within" if number else "group"}">{"" if number else label}<td>{escape(series.name)}</td>'
                f'<td class="number">{at}</td><td class="number">{text}</td></tr>'
            )
    head = table_head("", ("at", "interquartile mean [95 % interval]"), second="")
    return (
        '<div class="card">\n<h3>At the end of each curve</h3>\n<div class="scroll"><table>'
        f"{head}<tbody>\n{joined(rows)}</tbody></table></div>\n</div>"
    )


def _table(table: NumberTable) -> str:
    # A column of numbers stands to the right even where one of its cells is a word.
    numeric = [any(not isinstance(row[column], str) for row in table.rows) for column in range(len(table.columns))]
    rows = [
        f"<tr>{''.join(_cell(value, numeric[index], index == 0) for index, value in enumerate(row))}</tr>"
        for row in table.rows
    ]
    head = "".join(_heading(name, is_number) for name, is_number in zip(table.columns, numeric, strict=True))
    return (
        f'<div class="card">\n<h3>{escape(table.title)}</h3>\n<div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>\n{joined(rows)}</tbody></table></div>\n</div>"
    )


def _heading(name: str, is_number: bool) -> str:
    style = ' class="number"' if is_number else ""
    return f'<th scope="col"{style}>{escape(name)}</th>' if name else f"<td{style}></td>"


def _cell(value: str | float, is_number: bool, first: bool) -> str:
    text = escape(value if isinstance(value, str) else number_text(value, 4))
    if first and not is_number:
        return f'<th scope="row">{text}</th>'
    return f'<td class="number">{text}</td>' if is_number else f"<td>{text}</td>"


def svg_of(machines: LearnedMachines) -> str:
    """The machines as an SVG text, with how often an episode takes each edge."""
    hierarchy = machines.process.configurations.hierarchy
    return hierarchy_svg(hierarchy, edge_counts(machines.process, machines.visits))


def _drawing(title: str, svg: str, number: int) -> str:
    svg = svg[svg.index("<svg") :]  # a page holds no second XML declaration
    figure = chart_figure(svg, f"drawing-{number}", title, PAGE_COLOURS | AGENT_COLOURS | DRAWING_COLOURS)
    return f'<div class="card drawing">\n<h3>{escape(title)}</h3>\n{figure}\n</div>'


# ------------------------------------------------------------------------------------------------------------ files


def study_json(study: Study, settings: Mapping[str, object]) -> dict[str, Any]:
    """What was found, fit for JSON: what is not a finite number is None. Of every curve its end."""
    return json_safe(
        {
            "name": study.name,
            "title": study.title,
            "seeds": study.seeds,
            "panels": [
                {
                    "title": panel.title,
                    "x_label": panel.x_label,
                    "y_label": panel.y_label,
                    "references": [{"name": name, "value": value} for name, value in panel.references],
                    "series": [{"name": series.name, "end": series_end(series)} for series in panel.series],
                }
                for panel in study.panels
            ],
            "tables": study.tables,
            "gates": study.gates,
            "settings": settings,
        }
    )


def save_study(folder: Path, study: Study, settings: Mapping[str, object]) -> list[str]:
    """Write NAME.png, NAME-1.svg and so on, results.json and report.html; returns their names.

    Each file appears whole or not at all. Raises `CannotWrite`.
    """
    files = []
    if study.panels:
        files.append(f"{study.name}.png")
        draw_study(study, folder / files[-1])
    for number, machines in enumerate(study.machines, start=1):
        files.append(f"{study.name}-{number}.svg")
        write_atomically(folder / files[-1], svg_of(machines).encode())
    write_json(folder / "results.json", study_json(study, settings))
    write_study_report(study, settings, folder / "report.html")
    return [*files, "results.json", "report.html"]
