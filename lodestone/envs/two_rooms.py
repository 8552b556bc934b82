"""Two rooms with two doors: the quicker way out of the first room is not the quicker way to the goal.

After figure 6 of Dietterich (2000), who tells with such a house what a task is worth that is solved without regard to
what follows (recursive optimality) from one that is solved with it (hierarchical optimality).
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int8, UInt8
from PIL import Image, ImageDraw

from lodestone.envs.base import Environment
from lodestone.errors import InvalidConfig

NORTH, SOUTH, EAST = range(3)
"""The actions. There is no way back to the west."""
STEPS = np.array([(-1, 0), (1, 0), (0, 1)])
"""Row and column by which each action moves."""

ROWS, COLUMNS = 8, 7
LEFT_COLUMNS = 4
"""Columns of the left room; the others are the right room's."""
DOORS = (0, 7)
"""Rows where the wall between the rooms is open."""
GOAL = (1, 5)
"""Row and column where the episode ends."""


def _next_squares() -> Int8[np.ndarray, "rows columns 3 2"]:
    """Row and column that each action leads to; a wall holds the agent back."""
    squares = np.stack(np.meshgrid(np.arange(ROWS), np.arange(COLUMNS), indexing="ij"), axis=-1)
    ahead = np.clip(squares[:, :, None] + STEPS, 0, (ROWS - 1, COLUMNS - 1))
    ahead[1:-1, LEFT_COLUMNS - 1, EAST, 1] = LEFT_COLUMNS - 1
    return ahead.astype(np.int8)


NEXT_SQUARES = _next_squares()


class TwoRoomsState(NamedTuple):
    """Where the agent is; row 0 is in the north, column 0 in the west."""

    row: Int8[Array, ""]
    column: Int8[Array, ""]


class TwoRooms(Environment):
    """56 cells, three actions, each step costs 1; the episode ends at the goal, which the last column has missed."""

    observation: Literal["planes", "cell"] = eqx.field(static=True, default="planes")
    """What the agent sees: one 0/1 plane over the cells, or the number of the cell."""

    def __check_init__(self) -> None:
        if self.observation not in ("planes", "cell"):
            raise InvalidConfig(f"observation is {self.observation!r}, but must be 'planes' or 'cell'.")

    @property
    def action_names(self) -> tuple[str, ...]:
        return ("north", "south", "east")

    @property
    def num_outcomes(self) -> int:
        return 1

    def initial_distribution(self) -> tuple[Float[Array, " I"], TwoRoomsState]:
        """Anywhere in the left room."""
        row, column = np.indices((ROWS, LEFT_COLUMNS), dtype=np.int8).reshape(2, -1)
        probs = jnp.full(len(row), 1 / len(row), dtype=jnp.float32)
        return probs, TwoRoomsState(jnp.asarray(row), jnp.asarray(column))

    def outcome_probs(self, state: TwoRoomsState, action: Int[Array, ""]) -> Float[Array, " 1"]:
        del state, action
        return jnp.ones(1)

    def transition(self, state: TwoRoomsState, action: Int[Array, ""], outcome: Int[Array, ""]) -> TwoRoomsState:
        del outcome
        row, column = jnp.asarray(NEXT_SQUARES)[state.row, state.column, action]
        return TwoRoomsState(row, column)

    def reward(self, state: TwoRoomsState, action: Int[Array, ""], next_state: TwoRoomsState) -> Float[Array, ""]:
        del state, action, next_state
        return jnp.float32(-1)

    def terminal(self, state: TwoRoomsState) -> Bool[Array, ""]:
        return (state.row == GOAL[0]) & (state.column == GOAL[1])

    def in_left_room(self, state: TwoRoomsState) -> Bool[Array, ""]:
        """Whether the agent has not left the room where it began."""
        return state.column < LEFT_COLUMNS

    def observe(self, state: TwoRoomsState) -> Int8[Array, "8 7 1"] | Int[Array, ""]:
        """`planes`: int8 [8, 7, 1], 1 where the agent is; `cell`: int32 [], the number of the cell, row by row."""
        if self.observation == "cell":
            return state.row.astype(jnp.int32) * COLUMNS + state.column.astype(jnp.int32)
        row, column = jnp.arange(ROWS, dtype=jnp.int8)[:, None], jnp.arange(COLUMNS, dtype=jnp.int8)[None, :]
        return ((row == state.row) & (column == state.column))[..., None].astype(jnp.int8)

    def render(self, state: TwoRoomsState) -> UInt8[np.ndarray, "height width 3"]:
        """The rooms from above, the left one tinted, the goal as a green square, the agent as a red disc."""
        right, bottom = (MARGIN + count * SQUARE for count in (COLUMNS, ROWS))
        picture = Image.new("RGB", (right + MARGIN, bottom + MARGIN), PAPER)
        draw = ImageDraw.Draw(picture)
        middle = MARGIN + LEFT_COLUMNS * SQUARE
        draw.rectangle((MARGIN, MARGIN, middle, bottom), TINT)
        draw.rectangle(_box(*GOAL, 0), GREEN)
        for x in range(MARGIN, right, SQUARE):
            draw.line((x, MARGIN, x, bottom), GRID, SMOOTH)
        for y in range(MARGIN, bottom, SQUARE):
            draw.line((MARGIN, y, right, y), GRID, SMOOTH)
        half = MARGIN // 2
        draw.rectangle((half, half, right + half, bottom + half), outline=WALL, width=half)
        ends = MARGIN + (DOORS[0] + 1) * SQUARE, MARGIN + DOORS[1] * SQUARE
        draw.rounded_rectangle((middle - half, ends[0], middle + half, ends[1]), half, WALL)
        draw.ellipse(_box(int(state.row), int(state.column), SQUARE // 5), RED)
        return np.asarray(picture.reduce(SMOOTH))


SMOOTH = 3
"""Pictures for people are painted this many times larger and then reduced, for smooth edges."""
SQUARE, MARGIN = 44 * SMOOTH, 12 * SMOOTH
"""Side of a cell and width of the frame around the rooms, in painted pixels."""
PAPER, TINT, GRID, WALL = (246, 246, 242), (232, 238, 246), (220, 222, 226), (70, 76, 86)
GREEN, RED = (34, 150, 84), (204, 60, 40)


def _box(row: int, column: int, inset: int) -> tuple[int, int, int, int]:
    """A cell's square, `inset` pixels smaller on every side."""
    x, y = MARGIN + column * SQUARE, MARGIN + row * SQUARE
    return x + inset, y + inset, x + SQUARE - inset, y + SQUARE - inset
