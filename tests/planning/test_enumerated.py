"""An enumerated environment against the one it was made from."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.envs.base import next_step
from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.planning.enumerated import enumerated, look_up_step
from lodestone.planning.tables import tabulate


@pytest.mark.parametrize("environment", [FourRooms("text"), MagnetArm(3, 3, 2, 2)])
def test_its_functions_are_the_tables_it_was_made_from(environment):
    tables = tabulate(environment)
    world = enumerated(tables, environment.action_names)
    for state in np.random.default_rng(0).integers(tables.num_states, size=20):
        for action in range(tables.num_actions):
            probs = np.asarray(world.outcome_probs(jnp.int32(state), jnp.int32(action)))
            np.testing.assert_allclose(probs, tables.probs[state, action], atol=1e-6)
            for outcome in np.flatnonzero(probs):
                following = world.transition(jnp.int32(state), jnp.int32(action), jnp.int32(outcome))
                assert int(following) == tables.successors[state, action, outcome]
                reward = world.reward(jnp.int32(state), jnp.int32(action), following)
                assert float(reward) == pytest.approx(tables.rewards[state, action, outcome])
    np.testing.assert_array_equal(np.asarray(world.ends), tables.terminal)
    probs, starts = world.initial_distribution()
    np.testing.assert_allclose(np.asarray(probs), tables.initial_probs[np.asarray(starts)], atol=1e-6)
    assert float(probs.sum()) == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("environment", [FourRooms("code"), MagnetArm(3, 3, 2, 2)])
def test_a_looked_up_step_is_the_step_of_any_environment(environment):
    world = enumerated(tabulate(environment), environment.action_names)
    rng = np.random.default_rng(0)
    uniform = jnp.asarray(rng.random(500), dtype=jnp.float32)
    state, action = (jnp.asarray(rng.integers(high, size=500)) for high in (world.ends.size, world.num_actions))
    looked_up = jax.vmap(look_up_step, in_axes=(None, 0, 0, 0))(world, uniform, state, action)
    jax.tree.map(
        np.testing.assert_array_equal,
        looked_up,
        jax.vmap(next_step, in_axes=(None, 0, 0, 0))(world, uniform, state, action),
    )
    assert len(np.unique(looked_up.state)) > 20
