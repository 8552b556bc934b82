"""Ready-made machines, and machines as options against the options they are."""

from __future__ import annotations

import numpy as np
import pytest

from lodestone.envs.chain import Chain
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.errors import InvalidConfig
from lodestone.machines.catalogue import machines, machines_as_options
from lodestone.machines.machine import Action, Branch, Machine, Predicate, Stop
from lodestone.options.base import Primitives, Union
from lodestone.options.catalogue import scripted_options
from lodestone.options.magnet_arm import GO_DOWN
from lodestone.planning.joint import joint_process, joint_values
from lodestone.planning.option_models import option_value_iteration, tabulate_options
from lodestone.planning.tables import tabulate


def stops(arm, state):
    return GO_DOWN.stops(arm, state)


def may_start(arm, state):
    return GO_DOWN.may_start(arm, state)


def test_an_option_as_a_machine_is_worth_what_the_option_is():
    """*Go down* as a machine that acts until the option's termination, in every state where nothing else runs. The
    machine may start anywhere, and so may the option that it is compared with, which is taken where it may start."""
    arm = MagnetArm(rows=4, columns=3, bricks=2, tower_height=2)
    go_down = Machine(
        "go-down",
        "start?",
        {
            "start?": Branch(Predicate(may_start), {True: "down", False: "wait"}),
            "wait": Action("up", then="stop"),  # a call takes time, so that calls cannot go on for ever in no time
            "down": Action("down", then="there?"),
            "there?": Branch(Predicate(stops), {True: "stop", False: "down"}),
            "stop": Stop(),
        },
    )
    process = joint_process(arm, machines_as_options(arm, ("go-down",), (go_down,)))
    found = joint_values(process, 0.9, tolerance=1e-12)
    tables = tabulate(arm)
    options = tabulate_options(Union((Primitives(arm.action_names), scripted_options(arm, ["go-down"]))), tables.space)
    wanted = option_value_iteration(tables, options, 0.9, tolerance=1e-12).option_values
    at = process.state[: process.num_choices]
    used = [process.names.index(name) for name in options.names]
    values = np.take_along_axis(found.choice_values, np.argsort(process.name, axis=1), axis=1)[:, used]
    comparable = np.isfinite(wanted[at])
    assert comparable[:, -1].sum() > 20
    np.testing.assert_allclose(values[comparable], wanted[at][comparable], atol=1e-9)


def test_environments_without_machines_are_named():
    with pytest.raises(InvalidConfig, match="no ready-made machines for chain"):
        machines(Chain())
