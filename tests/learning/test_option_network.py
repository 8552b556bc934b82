"""The network of option-critic: what it starts as, what it is shown, and that it is a set of options."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.envs.base import Environment, example_state, observation_shape
from lodestone.envs.four_rooms import FourRooms
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.envs.random_mdp import RandomMDP
from lodestone.envs.state_space import reachable_states
from lodestone.envs.two_rooms import TwoRooms
from lodestone.errors import InvalidConfig
from lodestone.learning.networks import NetworkConfig
from lodestone.learning.option_network import SoftNetworkOptions, init_option_network, shown_shape, sight

ARM = MagnetArm(rows=3, columns=3, bricks=2, tower_height=2)
SMALL = NetworkConfig(kernels=(3,), strides=(3,), channels=(4,), hidden=(8,))
NO_LAYERS = NetworkConfig(kernels=(), strides=(), channels=(), hidden=())


def test_it_starts_as_tables_do():
    """Nothing is preferred, actions are drawn at random, options end with probability a half."""
    network = init_option_network(SMALL, observation_shape(ARM), 3, ARM.num_actions, jax.random.key(0))
    options, state = SoftNetworkOptions(ARM, network, 0.5), example_state(ARM)
    np.testing.assert_array_equal(options.values(state), np.zeros(3))
    np.testing.assert_allclose(options.action_probs(state), np.full((3, 6), 1 / 6), rtol=1e-6)
    np.testing.assert_array_equal(options.termination(state), np.full(3, 0.5))
    assert options.names == ("option-0", "option-1", "option-2")
    assert options.initiation(state).all()
    assert float(jnp.abs(network.trunk.layers[0].weight).max()) > 0.1


def test_a_head_has_a_row_of_actions_for_every_option():
    network = init_option_network(NO_LAYERS, (5,), 3, 2, jax.random.key(0))
    weight = jnp.arange(30.0).reshape(5, 6)
    network = jax.tree.map(lambda leaf: weight if leaf.shape == (5, 6) else leaf, network)
    np.testing.assert_array_equal(network.theta(jnp.eye(5)[2]), [[12, 13], [14, 15], [16, 17]])


@pytest.mark.parametrize(
    ("environment", "count"),
    [
        (RandomMDP(observation="index"), 7),
        (FourRooms(observation="cell"), 104),
        (TwoRooms(observation="cell"), 56),
    ],
)
def test_a_number_is_shown_as_a_one_hot_vector(environment: Environment, count: int):
    assert shown_shape(environment) == (count,)
    states = reachable_states(environment).states
    shown = np.asarray(jax.jit(jax.vmap(sight(environment)))(states))
    np.testing.assert_array_equal(shown.sum(axis=1), 1)
    np.testing.assert_array_equal(shown.argmax(axis=1), jax.vmap(environment.observe)(states))


def test_a_picture_is_shown_as_it_is():
    assert shown_shape(ARM) == observation_shape(ARM)
    np.testing.assert_array_equal(sight(ARM)(example_state(ARM)), ARM.observe(example_state(ARM)))


def test_convolutions_need_pictures():
    with pytest.raises(InvalidConfig, match="Convolutions need pictures"):
        init_option_network(SMALL, (7,), 3, 2, jax.random.key(0))
