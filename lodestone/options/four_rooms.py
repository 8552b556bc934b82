"""The hallway options of Four Rooms (Sutton, Precup and Singh 1999, section 5).

Each takes the agent out of a room by one of its two hallways. It is given where to get; how, is the exact optimum of a
problem of its own.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from lodestone.envs.four_rooms import CELLS, HALLWAYS, NUMBER, SQUARES, FourRooms
from lodestone.envs.state_space import reachable_states
from lodestone.options.base import NO_CAP
from lodestone.options.subgoals import Subgoal, solve_subgoal
from lodestone.options.tabular import TabularOptions
from lodestone.planning.solve import greedy_choices
from lodestone.planning.tables import tabulate

DOORS = dict(zip(("north", "west", "east", "south"), (int(NUMBER[hallway]) for hallway in HALLWAYS), strict=True))
"""The cell of each hallway."""

ROOMS = {
    "north-west": ((1, 1), (5, 5), ("north", "west")),
    "north-east": ((1, 7), (6, 11), ("north", "east")),
    "south-west": ((7, 1), (11, 5), ("west", "south")),
    "south-east": ((8, 7), (11, 11), ("east", "south")),
}
"""First and last square of each room, and its two hallways."""

HALLWAY_OPTIONS = tuple(f"{room}-to-{door}" for room, (_, _, doors) in ROOMS.items() for door in doors)
"""Names of the eight options."""


def hallway_options(rooms: FourRooms, discount: float = 0.9) -> TabularOptions:
    """Eight options, one for each hallway of each room.

    An option may start anywhere in its room and in the room's other hallway; it stops outside the room and at the goal.
    Its policy has the highest expected discount^k for the k steps to its hallway, where leaving the cells in which it
    may start by any other way is worth 0. Of equally good actions the first is taken.
    """
    may_start, policies, goes_on = [], [], []
    for first, last, doors in ROOMS.values():
        inside = np.all((first <= SQUARES) & (last >= SQUARES), axis=1)
        for door, other in (doors, doors[::-1]):
            starts = inside | (np.arange(CELLS) == DOORS[other])
            may_start.append(starts)
            policies.append(_policy(rooms, DOORS[door], starts, discount))
            goes_on.append(inside & (np.arange(CELLS) != rooms.goal))
    space = reachable_states(rooms)
    cell = np.asarray(space.states.cell)
    return TabularOptions(
        space,
        HALLWAY_OPTIONS,
        (NO_CAP,) * len(HALLWAY_OPTIONS),
        initiation_table=jnp.asarray(np.stack(may_start, axis=1)[cell]),
        policy_table=jnp.asarray(np.eye(rooms.num_actions, dtype=np.float32)[np.stack(policies, axis=1)[cell]]),
        termination_table=jnp.asarray(~np.stack(goes_on, axis=1)[cell], dtype=jnp.float32),
    )


def _policy(
    rooms: FourRooms, door: int, region: Bool[np.ndarray, " cells"], discount: float
) -> Int[np.ndarray, " cells"]:
    """The best action of each cell. The goal of the house is moved to the door, where it is in nobody's way."""
    tables = tabulate(dataclasses.replace(rooms, goal=door))
    cell = np.asarray(tables.space.states.cell)
    subgoal = Subgoal("door", region[cell], values=(cell == door).astype(np.float64))
    policy = np.zeros(CELLS, dtype=np.int64)
    policy[cell] = greedy_choices(solve_subgoal(tables, subgoal, discount).action_values)
    return policy
