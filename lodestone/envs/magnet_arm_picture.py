"""The magnet arm as people see it: bricks, an arm on a rail whose magnet glows, the wanted height, a legend.

What never changes is painted once per environment and each thing that moves is a small stamp painted once, so that a
frame costs a few copies.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, UInt8
from PIL import Image, ImageDraw, ImageFilter, ImageFont

from lodestone.envs.magnet_arm import ARM_OFF, ARM_ON, BRICK, PALETTE, ArmState, MagnetArm

Colour = tuple[int, int, int]

PAPER: Colour = (250, 250, 247)
GRID: Colour = (226, 228, 232)
GROUND: Colour = (120, 113, 105)
SOIL: Colour = (222, 216, 207)
STEEL: Colour = (96, 106, 120)
INK: Colour = (52, 58, 68)
BRICK_EDGE: Colour = (148, 112, 62)
MORTAR: Colour = (204, 168, 112)
WANTED: Colour = (120, 128, 140)
REACHED: Colour = (34, 150, 84)

SMOOTH = 4
"""Stamps are painted this many times larger and then reduced, for smooth edges."""


class Layout(NamedTuple):
    """Where things are, in pixels."""

    cell: int
    """Side of a cell."""
    left: int
    """Left edge of the grid."""
    top: int
    """Top edge of the grid."""
    right: int
    """Right edge of the grid."""
    floor: int
    """Bottom edge of the grid."""
    width: int
    """Width of the picture."""
    height: int
    """Height of the picture."""

    @property
    def rail(self) -> int:
        """Height of the rail's middle."""
        return self.top - 20


