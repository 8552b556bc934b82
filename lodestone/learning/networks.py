"""Q-networks over small pictures.

XLA's convolution is several times slower on a CPU, inside a compiled loop, than the same sum written as matrix
products, and it turns into grouped convolutions when seeds are vmapped. So a convolution is matrix products here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num, PRNGKeyArray, PyTree

from lodestone.errors import InvalidConfig

FEW_PIXELS = 9
"""Up to so many output pixels a convolution is one matrix product per pixel; above, one product over all patches."""


@dataclass(frozen=True)
class NetworkConfig:
    """Convolutions, then hidden layers, then one output per option; ReLU between."""

    kernels: tuple[int, ...] = (8, 4, 3)
    """Side of each convolution's kernel, in pixels; none for a network of hidden layers only."""
    strides: tuple[int, ...] = (4, 2, 1)
    """Stride of each convolution."""
    channels: tuple[int, ...] = (32, 64, 64)
    """Output channels of each convolution."""
    hidden: tuple[int, ...] = (256,)
    """Widths of the hidden layers."""
    pooling: bool = False
    """Whether the hidden layers see each channel's maximum over the picture instead of all its pixels: the network then
    takes pictures of any size."""

    def __post_init__(self) -> None:
        if not len(self.kernels) == len(self.strides) == len(self.channels):
            raise InvalidConfig(
                f"kernels, strides and channels need one number per convolution, but have {len(self.kernels)}, "
                f"{len(self.strides)} and {len(self.channels)}."
            )
        if any(number < 1 for number in (*self.kernels, *self.strides, *self.channels, *self.hidden)):
            raise InvalidConfig("kernels, strides, channels and hidden widths must be at least 1.")
        if self.pooling and not self.kernels:
            raise InvalidConfig("pooling needs convolutions.")


class Convolution(eqx.Module):
    """A convolution with TensorFlow's SAME padding: the odd pixel of padding goes to the right and the bottom."""

    weight: Float[Array, "kernel kernel inputs outputs"]
    bias: Float[Array, " outputs"]
    stride: int = eqx.field(static=True)

    def __call__(self, picture: Float[Array, "height width inputs"]) -> Float[Array, "rows columns outputs"]:
        rows, columns = (_Axis(length, self.weight.shape[0], self.stride) for length in picture.shape[:2])
        if rows.outputs * columns.outputs <= FEW_PIXELS:
            flat = self._pixel_by_pixel(picture, rows, columns)
        else:
            flat = self._by_patches(picture, rows, columns)
        return flat.reshape(rows.outputs, columns.outputs, -1) + self.bias[None, None, :]

    def _pixel_by_pixel(self, picture: Array, rows: _Axis, columns: _Axis) -> Float[Array, "pixels outputs"]:
        """Multiplies only what lies inside the picture, which on tiny pictures is much less than whole kernels."""
        pixels = []
        for row in range(rows.outputs):
            inside_rows, kernel_rows = rows.overlap(row)
            for column in range(columns.outputs):
                inside_columns, kernel_columns = columns.overlap(column)
                kernel = self.weight[kernel_rows, kernel_columns]
                pixels.append(picture[inside_rows, inside_columns].ravel() @ kernel.reshape(-1, kernel.shape[-1]))
        return jnp.stack(pixels)

    def _by_patches(self, picture: Array, rows: _Axis, columns: _Axis) -> Float[Array, "pixels outputs"]:
        """Cuts out every kernel-sized patch, first along the rows, then along the columns."""
        padded = jnp.pad(picture, (rows.padding, columns.padding, (0, 0)))
        strips = jnp.stack([padded[rows.every(offset)] for offset in range(rows.kernel)], axis=1)
        patches = jnp.stack([strips[:, :, columns.every(offset)] for offset in range(columns.kernel)], axis=3)
        patches = jnp.swapaxes(patches, 1, 2)  # [rows, columns, kernel, kernel, inputs]
        return patches.reshape(rows.outputs * columns.outputs, -1) @ self.weight.reshape(-1, self.weight.shape[-1])


