"""Errors, consistency and scores against their definitions, closed forms and exact coverage."""

from __future__ import annotations

import numpy as np
import pytest
import scoringrules
from scipy import stats

from distfilt.metrics import (
    crps,
    gaussian_crps,
    mean_interval,
    median_interval,
    nees,
    nees_band,
)
from distfilt.metrics.intervals import Interval, proportion_interval
from distfilt.metrics.scores import nis
from tests.support import generator, spd

RNG = np.random.default_rng(0)


def test_leading_axes_broadcast():
    estimates = RNG.standard_normal((7, 3, 6, 2))  # runs, agents, members, components
    truth = RNG.standard_normal((7, 1, 2))
    scores = crps(estimates, truth)
    for r in range(7):
        for a in range(3):
            expected = crps(estimates[r, a], truth[r, 0])
            assert np.allclose(scores[r, a], expected, rtol=1e-12)


# --- consistency ------------------------------------------------------------------------------


@pytest.mark.parametrize("leading", [(), (3,), (50, 2)])
def test_nees_and_nis_are_their_definitions(leading):
    rng = generator(5)
    estimate, truth = rng.standard_normal((2, *leading, 4))
    cov = spd(rng, 4, leading)
    error = estimate - truth
    # eᵀ P⁻¹ e
    whitened = np.linalg.solve(cov, error[..., None])[..., 0]
    exact = (error * whitened).sum(-1)
    assert nees(estimate, cov, truth).shape == leading
    assert np.allclose(nees(estimate, cov, truth), exact, rtol=1e-10)
    assert np.allclose(nis(error, cov), exact, rtol=1e-10)
    # One covariance for all estimates
    one = cov[(0,) * len(leading)]
    whitened = np.linalg.solve(one, error[..., None])[..., 0]
    exact = (error * whitened).sum(-1)
    assert np.allclose(nees(estimate, one, truth), exact, rtol=1e-10)
    with pytest.raises(ValueError, match="^truth must have leading axes"):
        nees(np.ones((2, 4)), one, np.ones((3, 4)))


@pytest.mark.parametrize(
    "dim, runs, level", [(1, 1, 0.95), (6, 24, 0.95), (13, 100, 0.99)]
)
def test_nees_band_has_its_probability(dim, runs, level):
    band = nees_band(dim, runs, level=level)
    # The sum of n NEES values is chi-square with n d degrees of freedom.
    law = stats.chi2(dim * runs)
    below_high = law.cdf(band.high * runs)
    below_low = law.cdf(band.low * runs)
    probability = below_high - below_low
    assert probability == pytest.approx(level, abs=1e-10)
    # Divided by d, with the expected value 1
    unit = nees_band(dim, runs, level=level, normalised=True)
    normalised = [unit.low, unit.high, unit.error]
    expected = np.array([band.low, band.high, band.error]) / dim
    assert np.allclose(normalised, expected, rtol=1e-12)
    assert dim in band
    assert 1 in unit
    # Var χ²_d = 2 d
    assert band.error == pytest.approx(np.sqrt(2 * dim / runs), rel=1e-12)


# --- scores -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "mean, std, truth", [(0.0, 1.0, 0.0), (2.0, 0.3, 1.1), (-1.0, 5.0, 9.0)]
)
def test_gaussian_crps_is_that_of_scoringrules(mean, std, truth):
    exact = scoringrules.crps_normal(truth, mean, std)
    assert gaussian_crps(mean, std, truth) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("n", [1, 2, 50])
def test_crps_is_that_of_scoringrules(n):
    rng = generator(n)
    x = rng.standard_normal((3, n, 2))
    y = rng.standard_normal((3, 2))
    weights = rng.dirichlet([1] * n, 3)
    # E|X - y| - ½ E|X - X'| by its double sum
    options = {"m_axis": 1, "estimator": "nrg"}
    exact = scoringrules.crps_ensemble(y, x, **options)
    assert np.allclose(crps(x, y), exact, rtol=0, atol=1e-13)
    both = np.broadcast_to(weights[..., None], x.shape)
    exact = scoringrules.crps_ensemble(y, x, ens_w=both, **options)
    assert np.allclose(crps(x, y, weights=weights), exact, rtol=0, atol=1e-13)


