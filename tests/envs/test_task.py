"""Tasks made from an environment: where they end, and what they pay."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor import Corridor

from lodestone.envs.base import Environment
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.state_space import reachable_states
from lodestone.envs.task import goal, looks


@pytest.mark.parametrize("environment", [Corridor(length=5), MagnetArm(rows=3, columns=3, bricks=2, tower_height=2)])
def test_a_goal_that_is_given_by_its_observation_holds_where_that_is_seen(environment: Environment):
    states = reachable_states(environment)
    seen = np.asarray(jax.vmap(environment.observe)(states.states))
    wanted = seen[3]
    task = goal(environment, "there", looks(wanted))
    there = (seen == wanted).reshape(len(seen), -1).all(axis=1)
    assert 0 < there.sum() < len(seen)
    np.testing.assert_array_equal(jax.vmap(task.terminal)(states.states), there)
    paid = jax.vmap(task.reward, in_axes=(0, None, 0))(states.states, jnp.int32(0), states.states)
    np.testing.assert_array_equal(paid, there.astype(np.float32))


def test_goals_that_look_alike_are_equal():
    """So that a program that was compiled for one serves the other."""
    corridor = Corridor(length=5)
    one, same, other = (goal(corridor, "there", looks(jnp.int32(cell))) for cell in (3, 3, 4))
    assert one.stop == same.stop
    assert hash(one.stop) == hash(same.stop)
    assert one.stop != other.stop
