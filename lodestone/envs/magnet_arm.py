"""The magnet arm that builds a tower of bricks: the environment of Kuzmin and Panov (2018, section 4.1).

An arm with a magnet moves over a grid, one cell a step. With the magnet on, a brick directly below the arm hangs on it
and moves along. The episode ends, with the tower reward, when the highest tower has exactly the wanted height and the
magnet is off.

Coordinates: row 0 is the top, column 0 the left. Inside a column, bricks are bits of one integer, bit 0 on the floor,
so that a whole column is tested, lifted from and dropped into by a few integer operations.
"""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache, partial
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental.xla_metadata import set_xla_metadata
from jaxtyping import Array, Bool, Float, Int, UInt, UInt8

from lodestone.envs.base import Environment
from lodestone.envs.state_space import reachable_states
from lodestone.envs.task import Task, goal
from lodestone.errors import InvalidConfig

LEFT, UP, RIGHT, DOWN, MAGNET_ON, MAGNET_OFF = range(6)

EMPTY, BRICK, ARM_ON, ARM_OFF = range(4)
"""Cell codes, as in the paper: brick one, magnet on two, magnet off three, empty cell zero."""

PALETTE = np.array([(0, 0, 0), (230, 200, 150), (51, 153, 255), (204, 0, 0)], dtype=np.uint8)
"""Colour of each cell code in the agent's picture. These are the authors' code's colours; the caption of the paper's
figure 1 names the two arm colours the other way round."""

MAX_ROWS = 31
"""A column is one non-negative int32."""

MAX_COLUMNS = 1000
"""More would only take memory."""


class ArmState(NamedTuple):
    """Where everything is. Small integer types: a replay of a million transitions holds states."""

    bricks: UInt[Array, " columns"]
    """Each column's bricks as bits; bit 0 is the floor."""
    row: Int[Array, ""]
    column: Int[Array, ""]
    magnet: Bool[Array, ""]


