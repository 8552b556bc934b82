import numpy as np
import pytest
from fake_comparison import seeds_that_differ
from scipy import stats

from lodestone.report.statistics import estimate, interquartile_mean


@pytest.mark.parametrize("seeds", [1, 2, 3, 4, 6, 8, 10, 11])
def test_interquartile_mean_is_the_trimmed_mean(seeds: int) -> None:
    values = np.random.default_rng(seeds).normal(size=(seeds, 5, 3))
    np.testing.assert_allclose(interquartile_mean(values), stats.trim_mean(values, 0.25, axis=0), rtol=1e-12)


def test_an_outlier_and_an_unreached_seed_are_cut_off() -> None:
    assert interquartile_mean(np.array([1.0, 2.0, 3.0, 1e9])) == 2.5
    assert interquartile_mean(np.array([1.0, 2.0, 3.0, np.inf])) == 2.5
    assert interquartile_mean(np.array([1.0, 2.0, np.inf, np.inf])) == np.inf
    assert np.isnan(interquartile_mean(np.array([1.0, 2.0, 3.0, np.nan])))


def test_two_seeds_have_an_interval_from_one_to_the_other() -> None:
    """A resample of two seeds is one of them alone with probability 1/4 each, far above the 2.5 % tails."""
    result = estimate(np.array([1.0, 5.0]))
    assert (result.iqm, result.low, result.high) == (3.0, 1.0, 5.0)


def test_the_interval_agrees_with_scipy() -> None:
    values = seeds_that_differ(12)
    ours = estimate(values)
    theirs = stats.bootstrap(
        (values,),
        lambda sample, axis: stats.trim_mean(sample, 0.25, axis=axis),
        method="percentile",
        n_resamples=20_000,
        rng=np.random.default_rng(1),
    ).confidence_interval
    spread = theirs.high - theirs.low
    np.testing.assert_allclose((ours.low, ours.high), (theirs.low, theirs.high), atol=0.06 * spread)


def test_the_interval_covers_the_mean_of_normal_seeds() -> None:
    """Of a thousand experiments with ten seeds; the percentile bootstrap of ten is known to be a little narrow."""
    result = estimate(np.random.default_rng(3).normal(size=(10, 1000)))
    covered = np.mean((result.low <= 0) & (result.high >= 0))
    assert 0.87 <= covered <= 0.97


def test_whole_seeds_are_drawn() -> None:
    """What holds in every seed at two x values holds at the ends of the intervals."""
    values = seeds_that_differ(8)
    result = estimate(np.stack([values, 2 * values + 1], axis=1))
    np.testing.assert_allclose(result.low[1], 2 * result.low[0] + 1)
    np.testing.assert_allclose(result.high[1], 2 * result.high[0] + 1)


def test_the_same_numbers_every_time() -> None:
    values = seeds_that_differ(7)
    np.testing.assert_array_equal(estimate(values), estimate(values))
