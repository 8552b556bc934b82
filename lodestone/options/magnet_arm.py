"""The two options of Kuzmin and Panov (2018, section 4.2) for the magnet arm, written by hand.

*go-down*: down to a brick or the floor. *lift*: down, take the brick, lift it to the top.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from lodestone.envs.magnet_arm import (
    DOWN,
    MAGNET_ON,
    UP,
    ArmState,
    MagnetArm,
    arm_has_lifted,
    arm_is_down,
    tower_heights,
)
from lodestone.options.scripted import Script


def _can_go_down(arm: MagnetArm, state: ArmState) -> Bool[Array, ""]:
    return ~arm_is_down(arm, state)


def _go_down(arm: MagnetArm, state: ArmState) -> Int[Array, ""]:
    del arm, state
    return jnp.int32(DOWN)


def _tower_below(arm: MagnetArm, state: ArmState) -> Int[Array, ""]:
    """Height of the tower in the arm's column."""
    here = jnp.arange(arm.columns) == state.column.astype(jnp.int32)
    return jnp.sum(jnp.where(here, tower_heights(state), 0))


def _brick_below(arm: MagnetArm, state: ArmState) -> Bool[Array, ""]:
    """Whether a brick touches the arm from below."""
    here = jnp.arange(arm.columns) == state.column.astype(jnp.int32)
    cell = 1 << (arm.rows - 1 - state.row.astype(jnp.int32)) >> 1
    return jnp.any(here & ((state.bricks.astype(jnp.int32) & cell) != 0))


def _can_lift(arm: MagnetArm, state: ArmState) -> Bool[Array, ""]:
    """A brick hangs already below the top row, or one lies somewhere under the arm with room to rise."""
    tower = _tower_below(arm, state)
    hangs = state.magnet & _brick_below(arm, state)
    return (hangs & (state.row > 0)) | ((tower > 0) & (tower < arm.rows - 1))


def _lift(arm: MagnetArm, state: ArmState) -> Int[Array, ""]:
    """Down to the brick, magnet on, up."""
    grip = jnp.where(state.magnet, UP, MAGNET_ON)
    return jnp.where(_brick_below(arm, state), grip, DOWN).astype(jnp.int32)


GO_DOWN = Script("go-down", _can_go_down, _go_down, arm_is_down)
LIFT = Script("lift", _can_lift, _lift, arm_has_lifted)
