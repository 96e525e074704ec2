"""Weights, resampling, and jitter."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.updates import effective_size, jitter, resample
from distfilt.updates.particles import (
    add_jitter,
    distinct_fraction,
    repeat_by_count,
    reweight,
    silverman,
)

from .cases import rng


@given(st.integers(0, 10**6), st.integers(1, 60))
def test_systematic_resampling_inverts_the_distribution_function(
    seed: int, n: int
) -> None:
    """The index of each level (k + u) / N is found in the cumulative weights, by numpy's search."""
    weights = rng(seed).dirichlet(np.full(n, 0.2), size=4)
    # One uniform number u for each row, drawn as `resample` draws it.
    uniform = rng(6).random((4, 1))
    levels = (np.arange(n) + uniform) / n
    indices = resample(weights, rng=rng(6))
    for row in range(4):
        edges = np.cumsum(weights[row]) / weights[row].sum()
        expected = np.searchsorted(edges, levels[row], side="right")
        assert np.array_equal(indices[row], expected)


def test_effective_size_is_between_one_and_n() -> None:
    """One weight counts one, n equal weights count n, in any normalisation."""
    # (Σ w)² / Σ w²
    assert effective_size([0.0, -np.inf, -np.inf]) == pytest.approx(1.0)
    assert effective_size(np.full(8, -1e6)) == pytest.approx(8.0)
    assert effective_size(np.log([0.5, 0.5])) == pytest.approx(2.0)
    with pytest.warns(RuntimeWarning, match="log_weights must be logarithms"):
        effective_size([0.5, 0.3, 0.2])


def _normalise(log_weights: np.ndarray) -> np.ndarray:
    weights = np.exp(log_weights)
    return weights / weights.sum()


def test_weights_by_bayes_rule_with_a_missing_component() -> None:
    """Log-weights plus a Gaussian's exponent; for a missing component, that of its marginal."""
    h = rng(1).standard_normal((6, 2))
    prior = np.log(rng(2).dirichlet(np.ones(6)))
    noise = np.array([[0.5, 0.3], [0.3, 0.9]])
    y = np.array([0.4, -0.2])
    innovation = y - h
    precision = np.linalg.inv(noise)
    squares = np.einsum("ni,ij,nj->n", innovation, precision, innovation)
    full = _normalise(prior - 0.5 * squares)
    assert np.allclose(np.exp(reweight(prior, h, y, noise)), full)
    for k in range(2):
        partial_y = np.full(2, np.nan)
        partial_y[k] = y[k]
        # y_k alone is N(h_k, R_kk).
        squares = innovation[:, k] ** 2 / noise[k, k]
        marginal = _normalise(prior - 0.5 * squares)
        log_weights = reweight(prior, h, partial_y, noise)
        assert np.allclose(np.exp(log_weights), marginal)
    # A particle that cannot predict what was seen contradicts it.
    h[3, 1] = np.nan
    sees = np.arange(6) != 3
    weights = np.exp(reweight(prior, h, y, noise))
    assert weights[3] == 0
    assert np.allclose(weights[sees], full[sees] / full[sees].sum())
    # A component that no particle can predict is missing.
    h[:, 1] = np.nan
    squares = innovation[:, 0] ** 2 / noise[0, 0]
    marginal = _normalise(prior - 0.5 * squares)
    assert np.allclose(np.exp(reweight(prior, h, y, noise)), marginal)


def _mean_covariance(ensembles: np.ndarray) -> np.ndarray:
    """Return the covariance (with N) of ensembles (R, N, d), averaged over R."""
    anomalies = ensembles - ensembles.mean(axis=1, keepdims=True)
    products = np.swapaxes(anomalies, -1, -2) @ anomalies
    return (products / ensembles.shape[1]).mean(axis=0)


def test_jitter_keeps_mean_and_covariance_on_average() -> None:
    """(1 - h²) C from the shrinkage and h² C from the noise make C."""
    factor = np.array([[1.0, 0.6], [0.0, 0.4]])
    x = rng(0).standard_normal((2000, 50, 2)) @ factor
    jittered = jitter(x, rng=rng(1), bandwidth=0.5)
    shift = jittered.mean(axis=1) - x.mean(axis=1)
    assert np.abs(shift.mean(axis=0)).max() < 0.01
    # The noise's own mean takes the fraction h²/N of its variance.
    expected = (1 - 0.25 / 50) * _mean_covariance(x)
    assert np.allclose(_mean_covariance(jittered), expected, atol=0.01)
    # By default the covariance is that of each ensemble.
    covariances = [np.cov(ensemble.T, ddof=0) for ensemble in x]
    explicit = jitter(x, rng=rng(1), bandwidth=0.5, cov=covariances)
    assert np.allclose(jittered, explicit)


def test_silverman_s_bandwidth() -> None:
    """(4 / (n (d + 2)))^(1 / (d + 4)), at most one."""
    expected = (4 / (40 * 5)) ** (1 / 7)
    assert silverman(40, 3) == pytest.approx(expected)
    # (4 / 3)^(1/5) > 1
    assert silverman(1, 1) == 1


def test_jitter_of_copies_changes_only_them() -> None:
    """Of 2, 1, 3 and 1 copies the single ones stay; the others have the given covariance."""
    counts = np.tile([2, 1, 3, 1, 0, 0, 0], (4000, 1))
    values = np.tile(np.arange(7.0), (4000, 1))
    members = values[..., None] * [1.0, -2.0]
    x = repeat_by_count(members, counts)
    has_copies = counts[..., None] > 1
    is_copy = repeat_by_count(has_copies, counts)[..., 0]
    assert np.array_equal(x[5, :, 0], [0, 0, 1, 2, 2, 2, 3])
    covariance = np.array([[2.0, 0.6], [0.6, 0.5]])
    normal = rng().standard_normal(x.shape)
    jittered = add_jitter(x, covariance, 0.5, normal, is_copy)
    # Members 2 and 6 have no copy.
    single = [2, 6]
    copies = [0, 1, 3, 4, 5]
    assert (jittered[:, single] == x[:, single]).all()
    # No two members coincide any more.
    assert (distinct_fraction(jittered) == 1).all()
    noise = (jittered - x)[:, copies].reshape(-1, 2)
    # Four standard errors of a mean, and of a covariance.
    error = 4 * np.sqrt(2 / len(noise))
    assert np.abs(noise.mean(axis=0)).max() < 0.5 * error
    expected = 0.25 * covariance
    assert np.allclose(np.cov(noise.T), expected, atol=0.25 * 2 * error)
