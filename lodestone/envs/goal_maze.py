"""A small maze with four goals, one of which is meant in each episode.

Corridors lead from junction to junction, so that a look at the maze is worth several steps.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int32, Num, UInt8
from PIL import Image, ImageDraw

from lodestone.envs.base import Environment
from lodestone.envs.four_rooms import AGENT, FLOOR, GOAL, PALETTE, STEPS, WALL
from lodestone.errors import InvalidConfig

MAZE = (
    "G..#..G",
    ".#...#.",
    ".##.##.",
    ".......",
    "##.#.##",
    "...#...",
    "G#...#G",
)
"""Walls `#`, goals `G`; episodes begin anywhere else."""
SQUARES = np.array([(row, column) for row in range(7) for column in range(7) if MAZE[row][column] != "#"])
"""Row and column of each cell. Cells are numbered row by row."""
CELLS = len(SQUARES)
GOALS = np.array([number for number, (row, column) in enumerate(SQUARES) if MAZE[row][column] == "G"], dtype=np.int32)
"""The cells of the goals: top left, top right, bottom left, bottom right."""


def _neighbours() -> Int32[np.ndarray, "cells 4"]:
    """Where each action leads; a wall, or the edge, holds it back."""
    number = {tuple(square): cell for cell, square in enumerate(SQUARES.tolist())}
    ahead = (SQUARES[:, None, :] + STEPS[None, :, :]).tolist()
    return np.array(
        [[number.get(tuple(square), cell) for square in ways] for cell, ways in enumerate(ahead)], dtype=np.int32
    )


NEIGHBOURS = _neighbours()


class GoalState(NamedTuple):
    """Where the agent is, and which of the goals is meant."""

    cell: Int32[Array, ""]
    goal: Int32[Array, ""]


class GoalMaze(Environment):
    """34 cells, four actions that do what they should; the episode begins in any cell that is no goal, and ends at the
    goal that is meant."""

    step_reward: float = eqx.field(static=True, default=-1.0)
    """Reward of every step."""
    goal_reward: float = eqx.field(static=True, default=20.0)
    """Reward added to the step that reaches the goal."""
    observation: Literal["rgb", "planes"] = eqx.field(static=True, default="rgb")
    """What the agent sees: a picture of the maze, or 0 and 1 in a plane each for walls, the goal and the agent."""
    pixels_per_cell: int = eqx.field(static=True, default=1)
    """Side of a square in the agent's picture, in pixels."""

    def __check_init__(self) -> None:
        for name in ("goal_reward", "step_reward"):
            if not np.isfinite(getattr(self, name)):
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be a finite number.")
        if self.observation not in ("rgb", "planes"):
            raise InvalidConfig(f"observation is {self.observation!r}, but must be 'rgb' or 'planes'.")
        if self.pixels_per_cell < 1:
            raise InvalidConfig(f"pixels_per_cell is {self.pixels_per_cell}, but must be at least 1.")

    @property
    def action_names(self) -> tuple[str, ...]:
        return ("up", "down", "left", "right")

    @property
    def num_outcomes(self) -> int:
        return 1

    def initial_distribution(self) -> tuple[Float[Array, " 120"], GoalState]:
        """Any cell but the four goals, with any of the goals."""
        cells, goals = np.meshgrid(np.setdiff1d(np.arange(CELLS, dtype=np.int32), GOALS), GOALS, indexing="ij")
        states = GoalState(jnp.asarray(cells.ravel()), jnp.asarray(goals.ravel()))
        return jnp.full(cells.size, 1 / cells.size, dtype=jnp.float32), states

    def outcome_probs(self, state: GoalState, action: Int[Array, ""]) -> Float[Array, " 1"]:
        del state, action
        return jnp.ones(1)

    def transition(self, state: GoalState, action: Int[Array, ""], outcome: Int[Array, ""]) -> GoalState:
        del outcome
        return state._replace(cell=jnp.asarray(NEIGHBOURS)[state.cell, action])

    def reward(self, state: GoalState, action: Int[Array, ""], next_state: GoalState) -> Float[Array, ""]:
        del state, action
        arrived = jnp.float32(self.step_reward + self.goal_reward)
        return jnp.where(self.terminal(next_state), arrived, jnp.float32(self.step_reward))

    def terminal(self, state: GoalState) -> Bool[Array, ""]:
        """The agent is at the goal that is meant."""
        return state.cell == state.goal

    def observe(self, state: GoalState) -> Num[Array, "height width 3"]:
        """`rgb`: uint8 [7 * pixels, 7 * pixels, 3]; `planes`: int8 [7, 7, 3]."""
        cell, goal = (jnp.zeros((7, 7), bool).at[tuple(jnp.asarray(SQUARES)[at])].set(True) for at in state)
        walls = jnp.asarray(WALLS)
        if self.observation == "planes":
            return jnp.stack([walls, goal, cell], axis=-1).astype(jnp.int8)
        codes = jnp.where(cell, AGENT, jnp.where(goal, GOAL, jnp.where(walls, WALL, FLOOR)))
        side = self.pixels_per_cell
        return jnp.repeat(jnp.repeat(jnp.asarray(PALETTE)[codes], side, axis=0), side, axis=1)

    def render(self, state: GoalState) -> UInt8[np.ndarray, "height width 3"]:
        """The maze from above: the goal that is meant as a green square, the others pale, the agent as a red disc."""
        side = 40
        colours = PALETTE[np.where(WALLS, WALL, FLOOR)]
        colours[tuple(SQUARES[GOALS].T)] = PALE
        colours[tuple(SQUARES[int(state.goal)])] = PALETTE[GOAL]
        picture = Image.fromarray(np.repeat(np.repeat(colours, side, axis=0), side, axis=1))
        row, column = SQUARES[int(state.cell)].tolist()
        red, green, blue = PALETTE[AGENT].tolist()
        ImageDraw.Draw(picture).ellipse(
            (column * side + 7, row * side + 7, (column + 1) * side - 8, (row + 1) * side - 8), (red, green, blue)
        )
        return np.asarray(picture)


WALLS = np.array([[square == "#" for square in row] for row in MAZE])
PALE = np.array((190, 222, 202), dtype=np.uint8)
"""Colour, for people, of the goals that are not meant."""
