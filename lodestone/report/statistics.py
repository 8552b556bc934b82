"""The mean over seeds that a few lucky or unlucky seeds cannot move, and how sure one may be of it.

Interquartile mean and bootstrap over seeds as Agarwal et al. (2021, "Deep reinforcement learning at the edge of the
statistical precipice") recommend for few seeds.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

RESAMPLES = 2000
CONFIDENCE = 0.95


class Estimate(NamedTuple):
    """An interquartile mean over seeds and its 95 % confidence interval; scalars or arrays of one shape."""

    iqm: Float[np.ndarray, "*x"]
    low: Float[np.ndarray, "*x"]
    high: Float[np.ndarray, "*x"]


def interquartile_mean(values: Float[np.ndarray, "S *x"]) -> Float[np.ndarray, "*x"]:
    """Mean over the seeds (the first axis) without the lowest and the highest quarter, rounded down to whole seeds.

    Infinity stands for what a seed never reached, and makes the mean infinite unless it is cut off. Not a number
    wherever one seed has no number.
    """
    seeds = len(values)
    cut = seeds // 4
    ordered = np.sort(values, axis=0)  # not-a-number comes last
    return np.where(np.isnan(ordered[-1]), np.nan, ordered[cut : seeds - cut].mean(axis=0))


def estimate(values: Float[np.ndarray, "S *x"]) -> Estimate:
    """Interquartile mean over seeds with its percentile bootstrap interval.

    Whole seeds are drawn anew, with replacement: what one seed did at different x stays together. The draws are the
    same in every call, so that a report is reproduced exactly.
    """
    seeds = len(values)
    drawn = np.random.default_rng(0).integers(seeds, size=(seeds, RESAMPLES))
    means = np.sort(interquartile_mean(values[drawn]), axis=0)
    tail = int(RESAMPLES * (1 - CONFIDENCE) / 2)
    # Order statistics rather than quantiles: those interpolate, and infinity has no interpolation.
    return Estimate(interquartile_mean(values), means[tail], means[-1 - tail])
