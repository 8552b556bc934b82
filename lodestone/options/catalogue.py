"""What ready-made options, training tasks and goals each environment has, by name."""

from __future__ import annotations

from collections.abc import Sequence

from lodestone.envs.base import Environment
from lodestone.envs.chain import Chain, position_goals
from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.magnet_arm import MagnetArm, go_down_task, lift_task, tower_goals
from lodestone.envs.task import Task
from lodestone.errors import check_name
from lodestone.options.base import Options
from lodestone.options.four_rooms import HALLWAY_OPTIONS, hallway_options
from lodestone.options.magnet_arm import GO_DOWN, LIFT
from lodestone.options.scripted import Script, Scripted
from lodestone.options.tabular import chosen

HALLWAYS = "hallways"
"""All options of Four Rooms by one name."""


def scripts(environment: Environment) -> tuple[Script, ...]:
    """The hand-written options for an environment; none if there are none."""
    return (GO_DOWN, LIFT) if isinstance(environment, MagnetArm) else ()


def tasks(environment: Environment) -> tuple[Task, ...]:
    """The training tasks for an environment's options; none if there are none."""
    return (go_down_task(environment), lift_task(environment)) if isinstance(environment, MagnetArm) else ()


def goals(environment: Environment) -> tuple[Task, ...]:
    """The goals for an environment's controller; none if there are none."""
    if isinstance(environment, Chain):
        return position_goals(environment)
    return tower_goals(environment) if isinstance(environment, MagnetArm) else ()


def option_names(environment: Environment) -> tuple[str, ...]:
    """Names that `named_options` knows for an environment; none if it has no ready-made options."""
    if isinstance(environment, FourRooms):
        return (HALLWAYS, *HALLWAY_OPTIONS)
    return tuple(script.name for script in scripts(environment))


def named_options(environment: Environment, names: Sequence[str]) -> Options:
    """Ready-made options by name: scripts of the magnet arm, exact hallway options of Four Rooms.

    Raises `UnknownName`.
    """
    for name in names:
        check_name("option", name, option_names(environment))
    if isinstance(environment, FourRooms):
        single = [one for name in names for one in (HALLWAY_OPTIONS if name == HALLWAYS else (name,))]
        return chosen(hallway_options(environment), single)
    return scripted_options(environment, names)


def scripted_options(environment: Environment, names: Sequence[str]) -> Scripted:
    """Hand-written options by name. Raises `UnknownName`."""
    known = {script.name: script for script in scripts(environment)}
    for name in names:
        check_name("option", name, tuple(known))
    return Scripted(environment, tuple(known[name] for name in names))


def task_named(environment: Environment, name: str) -> Task:
    """A training task by name. Raises `UnknownName`."""
    known = {task.name: task for task in tasks(environment)}
    check_name("task", name, tuple(known))
    return known[name]