@cache
def _layout(arm: MagnetArm) -> Layout:
    cell = max(16, min(64, 1024 // max(arm.rows, arm.columns)))
    left, top = 56, 44
    right, floor = left + arm.columns * cell, top + arm.rows * cell
    legend_bottom = top + 5 * 28
    return Layout(cell, left, top, right, floor, right + 168, max(floor + 28, legend_bottom))


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _colour(code: int) -> Colour:
    """The colour of a cell code in the agent's picture, so that the two pictures speak alike."""
    red, green, blue = PALETTE[code].tolist()
    return red, green, blue


@cache
def _brick(cell: int) -> Image.Image:
    """A brick that fills a cell but for a thin gap."""
    side = cell * SMOOTH
    stamp = Image.new("RGBA", (side, side), (*BRICK_EDGE, 0))
    draw = ImageDraw.Draw(stamp)
    gap, edge = side // 32, max(side // 28, 1)
    box = (gap, gap, side - gap - 1, side - gap - 1)
    draw.rounded_rectangle(box, side // 10, _colour(BRICK), BRICK_EDGE, edge)
    inner = side // 7
    draw.rounded_rectangle((inner, inner, side - inner, side - inner), side // 16, None, MORTAR, max(side // 48, 1))
    return stamp.reduce(SMOOTH)


@cache
def _magnet(cell: int, code: int) -> Image.Image:
    """The arm's end, at the bottom of the middle one of three x three cells, for the glow around it.

    `code` is `ARM_ON` or `ARM_OFF`.
    """
    side = cell * SMOOTH
    stamp = Image.new("RGBA", (3 * side, 3 * side), (*_colour(code), 0))
    middle, bottom = 3 * side // 2, 2 * side - side // 32
    shoe = (middle - 3 * side // 8, bottom - side // 4, middle + 3 * side // 8, bottom)
    if code == ARM_ON:
        reach = side // 5
        glow = Image.new("L", stamp.size, 0)
        halo = (shoe[0] - reach // 2, shoe[1] - reach // 2, shoe[2] + reach // 2, shoe[3] + reach)
        ImageDraw.Draw(glow).rounded_rectangle(halo, reach, 235)
        stamp.putalpha(glow.reduce(SMOOTH).filter(ImageFilter.GaussianBlur(cell / 6)).resize(stamp.size))
    draw = ImageDraw.Draw(stamp)
    draw.rounded_rectangle(
        (middle - side // 5, shoe[1] - side // 5, middle + side // 5, shoe[1] + side // 10), side // 16, STEEL
    )
    draw.rounded_rectangle(shoe, side // 14, _colour(code), INK, max(side // 40, 1))
    return stamp.reduce(SMOOTH)


def _wanted_height(draw: ImageDraw.ImageDraw, arm: MagnetArm, colour: Colour) -> None:
    """A dashed line at the wanted height, and a measure from the floor to it with the number of bricks."""
    at = _layout(arm)
    line = at.floor - arm.tower_height * at.cell
    for x in range(at.left, at.right, 12):
        draw.line((x, line, min(x + 7, at.right), line), colour, 2)
    x = at.left - 16
    draw.line((x, line, x, at.floor), colour, 2)
    for y in (line, at.floor):
        draw.line((x - 5, y, x + 5, y), colour, 2)
    draw.text((x - 10, (line + at.floor) // 2), str(arm.tower_height), colour, _font(20), anchor="rm")


def _legend(picture: Image.Image, arm: MagnetArm) -> None:
    """What the colours and the dashed line mean, to the right of the grid."""
    at = _layout(arm)
    draw = ImageDraw.Draw(picture)
    x, text = at.right + 20, at.right + 52
    names = ((BRICK, "brick"), (ARM_ON, "magnet on"), (ARM_OFF, "magnet off"))
    for line, (code, name) in enumerate(names):
        y = at.top + 14 + 28 * line
        edge = BRICK_EDGE if code == BRICK else INK
        draw.rounded_rectangle((x, y - 8, x + 20, y + 8), 3, _colour(code), edge)
        draw.text((text, y), name, INK, _font(15), anchor="lm")
    y = at.top + 14 + 28 * len(names)
    for dash in (x, x + 12):
        draw.line((dash, y, dash + 7, y), WANTED, 2)
    draw.text((text, y), "wanted height", INK, _font(15), anchor="lm")


@cache
def _background(arm: MagnetArm, reached: bool) -> Image.Image:
    """All that does not move: the grid, the ground, the rail, the wanted height, the legend."""
    at = _layout(arm)
    picture = Image.new("RGB", (at.width, at.height), PAPER)
    draw = ImageDraw.Draw(picture)
    for row in range(arm.rows):
        y = at.top + row * at.cell
        draw.line((at.left, y, at.right, y), GRID)
    for column in range(arm.columns + 1):
        x = at.left + column * at.cell
        draw.line((x, at.top, x, at.floor), GRID)
    draw.rectangle((at.left - 28, at.floor, at.right + 12, at.floor + 10), SOIL)
    draw.line((at.left - 28, at.floor, at.right + 12, at.floor), GROUND, 3)
    draw.rounded_rectangle((at.left - 10, at.rail - 4, at.right + 10, at.rail + 4), 4, STEEL)
    _wanted_height(draw, arm, REACHED if reached else WANTED)
    _legend(picture, arm)
    return picture


@jax.jit
def _scene(arm: MagnetArm, state: ArmState) -> tuple[UInt8[Array, "rows columns"], Bool[Array, ""]]:
    return arm.cell_codes(state), arm.terminal(state)


def draw(arm: MagnetArm, state: ArmState) -> UInt8[np.ndarray, "height width 3"]:
    """The picture of one state. The wanted height is green when the tower is finished."""
    at = _layout(arm)
    codes, reached = (np.asarray(value) for value in _scene(arm, state))
    picture = _background(arm, bool(reached)).copy()

    def corner(row: int, column: int) -> tuple[int, int]:
        return at.left + column * at.cell, at.top + row * at.cell

    brick = _brick(at.cell)
    for row, column in np.argwhere(codes == BRICK).tolist():
        picture.paste(brick, corner(row, column), brick)

    row, column = int(state.row), int(state.column)
    x, y = corner(row, column)
    middle, rod = x + at.cell // 2, max(at.cell // 14, 1)
    pen = ImageDraw.Draw(picture)
    pen.rounded_rectangle((middle - at.cell // 4, at.rail - 9, middle + at.cell // 4, at.rail + 9), 5, INK)
    pen.rectangle((middle - rod, at.rail + 9, middle + rod, y + at.cell // 2), STEEL)
    magnet = _magnet(at.cell, int(codes[row, column]))
    picture.paste(magnet, (x - at.cell, y - at.cell), magnet)
    return np.array(picture)
