"""Intervals: exact coverage, the library functions of scipy, and what they refuse."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from distfilt.metrics import Interval, mean_interval, median_interval, proportion_interval


@pytest.mark.parametrize("level", [0.5, 0.9, 0.95, 0.99])
@pytest.mark.parametrize("n", [2, 3, 8, 50, 301])
def test_intervals_are_those_of_scipy(n, level):
    values = np.random.default_rng(n).standard_normal(n) ** 3
    found = mean_interval(values, level=level)
    exact = stats.t.interval(level, n - 1, values.mean(), stats.sem(values))
    assert (found.low, found.high) == pytest.approx(exact, rel=1e-12)
    assert found.error == pytest.approx(stats.sem(values), rel=1e-12)
    for k in sorted({0, 1, n // 3, n - 1, n}):
        ours = proportion_interval(k, n, level=level)
        theirs = stats.binomtest(k, n).proportion_ci(level, method="exact")
        # scipy searches these roots; the quantiles of the beta distribution are the roots.
        assert (ours.low, ours.high) == pytest.approx(tuple(theirs), abs=1e-11)
        assert ours.error == pytest.approx(np.sqrt(k / n * (1 - k / n) / n), rel=1e-12)
    if n >= 8 and (n > 8 or level < 0.99):
        ours = median_interval(values, level=level)
        theirs = stats.quantile_test(values).confidence_interval(level)
        assert (ours.low, ours.high) == tuple(theirs)
        assert ours.estimate == np.median(values)


def test_values_that_are_all_alike():
    found = mean_interval([2.0, 2.0, 2.0])
    assert (found.estimate, found.low, found.high, found.error) == (2.0, 2.0, 2.0, 0.0)


def test_tiny_levels_keep_the_estimate_inside():
    for k in range(5):
        found = proportion_interval(k, 4, level=1e-6)
        assert found.low <= k / 4 <= found.high


def test_median_interval_error_tends_to_the_standard_error():
    values = stats.norm.ppf((np.arange(100000) + 0.5) / 100000)
    exact = np.sqrt(np.pi / 2 / 100000)  # asymptotic, Gaussian
    assert median_interval(values).error == pytest.approx(exact, rel=0.01)


def test_interval_is_compact_and_holds_its_ends():
    interval = Interval(1.23456, 1.1, 1.4, 0.05)
    assert str(interval) == "1.23 [1.1, 1.4]"
    assert 1.1 in interval and 1.4 in interval and 1.41 not in interval


def test_too_few_values_and_more_successes_than_trials_are_refused():
    with pytest.raises(ValueError, match="^values: needs at least 2"):
        mean_interval([1.0])
    with pytest.raises(ValueError, match="^values: needs more values for level 0.95"):
        median_interval([1.0, 2.0, 3.0, 4.0, 5.0])
    with pytest.raises(ValueError, match="^level: needs a number at least 1e-09"):
        median_interval([1.0] * 9, level=0.0)
    with pytest.raises(ValueError, match="^successes: needs at most as many as trials"):
        proportion_interval(5, 4)
