"""What ready-made options and training tasks each environment has, by name."""

from __future__ import annotations

from collections.abc import Sequence

from lodestone.envs.base import Environment
from lodestone.envs.magnet_arm import MagnetArm, go_down_task, lift_task
from lodestone.envs.task import Task
from lodestone.errors import check_name
from lodestone.options.magnet_arm import GO_DOWN, LIFT
from lodestone.options.scripted import Script, Scripted


def scripts(environment: Environment) -> tuple[Script, ...]:
    """The hand-written options for an environment; none if there are none."""
    return (GO_DOWN, LIFT) if isinstance(environment, MagnetArm) else ()


def tasks(environment: Environment) -> tuple[Task, ...]:
    """The training tasks for an environment's options; none if there are none."""
    return (go_down_task(environment), lift_task(environment)) if isinstance(environment, MagnetArm) else ()


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
