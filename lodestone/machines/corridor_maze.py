"""A machine that walks a maze of corridors, of the kind of Parr and Russell (1997).

What is left open is where to go at an intersection, and how to get round an obstacle.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool

from lodestone.envs.corridor_maze import CorridorMaze, MazeState
from lodestone.machines.machine import Action, Branch, Call, Choice, Hierarchy, Machine, Parameter, Predicate, Stop

SIDES = {"up": ("left", "right"), "down": ("right", "left"), "left": ("down", "up"), "right": ("up", "down")}
"""What is to the left and to the right of one who looks in each direction."""
BACK = {"up": "down", "down": "up", "left": "right", "right": "left"}
"""What is behind."""


def at_intersection(maze: CorridorMaze, state: MazeState) -> Bool[Array, ""]:
    """Whether the agent is in an intersection, and not in a corridor."""
    return maze.at_intersection(state)


def blocked(maze: CorridorMaze, state: MazeState, direction: str) -> Bool[Array, ""]:
    """Whether a wall or an obstacle is next in a direction."""
    return maze.blocked(state, jnp.int32(maze.action_names.index(direction)))


def free(maze: CorridorMaze, state: MazeState, direction: str) -> Bool[Array, ""]:
    """Whether nothing is next in a direction."""
    return ~blocked(maze, state, direction)


def walk_corridors(maze: CorridorMaze) -> Hierarchy:
    """At an intersection, choose one of the directions that are free, and traverse the corridor to the next one."""
    directions = maze.action_names
    return Hierarchy(
        "walk",
        (
            Machine(
                "walk",
                start="which way",
                vertices={
                    "which way": Choice(
                        edges={direction: direction for direction in directions},
                        only_if={direction: Predicate(free, {"direction": direction}) for direction in directions},
                    ),
                    **{direction: _traverse(direction) for direction in directions},
                },
            ),
            TRAVERSE,
            SIDESTEP,
            BACK_OFF,
        ),
    )


def _traverse(direction: str) -> Call:
    left, right = SIDES[direction]
    arguments = {"ahead": direction, "left": left, "right": right, "back": BACK[direction]}
    return Call("traverse", then="which way", arguments=arguments)


AHEAD, LEFT, RIGHT, SIDE = Parameter("ahead"), Parameter("left"), Parameter("right"), Parameter("side")
IN_INTERSECTION = Predicate(at_intersection)
AHEAD_BLOCKED = Predicate(blocked, {"direction": AHEAD})
SIDE_BLOCKED = Predicate(blocked, {"direction": SIDE})

TRAVERSE = Machine(
    "traverse",
    start="leave",
    parameters=("ahead", "left", "right", "back"),
    vertices={
        # Out of the intersection; where there is a wall instead of a corridor, this is the end of it.
        "leave": Action(AHEAD, then="out?"),
        "out?": Branch(IN_INTERSECTION, {True: "wall?", False: "obstacle?"}),
        "wall?": Branch(AHEAD_BLOCKED, {True: "stop", False: "leave"}),
        # Along the corridor to an intersection, which is the one behind if it is met first.
        "arrived?": Branch(IN_INTERSECTION, {True: "stop", False: "obstacle?"}),
        "obstacle?": Branch(AHEAD_BLOCKED, {True: "way round", False: "go on"}),
        "go on": Action(AHEAD, then="arrived?"),
        "way round": Choice({"left": "to the left", "right": "to the right", "back off": "back off"}),
        "to the left": Call("sidestep", then="arrived?", arguments={"ahead": AHEAD, "side": LEFT}),
        "to the right": Call("sidestep", then="arrived?", arguments={"ahead": AHEAD, "side": RIGHT}),
        "back off": Call(
            "back off", then="arrived?", arguments={"back": Parameter("back"), "left": LEFT, "right": RIGHT}
        ),
        "stop": Stop(),
    },
)
"""Go ahead until the next intersection, and round whatever is in the way."""

SIDESTEP = Machine(
    "sidestep",
    start="step",
    parameters=("ahead", "side"),
    vertices={
        "step": Action(SIDE, then="out?"),
        # One whom a slip has taken round a corner sidesteps along a corridor.
        "out?": Branch(IN_INTERSECTION, {True: "stop", False: "still blocked?"}),
        "still blocked?": Branch(AHEAD_BLOCKED, {True: "at the wall?", False: "stop"}),
        "at the wall?": Branch(SIDE_BLOCKED, {True: "stop", False: "step"}),
        "stop": Stop(),
    },
)
"""Go to one side until the way ahead is free, or to the wall."""

BACK_OFF = Machine(
    "back off",
    start="step back",
    parameters=("back", "left", "right"),
    vertices={
        "step back": Action(Parameter("back"), then="which side"),
        "which side": Choice({"left": "to the left", "right": "to the right"}),
        "to the left": Action(LEFT, then="stop"),
        "to the right": Action(RIGHT, then="stop"),
        "stop": Stop(),
    },
)
"""Take a step back, and one to a side."""
