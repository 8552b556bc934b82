"""The four rooms without chance and without a goal, as discovery sees them, and a grid of two rooms with one door."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Int32

from lodestone.discovery.knowledge import Knowledge, everything_without_task
from lodestone.envs.base import Environment
from lodestone.envs.four_rooms import SQUARES, STEPS, FourRooms

HOUSE = FourRooms("deterministic")


@cache
def house() -> Knowledge:
    """Everything about it."""
    return everything_without_task(HOUSE)


def square(state: int) -> tuple[int, int]:
    """Row and column of a state."""
    row, column = SQUARES[int(np.asarray(house().tables.space.states.cell)[state])]
    return int(row), int(column)


def state_at(row: int, column: int) -> int:
    """The state of a square."""
    cells = SQUARES[np.asarray(house().tables.space.states.cell)]
    return int(np.flatnonzero((cells == (row, column)).all(axis=1))[0])


class Place(NamedTuple):
    """Where the agent is."""

    cell: Int32[Array, ""]


class TwoRoomGrid(Environment):
    """10 x 10 squares, a wall in column 5 with a door in row 4. Episodes begin anywhere to its left and end at (8, 8)
    (after the two rooms of McGovern and Barto 2001)."""

    doors: tuple[int, ...] = eqx.field(static=True, default=(4,))

    @property
    def free(self) -> Bool[np.ndarray, "10 10"]:
        """Which squares are no wall."""
        free = np.ones((10, 10), dtype=bool)
        free[:, 5] = np.isin(np.arange(10), self.doors)
        return free

    @property
    def squares(self) -> Int[np.ndarray, "C 2"]:
        """Row and column of each cell."""
        return np.argwhere(self.free)

    @property
    def goal(self) -> int:
        """The cell at (8, 8)."""
        return int(np.flatnonzero((self.squares == 8).all(axis=1))[0])

    @property
    def action_names(self) -> tuple[str, ...]:
        return ("up", "down", "left", "right")

    @property
    def num_outcomes(self) -> int:
        return 1

    def initial_distribution(self) -> tuple[Float[Array, " I"], Place]:
        cells = np.flatnonzero(self.squares[:, 1] < 5)
        return jnp.full(len(cells), 1 / len(cells), jnp.float32), Place(jnp.asarray(cells, jnp.int32))

    def outcome_probs(self, state: Place, action: Int[Array, ""]) -> Float[Array, " 1"]:
        return jnp.ones(1)

    def transition(self, state: Place, action: Int[Array, ""], outcome: Int[Array, ""]) -> Place:
        number = np.full((12, 12), -1)
        number[1:-1, 1:-1][self.free] = np.arange(len(self.squares))
        ahead = self.squares[:, None] + STEPS + 1
        cell = number[ahead[..., 0], ahead[..., 1]]
        following = np.where(cell >= 0, cell, np.arange(len(cell))[:, None]).astype(np.int32)
        return Place(jnp.asarray(following)[state.cell, action])

    def reward(self, state: Place, action: Int[Array, ""], next_state: Place) -> Float[Array, ""]:
        return jnp.float32(0)

    def terminal(self, state: Place) -> Bool[Array, ""]:
        return state.cell == self.goal

    def observe(self, state: Place) -> Int[Array, ""]:
        return state.cell

    def render(self, state: Place) -> np.ndarray:
        raise NotImplementedError
