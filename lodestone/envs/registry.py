"""The environments by the names that the command line and Gymnasium know them by."""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

from lodestone.envs.base import Environment
from lodestone.envs.chain import Chain
from lodestone.envs.corridor_maze import CorridorMaze
from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.goal_maze import GoalMaze
from lodestone.envs.host import HostEnvironment, Registered
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.random_mdp import RandomMDP
from lodestone.envs.taxi import Taxi
from lodestone.envs.two_rooms import TwoRooms
from lodestone.errors import InvalidConfig, UnknownName, check_name

ENVIRONMENTS: dict[str, type[Environment]] = {
    "magnet-arm": MagnetArm,
    "four-rooms": FourRooms,
    "taxi": Taxi,
    "corridor-maze": CorridorMaze,
    "goal-maze": GoalMaze,
    "two-rooms": TwoRooms,
    "chain": Chain,
    "random-mdp": RandomMDP,
}
"""Every environment, by name."""

GYMNASIUM = "gymnasium"
"""The name of all those that Gymnasium makes by an id."""

PLUGINS = ("minigrid", "ale_py", "lodestone.envs.atari")
"""Modules that an id may name without being imported before: a file's id must not run a stranger's code."""


def environment_class(name: str) -> type[Environment]:
    """The class of a name. Raises `UnknownName`."""
    check_name("environment", name, tuple(ENVIRONMENTS))
    return ENVIRONMENTS[name]


def make_environment(name: str, **parameters: Any) -> Environment:
    """The environment of a name, with its parameters.

    Raises `UnknownName` for a name or a parameter that does not exist, and `InvalidConfig` for a bad value.
    """
    environment = Registered if name == GYMNASIUM else environment_class(name)
    known = tuple(field.name for field in dataclasses.fields(environment))
    for parameter in parameters:
        check_name(f"parameter of {name}", parameter, known)
    if name == GYMNASIUM:
        module, colon, _ = str(parameters.get("id")).rpartition(":")
        if colon and module not in (*PLUGINS, *sys.modules):
            raise InvalidConfig(f"The environment is of the module {module}, which has to be imported before.")
    return environment(**parameters)


def name_of(environment: Environment) -> str:
    """What a person calls it: its name, or its id where Gymnasium makes it."""
    if isinstance(environment, HostEnvironment):
        return environment.id if isinstance(environment, Registered) else type(environment).__name__
    return str(describe_environment(environment)["name"])


def describe_environment(environment: Environment) -> dict[str, Any]:
    """Name and parameters, fit for JSON and for `make_environment`."""
    for name, kind in {**ENVIRONMENTS, GYMNASIUM: Registered}.items():
        if type(environment) is kind:
            fields = dataclasses.fields(environment)
            return {"name": name, "parameters": {field.name: getattr(environment, field.name) for field in fields}}
    raise UnknownName(f"{type(environment).__name__} is not registered in ENVIRONMENTS, so it has no name to save.")
