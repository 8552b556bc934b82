"""Four Rooms: a house of four rooms joined by four hallways (Sutton, Precup and Singh 1999, section 5).

Three kinds of chance go by this name in the literature and give different numbers; here each has a name of its own.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int32, UInt8
from PIL import Image, ImageDraw

from lodestone.envs.base import Environment
from lodestone.errors import InvalidConfig

STEPS = np.array([(-1, 0), (1, 0), (0, -1), (0, 1)])
"""Row and column by which each action moves: up, down, left, right."""

HALLWAYS = ((3, 6), (6, 2), (7, 9), (10, 6))
"""Row and column of each hallway."""


def _house() -> Bool[np.ndarray, "13 13"]:
    """Which squares are free: the outer walls, a wall from top to bottom, one to each side of it, and the hallways."""
    free = np.ones((13, 13), dtype=bool)
    free[[0, -1], :] = free[:, [0, -1]] = False
    free[:, 6] = free[6, :6] = free[7, 7:] = False
    for hallway in HALLWAYS:
        free[hallway] = True
    return free


FREE = _house()
SQUARES = np.argwhere(FREE)
"""Row and column of each cell. Cells are numbered row by row."""
CELLS = len(SQUARES)
NUMBER = np.full(FREE.shape, -1)
NUMBER[FREE] = np.arange(CELLS)
"""The cell of each square; -1 in a wall."""


def _neighbours() -> Int32[np.ndarray, "cells 4"]:
    """Where each action leads; a wall holds it back."""
    ahead = SQUARES[:, None, :] + STEPS[None, :, :]
    cell = NUMBER[ahead[..., 0], ahead[..., 1]]
    return np.where(cell >= 0, cell, np.arange(CELLS)[:, None]).astype(np.int32)


NEIGHBOURS = _neighbours()
OPEN = np.arange(CELLS)[:, None] != NEIGHBOURS
"""Whether there is a free square in each direction."""

WALL, FLOOR, GOAL, AGENT = range(4)
PALETTE = np.array([(70, 76, 86), (246, 246, 242), (34, 150, 84), (204, 60, 40)], dtype=np.uint8)
"""Colour of walls, floor, goal and agent."""

Dynamics = Literal["deterministic", "sps", "text", "code"]


class RoomState(NamedTuple):
    """Where the agent is."""

    cell: UInt8[Array, ""]


class FourRooms(Environment):
    """104 cells, four actions; the episode ends at the goal."""

    dynamics: Dynamics = eqx.field(static=True, default="sps")
    """What chance does. `sps`: a move goes where it should with probability 2/3, else in one of the other directions
    (Sutton, Precup and Singh). `text`: with 1/3 it goes to a free neighbour of the cell instead (the words of Bacon,
    Harb and Precup). `code`: with 1/3 a move that succeeded is followed by a second one to a free neighbour of the new
    cell (their code)."""
    goal: int = eqx.field(static=True, default=62)
    """The cell where the episode ends, numbered row by row; 62 is the hallway in the east."""
    goal_reward: float = eqx.field(static=True, default=1.0)
    """Reward added to the step that reaches the goal."""
    step_reward: float = eqx.field(static=True, default=0.0)
    """Reward of every step."""
    observation: Literal["rgb", "cell"] = eqx.field(static=True, default="rgb")
    """What the agent sees: a picture of the house, or the number of the cell."""
    pixels_per_cell: int = eqx.field(static=True, default=1)
    """Side of a square in the agent's picture, in pixels."""

    def __check_init__(self) -> None:
        if self.dynamics not in get_args(Dynamics):
            raise InvalidConfig(f"dynamics is {self.dynamics!r}, but must be one of {', '.join(get_args(Dynamics))}.")
        if not 0 <= self.goal < CELLS:
            raise InvalidConfig(f"goal is {self.goal}, but cells are numbered from 0 to {CELLS - 1}.")
        if self.observation not in ("rgb", "cell"):
            raise InvalidConfig(f"observation is {self.observation!r}, but must be 'rgb' or 'cell'.")
        if self.pixels_per_cell < 1:
            raise InvalidConfig(f"pixels_per_cell is {self.pixels_per_cell}, but must be at least 1.")
        for name in ("goal_reward", "step_reward"):
            if not np.isfinite(getattr(self, name)):
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be a finite number.")

    @property
    def action_names(self) -> tuple[str, ...]:
        return ("up", "down", "left", "right")

    @property
    def num_outcomes(self) -> int:
        """`sps`: the direction that was taken. `text`, `code`: 0 for no slip, else one more than its direction."""
        return {"deterministic": 1, "sps": 4, "text": 5, "code": 5}[self.dynamics]

    def initial_distribution(self) -> tuple[Float[Array, " I"], RoomState]:
        """Any cell but the goal."""
        cells = np.delete(np.arange(CELLS), self.goal)
        return jnp.full(len(cells), 1 / len(cells), dtype=jnp.float32), RoomState(jnp.asarray(cells, dtype=jnp.uint8))

    def outcome_probs(self, state: RoomState, action: Int[Array, ""]) -> Float[Array, " K"]:
        if self.dynamics == "deterministic":
            return jnp.ones(1)
        if self.dynamics == "sps":
            return jnp.where(jnp.arange(4) == action, 2 / 3, 1 / 9).astype(jnp.float32)
        here = state.cell.astype(jnp.int32)
        ahead = jnp.asarray(NEIGHBOURS)[here, action]
        slips_from = here if self.dynamics == "text" else ahead
        free = jnp.asarray(OPEN)[slips_from].astype(jnp.float32)
        may_slip = ahead != here if self.dynamics == "code" else jnp.bool_(True)
        slip = jnp.where(may_slip, jnp.float32(1 / 3), 0.0)
        return jnp.concatenate([(1 - slip)[None], slip * free / jnp.sum(free)])

    def transition(self, state: RoomState, action: Int[Array, ""], outcome: Int[Array, ""]) -> RoomState:
        neighbours, here = jnp.asarray(NEIGHBOURS), state.cell.astype(jnp.int32)
        if self.dynamics == "sps":
            return RoomState(neighbours[here, outcome].astype(jnp.uint8))
        ahead = neighbours[here, action]
        slips_from = here if self.dynamics == "text" else ahead
        return RoomState(jnp.where(outcome == 0, ahead, neighbours[slips_from, outcome - 1]).astype(jnp.uint8))

    def reward(self, state: RoomState, action: Int[Array, ""], next_state: RoomState) -> Float[Array, ""]:
        del state, action
        return jnp.where(self.terminal(next_state), self.step_reward + self.goal_reward, self.step_reward)

    def terminal(self, state: RoomState) -> Bool[Array, ""]:
        return state.cell == self.goal

    def observe(self, state: RoomState) -> UInt8[Array, "height width 3"] | Int[Array, ""]:
        if self.observation == "cell":
            return state.cell.astype(jnp.int32)
        here = jnp.asarray(NUMBER.astype(np.int32)) == state.cell.astype(jnp.int32)
        codes = jnp.where(here, AGENT, jnp.asarray(self._house_with_goal()))
        picture = jnp.asarray(PALETTE)[codes]
        side = self.pixels_per_cell
        return jnp.repeat(jnp.repeat(picture, side, axis=0), side, axis=1)

    def _house_with_goal(self) -> Int[np.ndarray, "13 13"]:
        codes = np.where(FREE, FLOOR, WALL)
        codes[tuple(SQUARES[self.goal])] = GOAL
        return codes

    def render(self, state: RoomState) -> UInt8[np.ndarray, "height width 3"]:
        """The house from above, the goal as a green square, the agent as a red disc."""
        side = 28
        pixels = np.repeat(np.repeat(PALETTE[self._house_with_goal()], side, axis=0), side, axis=1)
        picture = Image.fromarray(pixels)
        draw = ImageDraw.Draw(picture)
        for line in range(side, 13 * side, side):
            draw.line([(line, 0), (line, 13 * side)], fill=(226, 228, 232))
            draw.line([(0, line), (13 * side, line)], fill=(226, 228, 232))
        for row, column in np.argwhere(~FREE):
            draw.rectangle(
                [column * side, row * side, (column + 1) * side - 1, (row + 1) * side - 1], fill=tuple(PALETTE[WALL])
            )
        row, column = SQUARES[int(state.cell)]
        draw.ellipse(
            [column * side + 5, row * side + 5, (column + 1) * side - 5, (row + 1) * side - 5],
            fill=tuple(int(channel) for channel in PALETTE[AGENT]),
        )
        return np.asarray(picture)
