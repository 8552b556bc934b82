"""The magnet arm as one would write it with NumPy and Gymnasium: a grid, loops, one environment at a time.

It is written from the rules alone, shares no code with `lodestone.envs.magnet_arm`, and serves twice: the tests compare
the two step by step, and `benchmarks/environment.py` compares their speed.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

LEFT, UP, RIGHT, DOWN, MAGNET_ON, MAGNET_OFF = range(6)
MOVES = {LEFT: (0, -1), UP: (-1, 0), RIGHT: (0, 1), DOWN: (1, 0)}


def tiles(pixels: int) -> np.ndarray:
    """Pictures of an empty cell, a brick, the arm with the magnet on, and with the magnet off: uint8 [4, p, p, 3]."""
    pictures = np.zeros((4, pixels, pixels, 3), dtype=np.uint8)
    pictures[1] = 230, 200, 150
    for code, colour in ((2, (51, 153, 255)), (3, (204, 0, 0))):
        pictures[code, :, pixels // 2] = colour
        pictures[code, -1, :] = colour
    return pictures


class NumpyMagnetArm(gymnasium.Env[np.ndarray, int]):
    """Observations are pictures, uint8 [rows * pixels, columns * pixels, 3], or without `pictures` the cell codes,
    uint8 [rows, columns]: 0 empty, 1 brick, 2 arm with the magnet on, 3 arm with the magnet off."""

    def __init__(
        self,
        rows: int = 4,
        columns: int = 3,
        bricks: int = 3,
        tower_height: int = 3,
        step_limit: int = 200,
        step_reward: float = -1.0,
        tower_reward: float = 100.0,
        pixels_per_cell: int = 3,
        sticky_magnet: bool = True,
        pictures: bool = True,
    ) -> None:
        self.rows, self.columns, self.bricks, self.tower_height = rows, columns, bricks, tower_height
        self.step_limit, self.step_reward, self.tower_reward = step_limit, step_reward, tower_reward
        self.sticky_magnet, self.pictures = sticky_magnet, pictures
        self.tiles = tiles(pixels_per_cell)
        shape = (rows * pixels_per_cell, columns * pixels_per_cell, 3) if pictures else (rows, columns)
        self.observation_space = spaces.Box(0, 255, shape, np.uint8)
        self.action_space = spaces.Discrete(6)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.grid = np.zeros((self.rows, self.columns), dtype=bool)
        for brick in range(self.bricks):
            row, column = divmod(brick, self.columns)
            self.grid[self.rows - 1 - row, self.columns - 1 - column] = True
        self.row, self.column, self.magnet, self.steps = 0, 0, False, 0
        return self.observation(), {"success": False}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if action in MOVES:
            self._move(*MOVES[action])
        elif action == MAGNET_ON:
            self.magnet = True
        else:
            self._switch_off()
        self.steps += 1
        success = not self.magnet and self.height() == self.tower_height
        reward = self.step_reward + self.tower_reward * success
        return self.observation(), reward, success, self.steps >= self.step_limit and not success, {"success": success}

    def _brick_below(self) -> bool:
        return self.row + 1 < self.rows and bool(self.grid[self.row + 1, self.column])

    def _free(self, row: int, column: int) -> bool:
        return 0 <= row < self.rows and 0 <= column < self.columns and not self.grid[row, column]

    def _move(self, rows: int, columns: int) -> None:
        row, column = self.row + rows, self.column + columns
        if not (self.magnet and self._brick_below()):
            if self._free(row, column):
                self.row, self.column = row, column
            return
        self.grid[self.row + 1, self.column] = False
        if self._free(row, column) and self._free(row + 1, column):
            self.row, self.column = row, column
        self.grid[self.row + 1, self.column] = True

    def _switch_off(self) -> None:
        if self.magnet and self._brick_below():
            self.grid[self.row + 1, self.column] = False
            landing = self.row + 1
            while self._free(landing + 1, self.column):
                landing += 1
            self.grid[landing, self.column] = True
            self.magnet = False
        elif not self.sticky_magnet:
            self.magnet = False

    def height(self) -> int:
        """Of the highest tower; a brick in the air is none."""
        return max(self._column_height(column) for column in range(self.columns))

    def _column_height(self, column: int) -> int:
        cells = self.grid[:, column]
        for row in range(self.rows - 1, 0, -1):
            supported = row == self.rows - 1 or cells[row + 1]
            if cells[row] and not cells[row - 1] and supported:
                return self.rows - row
        return 0

    def observation(self) -> np.ndarray:
        codes = self.grid.astype(np.uint8)
        codes[self.row, self.column] = 2 if self.magnet else 3
        if not self.pictures:
            return codes
        return self.tiles[codes].transpose(0, 2, 1, 3, 4).reshape(self.observation_space.shape)
