"""A machine that builds the tower (authors' code of Kuzmin and Panov 2018)."""

from __future__ import annotations

from lodestone.envs.magnet_arm import MagnetArm
from lodestone.machines.machine import Action, Call, Choice, Hierarchy, Machine, sequence


def pull_up(arm: MagnetArm) -> Hierarchy:
    """Again and again: a column to the left, one to the right, let go, or fetch whatever lies below the arm.

    Fetching switches the magnet on, goes down as far as the grid allows, and comes up again. That takes as many steps
    over a tall tower as over the floor, so that the best policy of this machine is slower than the best of all.
    """
    far = arm.rows - 1
    return Hierarchy(
        "build",
        (
            Machine(
                "build",
                start="next",
                vertices={
                    "next": Choice({"left": "left", "right": "right", "let go": "let go", "pull up": "pull up"}),
                    "left": Action("left", then="next"),
                    "right": Action("right", then="next"),
                    "let go": Action("magnet-off", then="next"),
                    "pull up": Call("pull up", then="next"),
                },
            ),
            sequence("pull up", "magnet-on", *["down"] * far, *["up"] * far),
        ),
    )