class MagnetArm(Environment):
    """Any rows x columns, any number of bricks, any tower that they can make."""

    rows: int = eqx.field(static=True, default=4)
    """Height of the grid in cells, the arm's top row included."""
    columns: int = eqx.field(static=True, default=3)
    """Width of the grid in cells."""
    bricks: int = eqx.field(static=True, default=3)
    """Number of bricks; they start on the floor from the right to the left."""
    tower_height: int = eqx.field(static=True, default=3)
    """Height, in bricks, that the highest tower must have."""
    step_reward: float = eqx.field(static=True, default=-1.0)
    """Reward of every primitive step."""
    tower_reward: float = eqx.field(static=True, default=100.0)
    """Reward added to the step that completes the tower."""
    observation: Literal["rgb", "planes", "index"] = eqx.field(static=True, default="rgb")
    """What the agent sees: a picture, one 0/1 plane per cell code, or the number of the state."""
    pixels_per_cell: int = eqx.field(static=True, default=3)
    """Side of a cell in the agent's picture, in pixels."""
    sticky_magnet: bool = eqx.field(static=True, default=True)
    """Whether switching off does nothing unless a brick hangs below (the authors' code); otherwise it always switches
    the magnet off (the paper's words)."""

    def __check_init__(self) -> None:
        for name in ("rows", "columns", "bricks", "tower_height", "pixels_per_cell"):
            if getattr(self, name) < 1:
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be at least 1.")
        if self.rows < 2 or self.rows > MAX_ROWS:
            raise InvalidConfig(f"rows is {self.rows}, but must be from 2 to {MAX_ROWS}: the arm needs the top row.")
        if self.columns > MAX_COLUMNS:
            raise InvalidConfig(f"columns is {self.columns}, but must be at most {MAX_COLUMNS}.")
        room = (self.rows - 1) * self.columns
        if self.bricks > room:
            raise InvalidConfig(
                f"{self.bricks} bricks do not fit: {self.rows} rows x {self.columns} columns hold at most {room} "
                "below the arm's top row."
            )
        if self.tower_height > min(self.bricks, self.rows - 1):
            raise InvalidConfig(
                f"tower_height is {self.tower_height}, but {self.bricks} bricks in {self.rows} rows allow a tower of "
                f"at most {min(self.bricks, self.rows - 1)}."
            )
        start_height = -(-self.bricks // self.columns)
        if start_height == self.tower_height:
            raise InvalidConfig(
                f"tower_height is {self.tower_height}, which the bricks have before the first step; "
                "choose another height, fewer bricks or more columns."
            )
        for name in ("step_reward", "tower_reward"):
            if not np.isfinite(getattr(self, name)):
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be a finite number.")
        if self.observation not in ("rgb", "planes", "index"):
            raise InvalidConfig(f"observation is {self.observation!r}, but must be 'rgb', 'planes' or 'index'.")

    @property
    def action_names(self) -> tuple[str, ...]:
        return ("left", "up", "right", "down", "magnet-on", "magnet-off")

    @property
    def num_outcomes(self) -> int:
        return 1

    def initial_distribution(self) -> tuple[Float[Array, " 1"], ArmState]:
        """One start: arm at the top left with the magnet off, bricks on the floor from the right to the left."""
        full_rows, rest = divmod(self.bricks, self.columns)
        heights = np.full(self.columns, full_rows)
        heights[self.columns - rest :] += 1
        return jnp.ones(1), _at_top(self, heights[None], np.zeros(1))

    def outcome_probs(self, state: ArmState, action: Int[Array, ""]) -> Float[Array, " 1"]:
        del state, action
        return jnp.ones(1)

    def transition(self, state: ArmState, action: Int[Array, ""], outcome: Int[Array, ""]) -> ArmState:
        """Move, switch on, or let go. A move that would hit a wall or a brick, with the arm or with what hangs on it,
        changes nothing."""
        del outcome
        arm = 1 << (self.rows - 1 - state.row.astype(jnp.int32))
        below = arm >> 1
        bricks = state.bricks.astype(jnp.int32)
        column = state.column.astype(jnp.int32)
        here = jnp.arange(self.columns) == column
        brick_below = jnp.any(here & ((bricks & below) != 0))
        hangs = state.magnet & brick_below
        rest = jnp.where(here & hangs, bricks & ~below, bricks)

        # A move.
        up, down = action == UP, action == DOWN
        new_row = state.row.astype(jnp.int32) + jnp.where(up, -1, jnp.where(down, 1, 0))
        new_column = column + jnp.where(action == LEFT, -1, jnp.where(action == RIGHT, 1, 0))
        new_arm = jnp.where(up, arm << 1, jnp.where(down, below, arm))
        new_below = new_arm >> 1
        needed = new_arm | jnp.where(hangs, new_below, 0)
        there = jnp.arange(self.columns) == new_column
        inside = (new_row >= 0) & (new_row < self.rows) & (new_column >= 0) & (new_column < self.columns)
        inside &= ~hangs | (new_below != 0)
        moves = (action <= DOWN) & inside & ~jnp.any(there & ((rest & needed) != 0))

        # Letting go: the brick falls onto the first support, which is the lowest free bit, as nothing else floats.
        off = action == MAGNET_OFF
        falls = off & hangs
        landing = ~rest & (rest + 1)

        hanging = jnp.where(there & hangs, new_below, 0)
        next_bricks = jnp.where(moves, rest | hanging, jnp.where(here & falls, rest | landing, bricks))
        switched_off = falls if self.sticky_magnet else off
        return ArmState(
            bricks=next_bricks.astype(state.bricks.dtype),
            row=jnp.where(moves, new_row, state.row.astype(jnp.int32)).astype(state.row.dtype),
            column=jnp.where(moves, new_column, column).astype(state.column.dtype),
            magnet=(state.magnet | (action == MAGNET_ON)) & ~switched_off,
        )

    def reward(self, state: ArmState, action: Int[Array, ""], next_state: ArmState) -> Float[Array, ""]:
        del state, action
        return jnp.where(self.terminal(next_state), self.step_reward + self.tower_reward, self.step_reward)

    def terminal(self, state: ArmState) -> Bool[Array, ""]:
        """The highest tower has exactly the wanted height, and the magnet is off."""
        return (jnp.max(tower_heights(state)) == self.tower_height) & ~state.magnet

    def cell_codes(self, state: ArmState) -> UInt8[Array, "rows columns"]:
        """The grid as the paper's matrix: 0 empty, 1 brick, 2 magnet on, 3 magnet off."""
        row, column = jnp.arange(self.rows)[:, None], jnp.arange(self.columns)[None, :]
        brick = (state.bricks.astype(jnp.int32)[None, :] >> (self.rows - 1 - row)) & 1
        arm = jnp.where(state.magnet, ARM_ON, ARM_OFF)
        arm_here = (row == state.row.astype(jnp.int32)) & (column == state.column.astype(jnp.int32))
        return jnp.where(arm_here, arm, brick * BRICK).astype(jnp.uint8)

    def observe(self, state: ArmState) -> Array:
        """`rgb`: uint8 [rows * pixels, columns * pixels, 3]; `planes`: int8 [rows, columns, 4], one plane of 0 and
        1 per cell code; `index`: int32 [], the state's number in `reachable_states`."""
        if self.observation == "index":
            return reachable_states(self).index_of(state)
        if self.observation == "planes":
            codes = self.cell_codes(state)
            return (codes[..., None] == jnp.arange(4, dtype=jnp.uint8)[None, None]).astype(jnp.int8)
        return _picture(self, state)

    def render(self, state: ArmState) -> UInt8[np.ndarray, "height width 3"]:
        from lodestone.envs.magnet_arm_picture import draw  # Pillow is only needed to draw for people

        return draw(self, state)


def tower_heights(state: ArmState) -> Int[Array, " columns"]:
    """Height of each column's tower: the unbroken bricks from the floor up. A brick that hangs in the air does not
    count."""
    bricks = state.bricks.astype(jnp.int32)
    return lax.population_count(bricks ^ (bricks + 1)) - 1


def _picture(arm: MagnetArm, state: ArmState) -> UInt8[Array, "height width 3"]:
    """The agent's picture: cells of `pixels_per_cell` x `pixels_per_cell` pixels in the colours of `PALETTE`."""
    side = arm.pixels_per_cell
    # On a CPU, XLA merges the last reshape into the loop that computes the bytes, whose innermost length is then 3
    # instead of the whole picture: ten times slower. A call that is not inlined keeps the two apart.
    on_cpu = jax.default_backend() == "cpu"
    with set_xla_metadata(inlineable="false") if on_cpu else nullcontext():
        picture = _picture_bytes(arm, state)
    return picture.reshape(arm.rows * side, arm.columns * side, 3)


@partial(jax.jit, static_argnums=0)
def _picture_bytes(arm: MagnetArm, state: ArmState) -> UInt8[Array, " bytes"]:
    """The picture's bytes in one row: what a byte may show is known beforehand, the state chooses among it."""
    side = arm.pixels_per_cell
    shape = (arm.rows * side, arm.columns * side, 3)
    pixel_row, pixel_column, channel = np.unravel_index(np.arange(math.prod(shape)), shape)
    row, column = pixel_row // side, pixel_column // side

    bricks = np.zeros(len(row), dtype=state.bricks.dtype)
    for each in range(arm.columns):
        bit = np.where(column == each, 1 << (arm.rows - 1 - row), 0)
        bricks |= state.bricks[each] & bit.astype(state.bricks.dtype)
    arm_here = (row.astype(state.row.dtype) == state.row) & (column.astype(state.column.dtype) == state.column)

    # The arm's shape is an inverted T: the middle column of its cell and the bottom row.
    glyph = (pixel_column % side == side // 2) | (pixel_row % side == side - 1)
    empty, brick, arm_on, arm_off = PALETTE[:, channel]
    arm_colour = lax.select(state.magnet, np.where(glyph, arm_on, empty), np.where(glyph, arm_off, empty))
    return lax.select(bricks != 0, brick, lax.select(arm_here, arm_colour, empty))


def _at_top(arm: MagnetArm, heights: Int[np.ndarray, "I columns"], column: Int[np.ndarray, " I"]) -> ArmState:
    """States with towers of the given heights and the idle arm in the top row of `column`."""
    column_bits = np.uint8 if arm.rows <= 8 else np.uint16 if arm.rows <= 16 else np.uint32
    count = len(heights)
    return ArmState(
        bricks=jnp.asarray((1 << heights.astype(np.int64)) - 1, dtype=column_bits),
        row=jnp.zeros(count, dtype=jnp.int8),
        column=jnp.asarray(column, dtype=jnp.int8 if arm.columns < 128 else jnp.int32),
        magnet=jnp.zeros(count, dtype=bool),
    )


@cache
def _random_layouts(arm: MagnetArm) -> tuple[Float[np.ndarray, " I"], Int[np.ndarray, "I columns"]]:
    """Probabilities and column heights of layouts made by dropping the bricks one by one into random columns.

    A column stays below the tower's height, so that no layout is a tower already, unless the bricks need more room.
    """
    limit = min(max(arm.tower_height - 1, -(-arm.bricks // arm.columns)), arm.rows - 1)
    layouts = {(0,) * arm.columns: 1.0}
    for _ in range(arm.bricks):
        dropped: dict[tuple[int, ...], float] = {}
        for heights, prob in layouts.items():
            free = [column for column in range(arm.columns) if heights[column] < limit]
            for column in free:
                taller = (*heights[:column], heights[column] + 1, *heights[column + 1 :])
                dropped[taller] = dropped.get(taller, 0.0) + prob / len(free)
        layouts = dropped
    return np.array(list(layouts.values())), np.array(list(layouts.keys()))


def random_layouts(arm: MagnetArm) -> tuple[Float[Array, " I"], ArmState]:
    """Where an option's training begins: bricks in random columns, the arm anywhere in the top row, magnet off
    (section 4.2 of the paper)."""
    probs, heights = _random_layouts(arm)
    column = np.tile(np.arange(arm.columns), len(heights))
    states = _at_top(arm, np.repeat(heights, arm.columns, axis=0), column)
    return jnp.asarray(np.repeat(probs / arm.columns, arm.columns), dtype=jnp.float32), states


def arm_is_down(arm: MagnetArm, state: ArmState) -> Bool[Array, ""]:
    """The arm stands on the floor, or over a brick that itself rests on the floor or on another brick."""
    level = arm.rows - 1 - state.row.astype(jnp.int32)
    here = jnp.arange(arm.columns) == state.column.astype(jnp.int32)
    tower = jnp.sum(jnp.where(here, tower_heights(state), 0))
    return (level == 0) | (tower == level)


def arm_has_lifted(arm: MagnetArm, state: ArmState) -> Bool[Array, ""]:
    """The arm is in the top row with a brick in the cell below it and none below that."""
    row_1, row_2 = 1 << (arm.rows - 2), 1 << (arm.rows - 1) >> 2
    here = jnp.arange(arm.columns) == state.column.astype(jnp.int32)
    brick_in_air = (state.bricks.astype(jnp.int32) & (row_1 | row_2)) == row_1
    return (state.row == 0) & jnp.any(here & brick_in_air)


GOAL_REWARD = 100.0
"""What an option's training task pays at its end (authors' code)."""
SIDEWAYS_COST = 10.0
"""What the lift task takes for a step to the left or right (authors' code)."""


def _pay_for_going_down(arm: MagnetArm, state: ArmState, action: Int[Array, ""], next_state: ArmState) -> Array:
    del state, action
    return arm.step_reward + jnp.where(arm_is_down(arm, next_state), GOAL_REWARD, 0.0)


def _pay_for_lifting(arm: MagnetArm, state: ArmState, action: Int[Array, ""], next_state: ArmState) -> Array:
    del state
    sideways = jnp.where((action == LEFT) | (action == RIGHT), SIDEWAYS_COST, 0.0)
    return arm.step_reward - sideways + jnp.where(arm_has_lifted(arm, next_state), GOAL_REWARD, 0.0)


def go_down_task(arm: MagnetArm) -> Task:
    """Go down until the arm reaches a brick or the floor: the training environment of the paper's first option."""
    return Task(arm, "go-down", random_layouts, arm_is_down, _pay_for_going_down)


def lift_task(arm: MagnetArm) -> Task:
    """Go down, take a brick and lift it to the top: the training environment of the paper's second option."""
    return Task(arm, "lift", random_layouts, arm_has_lifted, _pay_for_lifting)


@dataclass(frozen=True)
class Holds:
    """A brick hangs on the arm, and the highest tower in the other columns has exactly the given height."""

    height: int

    def __call__(self, arm: MagnetArm, state: ArmState) -> Bool[Array, ""]:
        here = jnp.arange(arm.columns) == state.column.astype(jnp.int32)
        below = 1 << (arm.rows - 1 - state.row.astype(jnp.int32)) >> 1
        hangs = state.magnet & jnp.any(here & ((state.bricks.astype(jnp.int32) & below) != 0))
        return hangs & (jnp.max(jnp.where(here, 0, tower_heights(state))) == self.height)


@dataclass(frozen=True)
class Stands:
    """The magnet is off, and the highest tower has exactly the given height."""

    height: int

    def __call__(self, arm: MagnetArm, state: ArmState) -> Bool[Array, ""]:
        del arm
        return (jnp.max(tower_heights(state)) == self.height) & ~state.magnet


def tower_goals(arm: MagnetArm) -> tuple[Task, ...]:
    """Brick by brick: for each height from 2 to the wanted one, hold a brick beside a tower that lacks one, and let
    the higher tower stand."""
    goals: list[Task] = []
    for height in range(2, arm.tower_height + 1):
        goals.append(goal(arm, f"hold-{height}", Holds(height - 1)))
        goals.append(goal(arm, f"tower-{height}", Stands(height)))
    return tuple(goals)
