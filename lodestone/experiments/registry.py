"""The experiments that can be run by name.

To add one: a module with a constant `EXPERIMENT`, and that constant in the tuple below. The towers of the magnet arm
are not in it: they have figures, presets and saved policies of their own.
"""

from __future__ import annotations

from lodestone.errors import check_name
from lodestone.experiments import (
    discovery,
    hallways,
    hdqn,
    machines,
    option_critic,
    option_critic_arm,
    option_usage,
    straw,
    taxi,
    transfer,
    two_rooms,
    united,
)
from lodestone.experiments.study import Experiment

_ALL: tuple[Experiment, ...] = (
    discovery.EXPERIMENT,
    hallways.EXPERIMENT,
    hdqn.EXPERIMENT,
    machines.EXPERIMENT,
    option_critic.EXPERIMENT,
    option_critic_arm.EXPERIMENT,
    option_usage.EXPERIMENT,
    straw.EXPERIMENT,
    taxi.EXPERIMENT,
    transfer.EXPERIMENT,
    two_rooms.EXPERIMENT,
    united.EXPERIMENT,
)

EXPERIMENTS: dict[str, Experiment] = {one.name: one for one in _ALL}
"""By name, in the order in which they are listed."""


def experiment(name: str) -> Experiment:
    """The experiment of this name. Raises `UnknownName`."""
    check_name("experiment", name, tuple(EXPERIMENTS))
    return EXPERIMENTS[name]