# --- intervals --------------------------------------------------------------------------------


@pytest.mark.parametrize("level", [0.5, 0.9, 0.95, 0.99])
@pytest.mark.parametrize("n", [2, 3, 8, 50, 301])
def test_intervals_have_their_level(n, level):
    values = np.random.default_rng(n).standard_normal(n) ** 3
    interval = mean_interval(values, level=level)
    exact = stats.ttest_1samp(values, 0).confidence_interval(level)
    assert (interval.low, interval.high) == pytest.approx(tuple(exact), rel=1e-12)
    assert interval.error == pytest.approx(stats.sem(values), rel=1e-12)
    tail = (1 - level) / 2
    for k in sorted({0, 1, n // 3, n - 1, n}):
        ours = proportion_interval(k, n, level=level)
        # One tail beyond each end, but for the ends 0 and 1
        above = stats.binom.sf(k - 1, n, ours.low)
        below = stats.binom.cdf(k, n, ours.high)
        expected_above = tail if k > 0 else 1
        expected_below = tail if k < n else 1
        assert above == pytest.approx(expected_above)
        assert below == pytest.approx(expected_below)
        assert (ours.low == 0) == (k == 0)
        assert (ours.high == 1) == (k == n)
        # √(p (1 - p) / n)
        p = k / n
        standard_error = np.sqrt(p * (1 - p) / n)
        assert ours.error == pytest.approx(standard_error, rel=1e-12)
    # The range of n values covers the median with a probability of 1 - 2^(1 - n) only.
    if n >= 8 and (n > 8 or level < 0.99):
        ours = median_interval(values, level=level)
        theirs = stats.quantile_test(values).confidence_interval(level)
        assert (ours.low, ours.high) == tuple(theirs)
        assert ours.estimate == np.median(values)


def test_a_level_that_is_met_exactly_needs_no_wider_interval():
    # The range of three values misses the median with probability 2 / 2^3.
    interval = median_interval([1.0, 2.0, 4.0], level=0.75)
    assert (interval.low, interval.high) == (1, 4)


def test_values_that_are_all_alike():
    interval = mean_interval([2.0, 2.0, 2.0])
    assert interval.estimate == 2.0
    assert (interval.low, interval.high) == (2.0, 2.0)
    assert interval.error == 0.0


def test_tiny_levels_keep_the_estimate_inside():
    for k in range(5):
        interval = proportion_interval(k, 4, level=1e-6)
        assert interval.low <= k / 4 <= interval.high


def test_median_interval_error_tends_to_the_standard_error():
    values = stats.norm.ppf((np.arange(100000) + 0.5) / 100000)
    # 1 / (2 f(m) √n) with the Gaussian density f(m) = 1/√(2 π)
    exact = np.sqrt(np.pi / 2 / 100000)
    assert median_interval(values).error == pytest.approx(exact, rel=0.01)


def test_interval_is_compact_and_holds_its_ends():
    interval = Interval(1.23456, 1.1, 1.4, 0.05)
    assert str(interval) == "1.23 [1.1, 1.4]"
    assert 1.1 in interval
    assert 1.4 in interval
    assert 1.41 not in interval


def test_too_few_values_are_refused():
    with pytest.raises(ValueError, match="^values must have at least 2"):
        mean_interval([1.0])
    # The range of five values covers the median with 1 - 2^(-4) = 0.9375.
    text = "^values must have more values for level 0.95"
    with pytest.raises(ValueError, match=text):
        median_interval([1.0, 2.0, 3.0, 4.0, 5.0])
