"""Tasks made from an environment: where they end, and what they pay."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corridor import Corridor

from lodestone.envs.base import Environment
from lodestone.envs.magnet_arm import MagnetArm, random_layouts
from lodestone.envs.state_space import reachable_states
from lodestone.envs.task import begun_at, goal, looks
from lodestone.planning.solve import value_iteration
from lodestone.planning.tables import tabulate


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


def test_an_environment_that_begins_elsewhere_has_the_same_values():
    arm = MagnetArm(rows=3, columns=3, bricks=2, tower_height=2)
    elsewhere = begun_at(arm, random_layouts)
    jax.tree.map(np.testing.assert_array_equal, elsewhere.initial_distribution(), random_layouts(arm))
    tables, of_arm = tabulate(elsewhere), tabulate(arm)
    numbers = np.asarray(jax.vmap(tables.space.index_of)(of_arm.space.states))
    np.testing.assert_array_equal(tables.terminal[numbers], of_arm.terminal)
    found, wanted = (value_iteration(one, 0.9).action_values for one in (tables, of_arm))
    np.testing.assert_allclose(found[numbers], wanted)