class _Axis:
    """Where a SAME-padded, strided kernel falls along one axis."""

    def __init__(self, length: int, kernel: int, stride: int) -> None:
        self.kernel, self.stride, self.length = kernel, stride, length
        self.outputs = -(-length // stride)
        total = max((self.outputs - 1) * stride + kernel - length, 0)
        self.padding = (total // 2, total - total // 2)

    def every(self, offset: int) -> slice:
        """The padded positions that meet the kernel's element `offset`, one per output."""
        return slice(offset, offset + self.stride * (self.outputs - 1) + 1, self.stride)

    def overlap(self, output: int) -> tuple[slice, slice]:
        """The part of the picture, and of the kernel, that meet at one output."""
        start = output * self.stride - self.padding[0]
        first, last = max(0, -start), min(self.kernel, self.length - start)
        return slice(start + first, start + last), slice(first, last)


class Linear(eqx.Module):
    """x W + b."""

    weight: Float[Array, "inputs outputs"]
    bias: Float[Array, " outputs"]

    def __call__(self, x: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
        return x @ self.weight + self.bias


class Trunk(eqx.Module):
    """Observation -> features: every layer is followed by a ReLU."""

    convolutions: tuple[Convolution, ...]
    layers: tuple[Linear, ...]
    pooling: bool = eqx.field(static=True, default=False)

    def __call__(self, observation: Num[Array, "..."]) -> Float[Array, " F"]:
        """A uint8 picture is scaled to [0, 1]; anything else is taken as it is."""
        x = observation.astype(jnp.float32)
        if observation.dtype == jnp.uint8:
            x = x * jnp.float32(1 / 255)
        for convolution in self.convolutions:
            x = jax.nn.relu(convolution(x))
        x = jnp.max(x, axis=(0, 1)) if self.pooling else x.ravel()
        for layer in self.layers:
            x = jax.nn.relu(layer(x))
        return x


class QNetwork(eqx.Module):
    """Observation -> one value per option."""

    convolutions: tuple[Convolution, ...]
    layers: tuple[Linear, ...]
    pooling: bool = eqx.field(static=True, default=False)

    def __call__(self, observation: Num[Array, "..."]) -> Float[Array, " O"]:
        features = Trunk(self.convolutions, self.layers[:-1], self.pooling)(observation)
        return self.layers[-1](features)


def init_q_network(
    config: NetworkConfig, observation_shape: tuple[int, ...], outputs: int, key: PRNGKeyArray
) -> QNetwork:
    """A network with Glorot-uniform weights and zero biases.

    Raises `InvalidConfig` if convolutions are asked for where observations are no pictures.
    """
    convolutions, layers = build_layers(config, draw_weights(key, weight_shapes(config, observation_shape, outputs)))
    return QNetwork(convolutions, layers, config.pooling)


def weight_shapes(config: NetworkConfig, observation_shape: tuple[int, ...], outputs: int) -> list[tuple[int, ...]]:
    """Shapes of a network's weights, from the picture to the values: [kernel, kernel, inputs, outputs] of each
    convolution, then [inputs, outputs] of each layer.

    Raises `InvalidConfig` if convolutions are asked for where observations are no pictures.
    """
    if config.kernels and len(observation_shape) != 3:
        raise InvalidConfig(
            f"Convolutions need pictures [height, width, channels], but observations have shape {observation_shape}; "
            "choose kernels, strides and channels empty, or observation 'rgb' or 'planes'."
        )
    shape = observation_shape
    weights: list[tuple[int, ...]] = []
    for kernel, stride, channels in zip(config.kernels, config.strides, config.channels, strict=True):
        height, width, inputs = shape
        weights.append((kernel, kernel, inputs, channels))
        shape = (-(-height // stride), -(-width // stride), channels)
    features = shape[-1] if config.pooling else math.prod(shape)
    return weights + list(pairwise((features, *config.hidden, outputs)))


def draw_weights(key: PRNGKeyArray, shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """Glorot-uniform weights, all from one draw: every further random call would cost its own second of compilation."""
    sizes = [math.prod(shape) for shape in shapes]
    parts = jnp.split(jax.random.uniform(key, (sum(sizes),), minval=-1, maxval=1), list(accumulate(sizes))[:-1])
    return [_glorot_limit(shape) * part.reshape(shape) for shape, part in zip(shapes, parts, strict=True)]


def build_layers(config: NetworkConfig, weights: Sequence[Array]) -> tuple[tuple[Convolution, ...], tuple[Linear, ...]]:
    """Convolutions and layers of these weights, in the order of `weight_shapes`, with zero biases."""
    deep = len(config.kernels)
    convolutions = (
        Convolution(weight, jnp.zeros(weight.shape[-1]), stride)
        for weight, stride in zip(weights[:deep], config.strides, strict=True)
    )
    return tuple(convolutions), tuple(Linear(weight, jnp.zeros(weight.shape[-1])) for weight in weights[deep:])


def _glorot_limit(shape: tuple[int, ...]) -> float:
    """Bound of a uniform draw with variance 2 / (inputs + outputs) (Glorot and Bengio 2010)."""
    receptive = math.prod(shape[:-2])
    return math.sqrt(6 / (receptive * (shape[-2] + shape[-1])))


def count_parameters(network: PyTree) -> int:
    """How many numbers are learned."""
    return sum(leaf.size for leaf in jax.tree.leaves(network))
