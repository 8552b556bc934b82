"""The task graph of the two rooms: first leave the left room, then go to the goal (after Dietterich 2000, figure 6)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lodestone.envs.two_rooms import GOAL, TwoRooms, TwoRoomsState
from lodestone.subtasks.task_graph import Child, Subtask, TaskGraph


def two_rooms_tasks(rooms: TwoRooms) -> TaskGraph:
    """Root{exit, go}, both over north, south and east.

    The pseudo-reward of *exit* is what is still to come, so that with it the best policy is found. Without it *exit*
    takes the nearer door.
    """
    moves = tuple(Child(name) for name in rooms.action_names)
    return TaskGraph(
        (
            Subtask("root", rooms.terminal, (Child("exit", when=rooms.in_left_room), Child("go", when=_in_right_room))),
            Subtask("exit", _in_right_room, moves, pseudo_reward=_way_to_goal),
            Subtask("go", rooms.terminal, moves),
        )
    )


def _in_right_room(state: TwoRoomsState) -> Bool[Array, ""]:
    return ~TwoRooms().in_left_room(state)


def _way_to_goal(state: TwoRoomsState) -> Float[Array, ""]:
    """Minus the steps to the goal, of a state that has not missed it."""
    rows = jnp.abs(state.row.astype(jnp.float32) - GOAL[0])
    return -(rows + jnp.abs(state.column.astype(jnp.float32) - GOAL[1]))
