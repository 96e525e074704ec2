"""The linear Kalman filter: exact identities, gaps, shapes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from distfilt.kalman import kalman_filter
from tests.kalman.problems import RUNS, STEPS, D, M, posterior, problem, spd


@pytest.mark.parametrize("gaps", [False, True])
def test_filter_is_conditioning_of_the_joint_gaussian(gaps: bool) -> None:
    rng = np.random.default_rng(1)
    p, mean, cov = problem(rng), rng.standard_normal(D), spd(rng, D)
    y = rng.standard_normal((STEPS, M))
    if gaps:
        y[1, 0] = y[4] = y[6, 1] = np.nan
    before = [a.copy() for a in (mean, cov, y, *p.values())]
    run = kalman_filter(mean, cov, y, **p)
    for a, b in zip((mean, cov, y, *p.values()), before, strict=True):
        np.testing.assert_array_equal(a, b)
    means, covs, my, yy, values = posterior(mean, cov, y, p)
    np.testing.assert_allclose(run.means[-1], means[-1], rtol=0, atol=1e-11)
    np.testing.assert_allclose(run.covariances[-1], covs[-D:, -D:], rtol=0, atol=1e-11)
    expected = multivariate_normal(my, yy).logpdf(values)
    np.testing.assert_allclose(run.log_likelihood.sum(), expected, rtol=1e-11)


def test_run_axes_broadcast() -> None:
    rng = np.random.default_rng(5)
    p = problem(rng)
    y, means = rng.standard_normal((STEPS, 2, 3, M)), rng.standard_normal((3, D))
    covs = spd(rng, D, (2, 1))
    run = kalman_filter(means, covs, y, **p)
    assert run.means.shape == (STEPS, 2, 3, D) and run.log_likelihood.shape == (STEPS, 2, 3)
    one = kalman_filter(means[2], covs[1, 0], y[:, 1, 2], **p)
    np.testing.assert_allclose(run.means[:, 1, 2], one.means, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run.covariances[:, 1, 2], one.covariances, rtol=0, atol=1e-12)
    series = kalman_filter(means, spd(rng, D), y[:, 0, 0], **p)  # many priors, one series
    assert series.means.shape == (STEPS, 3, D)


def test_no_steps_and_no_runs() -> None:
    rng = np.random.default_rng(18)
    p = problem(rng, varying=False)
    run = kalman_filter(np.zeros(D), np.eye(D), np.zeros((0, RUNS, M)), **p)
    assert run.means.shape == (0, RUNS, D) and run.log_likelihood.shape == (0, RUNS)
    run = kalman_filter(np.zeros(D), np.eye(D), np.zeros((STEPS, 0, M)), **p)
    assert run.means.shape == (STEPS, 0, D) and run.covariances.shape == (STEPS, 1, D, D)


@pytest.mark.parametrize("shared", [True, False])
def test_a_lost_covariance_raises(shared: bool) -> None:
    """A noise so small that H P H' + R is singular in floating point."""
    y = np.zeros((1, 2, 2)) if shared else np.array([[[0.0, 0.0], [0.0, 0.0], [np.nan, 0.0]]])
    with pytest.raises(np.linalg.LinAlgError, match="innovation"):
        kalman_filter([0.0], [[1e30]], y, F=[[1.0]], Q=[[0.0]], H=[[1.0], [1.0]],
                      R=1e-10 * np.eye(2))
