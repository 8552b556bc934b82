"""Which environments have a ready-made task graph."""

from __future__ import annotations

from lodestone.envs.base import Environment
from lodestone.envs.registry import name_of
from lodestone.envs.taxi import Taxi
from lodestone.envs.two_rooms import TwoRooms
from lodestone.errors import InvalidConfig
from lodestone.subtasks.task_graph import TaskGraph
from lodestone.subtasks.taxi import taxi_tasks
from lodestone.subtasks.two_rooms import two_rooms_tasks


def task_graph(environment: Environment) -> TaskGraph:
    """The task graph of an environment. Raises `InvalidConfig` where there is none."""
    match environment:
        case Taxi():
            return taxi_tasks(environment)
        case TwoRooms():
            return two_rooms_tasks(environment)
    raise InvalidConfig(
        f"There is no ready-made task graph for {name_of(environment)}; taxi and two-rooms have one, and "
        "`train_policy` takes others as `graph`."
    )
