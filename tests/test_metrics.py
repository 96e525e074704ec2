"""Errors, scores and intervals against their definitions, closed forms and exact coverage."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.integrate import quad

from distfilt import intervals, metrics
from distfilt.metrics import (
    Interval,
    crps,
    ensemble_nees,
    gaussian_crps,
    mean_interval,
    median_interval,
    nees,
    nees_band,
    proportion_interval,
    rmse,
    spread,
    squared_error,
)

RNG = np.random.default_rng(0)
ENSEMBLE = np.arange(12.0).reshape(4, 3) ** 2 + np.eye(4, 3)
SINGULAR = np.stack([np.arange(5.0), 2 * np.arange(5.0), np.ones(5) + np.arange(5.0) ** 2], -1)

_CASES = {
    "squared_error": [
        ("estimate", lambda: squared_error(1.0, [1.0])),
        ("estimate", lambda: squared_error([np.nan, 1.0], [1.0, 1.0])),
        ("truth", lambda: squared_error([1.0, 2.0], [1.0, 2.0, 3.0])),
        ("truth", lambda: squared_error(np.zeros((2, 1)), np.zeros((3, 1)))),
    ],
    "rmse": [
        ("estimate", lambda: rmse("a", [1.0])),
        ("estimate", lambda: rmse(np.zeros((0, 2)), np.zeros(2))),
        ("truth", lambda: rmse([1.0, 2.0], [np.inf, 1.0])),
        ("axis", lambda: rmse(np.zeros((4, 2)), np.zeros(2), axis=1)),
        ("axis", lambda: rmse(np.zeros((4, 2)), np.zeros(2), axis=(0, -1))),
        ("axis", lambda: rmse(np.zeros((4, 2)), np.zeros(2), axis="runs")),
    ],
    "nees": [
        ("estimate", lambda: nees([np.inf], [[1.0]], [0.0])),
        ("cov", lambda: nees([1.0, 2.0], np.eye(3), [0.0, 0.0])),
        ("cov", lambda: nees([1.0, 2.0], [[1.0, 2.0], [2.0, 1.0]], [0.0, 0.0])),
        ("cov", lambda: nees([1.0, 2.0], [[1.0, 0.5], [0.2, 1.0]], [0.0, 0.0])),
        ("cov", lambda: nees(np.zeros((3, 1)), np.ones((2, 1, 1)), [0.0])),
        ("truth", lambda: nees([1.0, 2.0], np.eye(2), [0.0])),
    ],
    "ensemble_nees": [
        ("ensemble", lambda: ensemble_nees(np.zeros(3), np.zeros(3))),
        ("ensemble", lambda: ensemble_nees(ENSEMBLE[:3], np.zeros(3))),
        ("ensemble", lambda: ensemble_nees(ENSEMBLE[:1], np.zeros(3))),
        ("ensemble", lambda: ensemble_nees(np.ones((9, 2)), np.zeros(2))),
        ("ensemble", lambda: ensemble_nees(SINGULAR, np.zeros(3))),
        ("truth", lambda: ensemble_nees(ENSEMBLE, np.zeros(2))),
    ],
    "nees_band": [
        ("dim", lambda: nees_band(0, 10)),
        ("count", lambda: nees_band(3, 1.5)),
        ("level", lambda: nees_band(3, 10, level=1.0)),
    ],
    "crps": [
        ("ensemble", lambda: crps(np.zeros(3), np.zeros(3))),
        ("ensemble", lambda: crps(np.zeros((0, 3)), np.zeros(3))),
        ("ensemble", lambda: crps(np.zeros((1, 3)), np.zeros(3), fair=True)),
        ("truth", lambda: crps(ENSEMBLE, [np.nan, 0.0, 0.0])),
        ("truth", lambda: crps(np.zeros((2, 4, 3)), np.zeros((3, 3)))),
    ],
    "gaussian_crps": [
        ("mean", lambda: gaussian_crps(np.nan, 1.0, 0.0)),
        ("std", lambda: gaussian_crps(0.0, 0.0, 0.0)),
        ("std", lambda: gaussian_crps(0.0, -1.0, 0.0)),
        ("truth", lambda: gaussian_crps([0.0, 0.0], 1.0, [1.0, 2.0, 3.0])),
    ],
    "spread": [
        ("ensemble", lambda: spread(ENSEMBLE[:1])),
        ("ensemble", lambda: spread([1.0, 2.0])),
        ("ensemble", lambda: spread(np.zeros((4, 0)))),
    ],
    "mean_interval": [
        ("values", lambda: mean_interval([1.0])),
        ("values", lambda: mean_interval([1.0, np.nan])),
        ("level", lambda: mean_interval([1.0, 2.0], level=0.0)),
    ],
    "median_interval": [
        ("values", lambda: median_interval([])),
        ("values", lambda: median_interval([1.0, 2.0, 3.0, 4.0, 5.0])),
        ("level", lambda: median_interval(np.arange(9.0), level=95)),
    ],
    "proportion_interval": [
        ("successes", lambda: proportion_interval(5, 4)),
        ("successes", lambda: proportion_interval(-1, 4)),
        ("trials", lambda: proportion_interval(0, 0)),
        ("level", lambda: proportion_interval(1, 4, level=-0.5)),
    ],
    "Interval": [
        ("estimate", lambda: Interval(np.nan, 0.0, 1.0, 0.1)),
        ("low", lambda: Interval(0.5, 0.6, 1.0, 0.1)),
        ("high", lambda: Interval(0.5, 0.0, 0.4, 0.1)),
        ("error", lambda: Interval(0.5, 0.0, 1.0, -0.1)),
        ("value", lambda: "much" in Interval(0.5, 0.0, 1.0, 0.1)),
    ],
}
BAD_INPUT = {f"distfilt.metrics.{name}": cases for name, cases in _CASES.items()} | {
    f"distfilt.intervals.{name}": _CASES[name] for name in intervals.__all__
}
EXEMPT: dict[str, str] = {}


@pytest.mark.parametrize("name", sorted(BAD_INPUT))
def test_bad_input_is_named(name):
    for argument, call in BAD_INPUT[name]:
        with pytest.raises(ValueError, match=rf"^{argument}: "):
            call()


def test_every_public_name_has_bad_input():
    assert {f"distfilt.metrics.{name}" for name in metrics.__all__} <= BAD_INPUT.keys()


def test_nothing_is_mutated():
    before = ENSEMBLE.copy()
    truth = np.zeros(3)
    for call in (crps, ensemble_nees):
        call(ENSEMBLE, truth)
    median_interval(values := np.array([3.0, 1.0, 2.0, 5.0, 4.0, 0.0]))
    assert (before == ENSEMBLE).all() and (truth == 0).all()
    assert values.tolist() == [3.0, 1.0, 2.0, 5.0, 4.0, 0.0]


# --- errors -----------------------------------------------------------------------------------


def test_rmse_takes_the_root_last():
    errors = RNG.standard_normal((5, 3, 4, 2))
    square = (errors**2).sum(-1)
    zero = np.zeros(2)
    assert np.allclose(squared_error(errors, zero), square, rtol=1e-15)
    assert np.allclose(rmse(errors, zero), np.sqrt(square.mean()), rtol=1e-14)
    assert np.allclose(rmse(errors, zero, axis=0), np.sqrt(square.mean(0)), rtol=1e-14)
    assert np.allclose(rmse(errors, zero, axis=(0, -1)), np.sqrt(square.mean((0, 2))), rtol=1e-14)
    assert np.allclose(rmse(errors, zero, axis=()), np.sqrt(square), rtol=1e-14)


def test_leading_axes_broadcast():
    estimates = RNG.standard_normal((7, 3, 6, 2))  # runs, agents, members, components
    truth = RNG.standard_normal((7, 1, 2))
    for score in (crps, ensemble_nees):
        whole = score(estimates, truth)
        for r in range(7):
            for a in range(3):
                assert np.allclose(whole[r, a], score(estimates[r, a], truth[r, 0]), rtol=1e-12)


# --- consistency ------------------------------------------------------------------------------

# Multiples of 1/8 keep a random map away from both overflow and hidden cancellation.
EIGHTHS = st.integers(-16, 16).map(lambda k: k / 8)


@given(st.lists(EIGHTHS, min_size=9, max_size=9), st.lists(EIGHTHS, min_size=3, max_size=3))
def test_nees_is_invariant_under_an_invertible_map(entries, gap):
    linear = np.reshape(entries, (3, 3)) + 8 * np.eye(3)  # diagonally dominant: invertible
    half = np.array([[2.0, 0.0, 0.0], [1.0, 1.5, 0.0], [-0.5, 0.25, 1.0]])
    p = half @ half.T
    mapped = linear @ p @ linear.T
    before = nees(np.array(gap), p, np.zeros(3))
    after = nees(linear @ gap, 0.5 * (mapped + mapped.T), np.zeros(3))
    assert after == pytest.approx(before, rel=1e-10, abs=1e-12)
    members = np.random.default_rng(1).standard_normal((9, 3))
    before = ensemble_nees(members, np.array(gap))
    assert ensemble_nees(members @ linear.T, linear @ gap) == pytest.approx(before, rel=1e-9)


def test_ensemble_nees_equals_nees_with_the_sample_covariance():
    x = RNG.standard_normal((4, 30, 5)) @ np.diag([1e-6, 1.0, 1e6, 3.0, 1.0])
    cov = np.stack([np.cov(e, rowvar=False) for e in x])
    expected = nees(x.mean(-2), cov, np.zeros(5))
    assert np.allclose(ensemble_nees(x, np.zeros(5)), expected, rtol=1e-9)


def test_smallest_ensemble_that_has_a_nees():
    x = np.vstack([np.zeros(3), np.eye(3)])  # N = d + 1
    cov = np.cov(x, rowvar=False)
    expected = x.mean(0) @ np.linalg.solve(cov, x.mean(0))
    assert ensemble_nees(x, np.zeros(3)) == pytest.approx(expected, rel=1e-12)


def test_honest_ensembles_average_as_documented():
    n, d = 20, 3
    x = np.random.default_rng(3).standard_normal((20000, n + 1, d))
    values = ensemble_nees(x[:, 1:], x[:, 0])
    interval = mean_interval(values, level=0.999)  # one false alarm in a thousand seeds
    assert d * (1 + 1 / n) * (n - 1) / (n - d - 2) in interval
    assert d not in interval


@pytest.mark.parametrize("dim, runs, level", [(1, 1, 0.95), (6, 24, 0.95), (13, 100, 0.99)])
def test_nees_band_has_its_probability(dim, runs, level):
    band = nees_band(dim, runs, level=level)
    law = stats.chi2(dim * runs)
    assert law.cdf(band.high * runs) - law.cdf(band.low * runs) == pytest.approx(level, abs=1e-10)
    unit = nees_band(dim, runs, level=level, normalised=True)
    assert np.allclose([unit.low, unit.high, unit.error],
                       np.array([band.low, band.high, band.error]) / dim, rtol=1e-12)  # fmt: skip
    assert dim in band and 1 in unit
    assert band.error == pytest.approx(np.sqrt(2 * dim / runs), rel=1e-12)


def test_nees_band_covers_gaussian_errors():
    rng, trials = np.random.default_rng(4), 4000
    half = np.array([[2.0, 0.0], [1.0, 0.5]])
    errors = rng.standard_normal((trials, 25, 2)) @ half.T
    averages = nees(errors, half @ half.T, np.zeros(2)).mean(axis=1)
    band = nees_band(2, 25)
    inside = int(sum(a in band for a in averages))
    # With 99.9% confidence the share of a band of 95% lies in its Clopper-Pearson interval.
    assert 0.95 in proportion_interval(inside, trials, level=0.999)
    overconfident = nees(2 * errors, half @ half.T, np.zeros(2)).mean(axis=1)
    assert np.mean([a in band for a in overconfident]) < 0.01


# --- scores -----------------------------------------------------------------------------------


def _crps_by_definition(x, y, fair):
    n = len(x)
    pairs = np.abs(x[:, None] - x[None, :]).sum() / (n * (n - 1) if fair else n * n)
    return np.abs(x - y).mean() - 0.5 * pairs


@pytest.mark.parametrize("fair", [False, True])
@pytest.mark.parametrize("n", [2, 3, 50, 201])
def test_crps_equals_its_definition(n, fair):
    x, y = RNG.standard_normal((3, n, 4)), RNG.standard_normal((3, 4))
    out = crps(x, y, fair=fair)
    expected = [
        [_crps_by_definition(x[r, :, k], y[r, k], fair) for k in range(4)] for r in range(3)
    ]
    assert np.abs(out - expected).max() < 1e-12


def test_crps_equals_the_integral_of_squared_distribution_functions():
    x, y = np.array([-1.0, 0.5, 0.5, 3.0]), 1.25
    knots = np.sort(np.append(x, y))
    middles = (knots[1:] + knots[:-1]) / 2
    steps = ((x <= middles[:, None]).mean(axis=1) - (y <= middles)) ** 2
    assert crps(x[:, None], [y])[0] == pytest.approx((steps * np.diff(knots)).sum(), abs=1e-14)


def test_crps_of_one_member_is_the_absolute_error():
    assert crps([[1.5, -2.0]], [1.0, 1.0]).tolist() == [0.5, 3.0]


@given(
    st.lists(st.integers(-1000, 1000), min_size=1, max_size=20),
    st.integers(-1000, 1000),
    st.integers(-(2**20), 2**20),
)
def test_crps_is_translation_invariant_and_ordered(values, y, shift):
    x = np.array(values, dtype=float)[:, None]
    score = crps(x, [float(y)])
    assert crps(x + shift, [float(y + shift)]) == score  # integers: no rounding
    assert crps(x[::-1], [float(y)]) == score
    assert 0 <= score[0] <= np.abs(x - y).mean()


@pytest.mark.parametrize("mean, std, truth", [(0.0, 1.0, 0.0), (2.0, 0.3, 1.1), (-1.0, 5.0, 9.0)])
def test_gaussian_crps_equals_its_integral(mean, std, truth):
    cdf = stats.norm(mean, std).cdf
    below, _ = quad(lambda u: cdf(u) ** 2, mean - 12 * std, truth, epsabs=1e-12)
    above, _ = quad(lambda u: (1 - cdf(u)) ** 2, truth, mean + 12 * std, epsabs=1e-12)
    assert gaussian_crps(mean, std, truth) == pytest.approx(below + above, abs=1e-9)


def test_fair_crps_is_unbiased_for_the_gaussian():
    x = np.random.default_rng(5).standard_normal((20000, 5, 1))
    exact = float(gaussian_crps(0.0, 1.0, 0.7))
    assert exact in mean_interval(crps(x, [0.7], fair=True)[:, 0], level=0.999)
    assert exact not in mean_interval(crps(x, [0.7])[:, 0], level=0.999)


def test_spread_matches_rmse_for_an_honest_ensemble():
    n, scale = 10, np.array([1.0, 5.0, 0.1])
    x = np.random.default_rng(6).standard_normal((20000, n + 1, 3)) * scale
    square = spread(x[:, 1:]) ** 2
    assert np.allclose(square[0], np.trace(np.cov(x[0, 1:], rowvar=False)), rtol=1e-12)
    gap = squared_error(x[:, 1:].mean(1), x[:, 0]) - (1 + 1 / n) * square
    assert 0.0 in mean_interval(gap, level=0.999)


# --- intervals --------------------------------------------------------------------------------


@pytest.mark.parametrize("level", [0.9, 0.95])
@pytest.mark.parametrize("n", [1, 2, 7, 30])
def test_clopper_pearson_covers_exactly(n, level):
    found = [proportion_interval(k, n, level=level) for k in range(n + 1)]
    for p in np.linspace(0, 1, 301):
        law = stats.binom.pmf(np.arange(n + 1), n, p)
        coverage = sum(w for w, interval in zip(law, found, strict=True) if p in interval)
        assert coverage >= level - 1e-12
    for k, interval in enumerate(found):
        # Each tail at an end is exactly (1 - level)/2: no shorter interval of this kind covers.
        if k > 0:
            assert stats.binom.sf(k - 1, n, interval.low) == pytest.approx((1 - level) / 2)
        if k < n:
            assert stats.binom.cdf(k, n, interval.high) == pytest.approx((1 - level) / 2)


@pytest.mark.parametrize("n", [6, 7, 20, 101])
def test_median_interval_covers_and_no_shorter_one_does(n):
    values = np.random.default_rng(n).permutation(n) + 1.0
    found = median_interval(values)
    k = int(found.low)
    assert found.high == n + 1 - k
    assert 1 - 2 * stats.binom.cdf(k - 1, n, 0.5) >= 0.95
    assert 1 - 2 * stats.binom.cdf(k, n, 0.5) < 0.95
    assert found.estimate == np.median(values)


def test_median_interval_error_tends_to_the_standard_error():
    values = stats.norm.ppf((np.arange(100000) + 0.5) / 100000)
    exact = np.sqrt(np.pi / 2 / 100000)  # asymptotic, Gaussian
    assert median_interval(values).error == pytest.approx(exact, rel=0.01)


def test_mean_interval_is_students():
    values = RNG.standard_normal(12)
    found = mean_interval(values, level=0.9)
    expected = stats.ttest_1samp(values, 0.0).confidence_interval(0.9)
    assert (found.low, found.high) == pytest.approx(tuple(expected), rel=1e-12)
    assert found.error == pytest.approx(stats.sem(values), rel=1e-12)
    for end in (found.low, found.high):
        assert stats.ttest_1samp(values, end).pvalue == pytest.approx(0.1, rel=1e-9)


def test_mean_interval_covers():
    trials = 4000
    samples = np.random.default_rng(7).standard_normal((trials, 5))
    inside = sum(0.0 in mean_interval(v) for v in samples)
    assert 0.95 in proportion_interval(inside, trials, level=0.999)


def test_interval_is_frozen_and_compact():
    interval = Interval(1.23456, 1.1, 1.4, 0.05)
    assert str(interval) == "1.23 [1.1, 1.4]"
    assert 1.1 in interval and 1.4 in interval and 1.41 not in interval
    with pytest.raises(AttributeError):
        interval.low = 0.0
