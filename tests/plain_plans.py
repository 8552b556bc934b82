"""A step of a network that plans, once more in NumPy and in loops."""

from __future__ import annotations

import numpy as np


def numpy_bell(centre, log_variance, column):
    variance = np.exp(np.clip(log_variance, -5.0, 5.0))
    return np.exp(-((column - centre) ** 2) / (2 * variance))


def numpy_attention(focus, columns, width):
    filters = np.zeros((width, columns))
    middle = (focus[0] + 1) / 2 * (columns - 1)
    stride = (columns - 1) / max(1, width - 1) * np.exp(np.clip(focus[1], -5.0, 5.0))
    for i in range(1, width + 1):
        row = [numpy_bell(middle + (i - width / 2 - 0.5) * stride, focus[2], column) for column in range(columns)]
        filters[i - 1] = np.array(row) / (sum(row) + 1e-8)
    return filters


def numpy_linear(layer, x):
    return x @ np.asarray(layer.weight, np.float64) + np.asarray(layer.bias, np.float64)


def numpy_step(one, seen, plan, anew, noise, sharpness):
    """The whole step, from the observation on; returns the plan, the commitment and the divergence."""
    shape, old, c = one.shape, np.asarray(plan.logits, np.float64), np.asarray(plan.commitment, np.float64)
    rows, columns = old.shape
    shifted = np.zeros_like(old)
    for column in range(columns - 1):
        shifted[:, column] = old[:, column + 1]
    if not anew:
        return shifted, np.array([*c[1:], 1.0]), 0.0
    z = np.maximum(numpy_linear(one.trunk.layers[0], np.asarray(seen, np.float64)), 0)
    focus = numpy_linear(one.focus, z)
    filters = numpy_attention(focus, columns, shape.patch)
    glimpse = np.zeros((rows, shape.patch))
    for row in range(rows):
        for k in range(shape.patch):
            glimpse[row, k] = sum(filters[k, t] * old[row, t] for t in range(columns))
    code = np.maximum(numpy_linear(one.encoder[0], np.concatenate([glimpse.ravel(), z])), 0)
    code = np.tanh(numpy_linear(one.encoder[1], code))
    apart = 0.0
    if shape.noisy:
        both = numpy_linear(one.noise, code)
        mean, log_variance = both[: len(code)], np.clip(both[len(code) :], -5, 5)
        apart = sum(0.5 * (m**2 + np.exp(v) - 1 - v) for m, v in zip(mean, log_variance, strict=True))
        code = mean + np.exp(log_variance / 2) * np.asarray(noise, np.float64)
    patch = numpy_linear(one.patch, np.concatenate([code, z])).reshape(rows, shape.patch)
    for row in range(rows):
        for column in range(columns):
            shifted[row, column] += sum(patch[row, k] * filters[k, column] for k in range(shape.patch))
    when = numpy_linear(one.schedule, np.concatenate([focus, code]))
    log_variance = 2 - np.log1p(np.exp(2 - when[1]))
    bells = [numpy_bell((when[0] + 1) / 2 * (columns - 1), log_variance, column) for column in range(columns)]
    logits = sharpness * (shape.background + shape.peak * np.array(bells))
    return shifted, 1 / (1 + np.exp(-logits)), apart
