"""A maze of corridors with obstacles, of the kind on which Parr and Russell (1997) showed hierarchies of machines.

A lattice of square intersections is joined by corridors, most of which hold an obstacle that leaves one cell to pass
by. What to do inside a corridor is the same everywhere; where to go is decided at the few intersections. Their own maze
is not published; this one has about as many states.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int32, UInt8
from PIL import Image, ImageDraw

from lodestone.envs.base import Environment
from lodestone.envs.four_rooms import AGENT, FLOOR, GOAL, PALETTE, STEPS, WALL
from lodestone.errors import InvalidConfig

UP, DOWN, LEFT, RIGHT = range(4)
"""The actions, and the directions that `CorridorMaze.blocked` takes."""

DIRECTIONS = np.array([(UP, LEFT, RIGHT), (DOWN, LEFT, RIGHT), (LEFT, UP, DOWN), (RIGHT, UP, DOWN)], dtype=np.int32)
"""Where each action goes: as intended, or off to one side or the other."""


class MazeLayout(NamedTuple):
    """Where everything is: H rows and W columns of squares, the outer walls included, and their C free cells. The
    arrays are shared and read-only."""

    free: Bool[np.ndarray, "H W"]
    """Which squares are neither wall nor obstacle."""
    obstacles: Bool[np.ndarray, "H W"]
    """Which squares are obstacles."""
    squares: Int32[np.ndarray, "C 2"]
    """Row and column of each cell. Cells are numbered row by row."""
    neighbours: Int32[np.ndarray, "C 4"]
    """The cell that each direction leads to; walls and obstacles hold back."""
    intersections: Bool[np.ndarray, " C"]
    """Which cells belong to an intersection."""
    start: int
    """The cell in the middle of the first intersection, top left."""
    goal: int
    """The cell in the middle of the last intersection, bottom right."""


@lru_cache(maxsize=64)
def maze_layout(rows: int, columns: int, width: int, length: int, obstacle_prob: float, maze_seed: int) -> MazeLayout:
    """The maze of these parameters of `CorridorMaze`, which says what they mean; remembered."""
    pitch = width + length
    first = 1 + pitch * np.arange(max(rows, columns))
    free = np.zeros((rows * pitch - length + 2, columns * pitch - length + 2), dtype=bool)
    obstacles, intersections = np.zeros_like(free), np.zeros_like(free)
    rng = np.random.default_rng(maze_seed)

    def join(corridor: Bool[np.ndarray, "length width"], blocks: Bool[np.ndarray, "length width"]) -> None:
        """Open a corridor, given as the parts of `free` and `obstacles` where it is, and perhaps put an obstacle in."""
        corridor[:] = True
        # All is drawn whether it is used or not, so that fewer obstacles are some of the same obstacles.
        drawn, place, side = rng.random(), rng.integers(1, length - 1), rng.integers(2)
        if drawn < obstacle_prob:
            blocks[place, side : side + width - 1] = True

    for row in range(rows):
        for column in range(columns):
            top, left = first[row], first[column]
            bottom, right = top + width, left + width
            intersections[top:bottom, left:right] = True
            if column + 1 < columns:
                to_right = slice(top, bottom), slice(right, right + length)
                join(free[to_right].T, obstacles[to_right].T)
            if row + 1 < rows:
                down = slice(bottom, bottom + length), slice(left, right)
                join(free[down], obstacles[down])
    free = (free | intersections) & ~obstacles

    squares = np.argwhere(free).astype(np.int32)
    number = np.full(free.shape, -1)
    number[free] = np.arange(len(squares))
    ahead = squares[:, None, :] + STEPS[None, :, :]
    cell = number[ahead[..., 0], ahead[..., 1]]
    neighbours = np.where(cell >= 0, cell, np.arange(len(squares))[:, None]).astype(np.int32)
    at_intersection = intersections[free]
    for array in (free, obstacles, squares, neighbours, at_intersection):
        array.setflags(write=False)
    half = width // 2
    start = int(number[first[0] + half, first[0] + half])
    goal = int(number[first[rows - 1] + half, first[columns - 1] + half])
    return MazeLayout(free, obstacles, squares, neighbours, at_intersection, start, goal)


MAX_SQUARES = 1_000_000
"""Of a maze, walls included."""


class MazeState(NamedTuple):
    """Where the agent is."""

    cell: Int32[Array, ""]


class CorridorMaze(Environment):
    """Thousands of cells, four actions; the episode begins at the top left and ends at the bottom right."""

    rows: int = eqx.field(static=True, default=8)
    """Intersections from top to bottom."""
    columns: int = eqx.field(static=True, default=8)
    """Intersections from left to right."""
    width: int = eqx.field(static=True, default=3)
    """Cells across a corridor, and along each side of an intersection."""
    length: int = eqx.field(static=True, default=9)
    """Cells along a corridor, from one intersection to the next."""
    obstacle_prob: float = eqx.field(static=True, default=0.75)
    """Probability that a corridor holds an obstacle: one cell long, at one of the two walls, all but one cell wide, and
    not beside an intersection."""
    maze_seed: int = eqx.field(static=True, default=0)
    """Which obstacles are drawn."""
    move_success: float = eqx.field(static=True, default=0.8)
    """Probability that a move goes where it should; else it goes to one side or the other, with equal chance."""
    step_reward: float = eqx.field(static=True, default=-1.0)
    """Reward of every step."""
    goal_reward: float = eqx.field(static=True, default=100.0)
    """Reward added to the step that reaches the goal."""
    observation: Literal["rgb", "cell"] = eqx.field(static=True, default="rgb")
    """What the agent sees: a picture of the maze, or the number of the cell."""
    pixels_per_cell: int = eqx.field(static=True, default=1)
    """Side of a square in the agent's picture, in pixels."""

    def __check_init__(self) -> None:
        for name, least in (("rows", 1), ("columns", 1), ("width", 1), ("length", 3), ("pixels_per_cell", 1)):
            if getattr(self, name) < least:
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be at least {least}.")
        if self.rows * self.columns * (self.width + self.length) ** 2 > MAX_SQUARES:
            raise InvalidConfig(
                f"A maze of {self.rows} x {self.columns} intersections, corridors {self.width} wide and {self.length} "
                f"long has more than {MAX_SQUARES} squares."
            )
        if self.rows * self.columns < 2:
            raise InvalidConfig("rows and columns are both 1, but start and goal need two intersections.")
        for name in ("obstacle_prob", "move_success"):
            if not 0 <= getattr(self, name) <= 1:
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be a probability from 0 to 1.")
        if self.maze_seed < 0:
            raise InvalidConfig(f"maze_seed is {self.maze_seed}, but must not be negative.")
        for name in ("goal_reward", "step_reward"):
            if not np.isfinite(getattr(self, name)):
                raise InvalidConfig(f"{name} is {getattr(self, name)}, but must be a finite number.")
        if self.observation not in ("rgb", "cell"):
            raise InvalidConfig(f"observation is {self.observation!r}, but must be 'rgb' or 'cell'.")

    @property
    def layout(self) -> MazeLayout:
        """Where walls, obstacles and intersections are."""
        return maze_layout(self.rows, self.columns, self.width, self.length, self.obstacle_prob, self.maze_seed)

    @property
    def action_names(self) -> tuple[str, ...]:
        return ("up", "down", "left", "right")

    @property
    def num_outcomes(self) -> int:
        """As intended, to one side, or to the other; only the first, if moves never slip."""
        return 1 if self.move_success == 1 else 3

    def initial_distribution(self) -> tuple[Float[Array, " 1"], MazeState]:
        """One start: the middle of the first intersection."""
        return jnp.ones(1), MazeState(jnp.array([self.layout.start], dtype=jnp.int32))

    def outcome_probs(self, state: MazeState, action: Int[Array, ""]) -> Float[Array, " K"]:
        del state, action
        if self.move_success == 1:
            return jnp.ones(1)
        aside = (1 - self.move_success) / 2
        return jnp.array([self.move_success, aside, aside], dtype=jnp.float32)

    def transition(self, state: MazeState, action: Int[Array, ""], outcome: Int[Array, ""]) -> MazeState:
        direction = jnp.asarray(DIRECTIONS)[action, outcome]
        return MazeState(jnp.asarray(self.layout.neighbours)[state.cell, direction])

    def reward(self, state: MazeState, action: Int[Array, ""], next_state: MazeState) -> Float[Array, ""]:
        del state, action
        arrived = jnp.float32(self.step_reward + self.goal_reward)
        return jnp.where(self.terminal(next_state), arrived, jnp.float32(self.step_reward))

    def terminal(self, state: MazeState) -> Bool[Array, ""]:
        """The agent is at the goal."""
        return state.cell == self.layout.goal

    def at_intersection(self, state: MazeState) -> Bool[Array, ""]:
        """Whether the agent is in an intersection, and not in a corridor."""
        return jnp.asarray(self.layout.intersections)[state.cell]

    def blocked(self, state: MazeState, direction: Int[Array, ""]) -> Bool[Array, ""]:
        """Whether the next square in a direction (`UP`, `DOWN`, `LEFT`, `RIGHT`) is a wall or an obstacle."""
        return jnp.asarray(self.layout.neighbours)[state.cell, direction] == state.cell

    def observe(self, state: MazeState) -> UInt8[Array, "height width 3"] | Int[Array, ""]:
        """`rgb`: uint8 [H * pixels, W * pixels, 3]; `cell`: int32 [], the number of the cell, row by row."""
        if self.observation == "cell":
            return state.cell
        side = self.pixels_per_cell
        maze = np.repeat(np.repeat(PALETTE[_codes(self)], side, axis=0), side, axis=1)
        height, width = (np.arange(length) // side for length in maze.shape[:2])
        row, column = jnp.asarray(self.layout.squares)[state.cell]
        here = (jnp.asarray(height) == row)[:, None] & (jnp.asarray(width) == column)[None, :]
        return jnp.where(here[..., None], jnp.asarray(PALETTE[AGENT])[None, None], jnp.asarray(maze))

    def render(self, state: MazeState) -> UInt8[np.ndarray, "height width 3"]:
        """The maze from above, obstacles brown, the goal as a green square, the agent as a red disc."""
        picture, side = _background(self).copy(), _side(self)
        row, column = self.layout.squares[int(state.cell)].tolist()
        disc = Image.new("L", (side * SMOOTH,) * 2)
        ImageDraw.Draw(disc).ellipse((0, 0, side * SMOOTH - 1, side * SMOOTH - 1), 255)
        red, green, blue = PALETTE[AGENT].tolist()
        picture.paste((red, green, blue), (column * side, row * side), disc.reduce(SMOOTH))
        return np.asarray(picture)


SMOOTH = 4
"""The agent's disc is painted this many times larger and then reduced, for a smooth edge."""
OBSTACLE = np.array((176, 128, 84), dtype=np.uint8)
"""Colour of obstacles, for people; the agent sees them as walls."""
TILE = np.array((232, 233, 232), dtype=np.uint8)
"""Colour of the floor of intersections, for people."""


def _codes(maze: CorridorMaze) -> Int[np.ndarray, "H W"]:
    codes = np.where(maze.layout.free, FLOOR, WALL)
    codes[tuple(maze.layout.squares[maze.layout.goal])] = GOAL
    return codes


def _side(maze: CorridorMaze) -> int:
    """Side of a square in the picture for people, in pixels."""
    return int(np.clip(720 // max(maze.layout.free.shape), 4, 28))


@cache
def _background(maze: CorridorMaze) -> Image.Image:
    """All but the agent."""
    layout, side = maze.layout, _side(maze)
    colours = PALETTE[_codes(maze)]
    colours[layout.obstacles] = OBSTACLE
    rows, columns = layout.squares[layout.intersections & (np.arange(len(layout.squares)) != layout.goal)].T
    colours[rows, columns] = TILE
    return Image.fromarray(np.repeat(np.repeat(colours, side, axis=0), side, axis=1))
