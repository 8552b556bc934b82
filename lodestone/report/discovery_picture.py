"""What discovered sub-goals are the peaks of, drawn over the squares of a world."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lodestone.discovery.betweenness import Bottlenecks
from lodestone.discovery.catalogue import Discovery
from lodestone.discovery.covering import Covering
from lodestone.discovery.diverse_density import DenseSubgoals
from lodestone.discovery.eigenoptions import Eigenoptions
from lodestone.errors import InvalidConfig
from lodestone.files import write_atomically
from lodestone.report.palette import INK, PAPER

WALL = "#464c56"
UNSEEN = "#d3d7dd"
MOST_MAPS = 6
"""Vectors that are drawn, at most: the first ones."""
DPI = 160


class _Map(NamedTuple):
    """One panel."""

    title: str
    values: Float[np.ndarray, " S"]
    """Not a number where a state was not seen."""
    marked: Int[np.ndarray, " G"]
    """Sub-goals."""
    signed: bool
    """Whether the colours diverge from 0."""
    joined: bool = False
    """Whether a line joins the marks."""


def write_picture(discovery: Discovery, path: str | Path) -> None:
    """Write a PNG with one map, or one for each of the first eigenvectors. Raises `InvalidConfig` where states are no
    squares, and `CannotWrite`."""
    if discovery.squares is None:
        raise InvalidConfig("A picture can only be drawn where states are squares of a grid.")
    maps = _maps(discovery)[:MOST_MAPS]
    columns = 2 if len(maps) == 4 else min(len(maps), 3)
    rows = -(-len(maps) // columns)
    height, width = np.ptp(discovery.squares, axis=0) + 3
    across = 3.2 if columns > 1 else 4.2
    with mpl.rc_context({"font.size": 8, "text.color": INK}):
        figure = Figure(
            figsize=(across * columns, (across * 0.82 * min(height / width, 2.0) + 0.3) * rows),
            layout="constrained",
            dpi=DPI,
        )
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in panels:
            axes.set_axis_off()
        for axes, one in zip(panels, maps, strict=False):
            _draw(axes, figure, one, discovery.squares)
        content = BytesIO()
        figure.savefig(content, format="png", facecolor=PAPER)
    write_atomically(path, content.getvalue())


def _maps(discovery: Discovery) -> list[_Map]:
    found = discovery.found
    match found:
        case DenseSubgoals():
            finite = found.log_density[np.isfinite(found.log_density)]
            return [_Map("ln of the diverse density", found.log_density.clip(finite.min()), found.subgoals, False)]
        case Bottlenecks():
            return [_Map("Betweenness", found.centrality, found.subgoals, False)]
        case Eigenoptions():
            return [
                _Map(f"Eigenvector {number + 1}, eigenvalue {value:.4g}", vector, ends, True)
                for number, (value, vector, ends) in enumerate(
                    zip(found.eigenvalues, found.vectors.T, found.subgoals.reshape(-1, 2), strict=True)
                )
            ]
        case Covering():
            return [
                _Map(f"Pair {number + 1}, lambda_2 {before:.4g} to {after:.4g}", vector, np.array(ends), True, True)
                for number, (vector, ends, before, after) in enumerate(
                    zip(found.vectors.T, found.pairs, found.connectivity[:-1], found.connectivity[1:], strict=True)
                )
            ]


def _draw(axes: Axes, figure: Figure, one: _Map, squares: Int[np.ndarray, "S 2"]) -> None:
    """Walls are what is no state; a border of one square is drawn around all."""
    corner = squares.min(axis=0) - 1
    placed = squares - corner
    values = np.full(placed.max(axis=0) + 2, np.nan)
    values[tuple(placed.T)] = one.values
    ground = np.empty((*values.shape, 3))
    ground[:] = mpl.colors.to_rgb(WALL)
    ground[tuple(placed.T)] = mpl.colors.to_rgb(UNSEEN)
    axes.imshow(ground)
    most = float(np.nanmax(np.abs(one.values)))
    low, high, colours = (-most, most, "PuOr_r") if one.signed else (None, None, "viridis")
    image = axes.imshow(np.ma.masked_invalid(values), cmap=colours, vmin=low, vmax=high)
    row, column = placed[one.marked].T
    if one.joined:
        axes.plot(column, row, color=INK, linewidth=1.2, linestyle=(0, (3, 2)))
    axes.scatter(column, row, s=60, marker="o", facecolors="none", edgecolors=PAPER, linewidths=3.0)
    axes.scatter(column, row, s=60, marker="o", facecolors="none", edgecolors=INK, linewidths=1.6)
    axes.set_title(one.title, fontsize=8.5)
    bar = figure.colorbar(image, ax=axes, shrink=0.8, aspect=24, pad=0.02)
    bar.outline.set_visible(False)  # type: ignore[operator]
    bar.ax.tick_params(labelsize=7, length=2)
