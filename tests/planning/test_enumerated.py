"""An enumerated environment against the one it was made from."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.planning.enumerated import enumerated
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
