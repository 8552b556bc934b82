"""Which environments have a ready-made hierarchy of machines, and machines as options."""

from __future__ import annotations

from lodestone.envs.base import Environment
from lodestone.envs.corridor_maze import CorridorMaze
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.registry import name_of
from lodestone.envs.taxi import Taxi
from lodestone.errors import InvalidConfig
from lodestone.machines.corridor_maze import walk_corridors
from lodestone.machines.machine import Action, Call, Choice, Hierarchy, Machine, Vertex
from lodestone.machines.magnet_arm import pull_up
from lodestone.machines.taxi import get_and_put


def machines(environment: Environment) -> Hierarchy:
    """The machines for an environment. Raises `InvalidConfig` where there are none."""
    match environment:
        case MagnetArm():
            return pull_up(environment)
        case Taxi():
            return get_and_put(environment)
        case CorridorMaze():
            return walk_corridors(environment)
    raise InvalidConfig(
        f"There are no ready-made machines for {name_of(environment)}; magnet-arm, taxi and corridor-maze have some, "
        "and `train_policy` takes others as `hierarchy`."
    )


def machines_as_options(environment: Environment, options: tuple[str, ...], others: tuple[Machine, ...]) -> Hierarchy:
    """Machines as options beside the primitive actions: one choice, for ever, over all actions and `options`, each of
    which runs until it stops.

    `options` name machines without parameters among `others`, which are all that may be called. What they leave open
    is learned, or planned, together with the choice between them; an option with memory is a machine that leaves
    nothing open.
    """
    vertices: dict[str, Vertex] = {action: Action(action, then="choose") for action in environment.action_names}
    vertices |= {name: Call(name, then="choose") for name in options}
    choose = Choice({name: name for name in vertices})
    return Hierarchy("options", (Machine("options", "choose", {"choose": choose, **vertices}), *others))
