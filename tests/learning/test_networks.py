"""Convolutions as matrix products against XLA's own, and the paper's parameter counts."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lodestone.envs.base import example_state
from lodestone.envs.magnet_arm import MagnetArm
from lodestone.errors import InvalidConfig
from lodestone.learning.networks import Convolution, NetworkConfig, count_parameters, init_q_network


@pytest.mark.parametrize("height", [2, 3, 12, 13])
@pytest.mark.parametrize("width", [3, 9])
@pytest.mark.parametrize(("kernel", "stride"), [(8, 4), (4, 2), (3, 1), (3, 3), (1, 1)])
def test_convolution_equals_xla(height, width, kernel, stride):
    keys = jax.random.split(jax.random.key(0), 3)
    layer = Convolution(jax.random.normal(keys[0], (kernel, kernel, 3, 5)), jax.random.normal(keys[1], (5,)), stride)
    pictures = jax.random.normal(keys[2], (2, height, width, 3))
    wanted = jax.lax.conv_general_dilated(
        pictures, layer.weight, (stride, stride), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    found = jax.vmap(layer)(pictures)
    np.testing.assert_allclose(found, wanted + layer.bias[None, None, None], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("rows", "columns", "outputs", "count"),
    [(4, 3, 6, 143_270), (4, 3, 8, 143_784), (6, 4, 6, 176_038), (6, 4, 8, 176_552)],
)
def test_the_papers_network_has_the_authors_parameter_count(rows, columns, outputs, count):
    arm = MagnetArm(rows=rows, columns=columns)
    picture = arm.observe(example_state(arm))
    network = init_q_network(NetworkConfig(), picture.shape, outputs, jax.random.key(0))
    assert count_parameters(network) == count
    assert network(picture).shape == (outputs,)


def test_weights_are_glorot_uniform_and_biases_zero():
    network = init_q_network(NetworkConfig(), (12, 9, 3), 6, jax.random.key(1))
    for layer in (*network.convolutions, *network.layers):
        assert not layer.bias.any()
        fans = layer.weight.shape[-2] + layer.weight.shape[-1]
        variance = 2 / (np.prod(layer.weight.shape[:-2]) * fans)
        assert float(layer.weight.var()) == pytest.approx(variance, rel=0.1)
        assert float(jnp.abs(layer.weight).max()) <= np.sqrt(3 * variance) + 1e-6


def test_pictures_are_scaled_to_one():
    network = init_q_network(NetworkConfig(), (12, 9, 3), 6, jax.random.key(1))
    picture = jax.random.bits(jax.random.key(2), (12, 9, 3), jnp.uint8)
    np.testing.assert_allclose(network(picture), network(picture.astype(jnp.float32) / 255), rtol=1e-4, atol=1e-6)


def test_bad_shapes_are_refused():
    with pytest.raises(InvalidConfig, match="one number per convolution"):
        NetworkConfig(kernels=(3,), strides=(1, 1), channels=(8,))
    with pytest.raises(InvalidConfig, match="at least 1"):
        NetworkConfig(kernels=(), strides=(), channels=(), hidden=(0,))
    with pytest.raises(InvalidConfig, match="need pictures"):
        init_q_network(NetworkConfig(), (7,), 2, jax.random.key(0))
