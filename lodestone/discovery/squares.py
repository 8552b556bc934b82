"""Where states are, for environments whose states are squares of a grid."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from lodestone.envs.base import Environment
from lodestone.envs.corridor_maze import CorridorMaze
from lodestone.envs.four_rooms import SQUARES, FourRooms
from lodestone.envs.state_space import StateSpace
from lodestone.envs.task import Task
from lodestone.envs.two_rooms import TwoRooms


def squares_of(environment: Environment, space: StateSpace) -> Int[np.ndarray, "S 2"] | None:
    """Row and column of every state; None where a state is more than a square."""
    states = space.states
    match environment:
        case Task():
            return squares_of(environment.environment, space)
        case FourRooms():
            return SQUARES[np.asarray(states.cell)]
        case CorridorMaze():
            return environment.layout.squares[np.asarray(states.cell)]
        case TwoRooms():
            return np.stack([np.asarray(states.row), np.asarray(states.column)], axis=1).astype(np.int64)
    return None
