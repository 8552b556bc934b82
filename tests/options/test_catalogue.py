"""Ready-made options by name."""

from __future__ import annotations

import numpy as np
import pytest

from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.taxi import Taxi
from lodestone.errors import UnknownName
from lodestone.options.catalogue import named_options, option_names, scripted_options
from lodestone.options.four_rooms import HALLWAY_OPTIONS, hallway_options
from lodestone.options.tabular import TabularOptions


def test_options_come_in_the_order_of_their_names():
    rooms = FourRooms()
    everything, names = hallway_options(rooms), ("south-east-to-south", "north-west-to-west")
    found = named_options(rooms, names)
    assert isinstance(found, TabularOptions)
    assert found.names == names
    for option, name in enumerate(names):
        for table in ("initiation_table", "policy_table", "termination_table"):
            wanted = np.asarray(getattr(everything, table))[:, everything.names.index(name)]
            np.testing.assert_array_equal(np.asarray(getattr(found, table))[:, option], wanted)
    assert named_options(rooms, ["hallways"]).names == HALLWAY_OPTIONS == everything.names
    assert named_options(MagnetArm(), ["lift", "go-down"]) == scripted_options(MagnetArm(), ["lift", "go-down"])


def test_what_there_is_not_is_refused():
    assert option_names(Taxi()) == ()
    for environment, name in ((Taxi(), "hallways"), (MagnetArm(), "hallways"), (FourRooms(), "lift")):
        with pytest.raises(UnknownName, match=f"no option named '{name}'"):
            named_options(environment, [name])
