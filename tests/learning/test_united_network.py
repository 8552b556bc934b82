"""The united network against its parts one by one, and against the authors' count of parameters."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.errors import InvalidConfig, UnknownName
from lodestone.learning.networks import NetworkConfig, count_parameters
from lodestone.learning.united_network import init_united_network, one_head

PICTURE = (12, 9, 3)
TINY = NetworkConfig(kernels=(3,), strides=(3,), channels=(4,), hidden=(8,))


@pytest.mark.parametrize(
    ("shared", "parameters"),
    [
        # Three policies of 143,270, two terminations of 142,242, a manager of 142,499.
        ("nothing", 3 * 143_270 + 2 * 142_242 + 142_499),
        ("convolutions", 477_113),  # as in the authors' code
        ("hidden", 75_936 + 65_792 + 3 * 1_542 + 2 * 514 + 771),
    ],
)
def test_parameters_of_the_papers_network_at_4x3(shared, parameters):
    network = init_united_network(NetworkConfig(), shared, PICTURE, 6, 2, jax.random.key(0))
    assert count_parameters(network) == parameters


@pytest.mark.parametrize("shared", ["nothing", "convolutions", "hidden"])
def test_every_head_is_what_it_would_be_alone(shared):
    network = init_united_network(TINY, shared, PICTURE, 6, 2, jax.random.key(1))
    picture = jax.random.randint(jax.random.key(2), PICTURE, 0, 256).astype(jnp.uint8)
    outputs = network(picture)
    below = picture if network.trunk is None else network.trunk(picture)
    np.testing.assert_allclose(outputs.choices, network.manager(below), rtol=1e-6)
    for position in range(3):
        np.testing.assert_allclose(outputs.actions[position], one_head(network.policies, position)(below), rtol=1e-5)
    for position in range(2):
        going_on, ended = one_head(network.terminations, position)(below)
        expected = 1 / (1 + np.exp(going_on - ended))
        np.testing.assert_allclose(outputs.termination[position], expected, rtol=1e-5)
        assert bool(outputs.ended[position]) == bool(ended > going_on)


def test_heads_start_different():
    network = init_united_network(TINY, "hidden", PICTURE, 6, 2, jax.random.key(1))
    weights = network.policies.layers[-1].weight
    assert not np.allclose(weights[0], weights[1])


def test_without_options_there_is_a_basic_policy_alone():
    network = init_united_network(TINY, "hidden", PICTURE, 6, 0, jax.random.key(1))
    outputs = network(jnp.zeros(PICTURE, jnp.uint8))
    assert outputs.choices.shape == (1,)
    assert outputs.actions.shape == (1, 6)
    assert outputs.ended.shape == (0,)


def test_a_pooled_trunk_takes_pictures_of_any_size():
    config = NetworkConfig(kernels=(3,), strides=(3,), channels=(4,), hidden=(8,), pooling=True)
    network = init_united_network(config, "convolutions", PICTURE, 6, 2, jax.random.key(1))
    small = jax.random.randint(jax.random.key(2), PICTURE, 0, 256).astype(jnp.uint8)
    large = jnp.zeros((18, 12, 3), jnp.uint8).at[3:15, 3:12].set(small)  # the same cells, elsewhere
    assert network(large).actions.shape == (3, 6)
    np.testing.assert_allclose(
        network(jnp.pad(small, ((3, 3), (3, 0), (0, 0)))).actions, network(large).actions, rtol=1e-5
    )


def test_what_cannot_be_shared_is_refused():
    flat = NetworkConfig(kernels=(), strides=(), channels=(), hidden=(8,))
    with pytest.raises(InvalidConfig, match="no such layers"):
        init_united_network(flat, "convolutions", (5,), 2, 1, jax.random.key(0))
    with pytest.raises(UnknownName, match="nothing, convolutions, hidden"):
        init_united_network(flat, "all", (5,), 2, 1, jax.random.key(0))
