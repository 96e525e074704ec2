"""The linear Kalman filter: exact identities, gaps, shapes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
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
    run = kalman_filter(mean, cov, y, **p)
    means, covs, my, yy, values = posterior(mean, cov, y, p)
    np.testing.assert_allclose(run.means[-1], means[-1], rtol=0, atol=1e-11)
    np.testing.assert_allclose(run.covariances[-1], covs[-D:, -D:], rtol=0, atol=1e-11)
    expected = multivariate_normal(my, yy).logpdf(values)
    np.testing.assert_allclose(run.log_likelihood.sum(), expected, rtol=1e-11)


@given(seed=st.integers(0, 10**6), share=st.floats(0, 0.9))
def test_covariances_stay_symmetric_and_positive(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    p = problem(rng)
    y = rng.standard_normal((STEPS, RUNS, M))
    y[rng.random(y.shape) < share] = np.nan
    run = kalman_filter(np.zeros(D), spd(rng, D), y, **p)
    assert (run.covariances == np.swapaxes(run.covariances, -1, -2)).all()
    assert np.linalg.eigvalsh(run.covariances).min() > 0


def test_stationary_variance_of_a_random_walk() -> None:
    # The stationary analysis variance of a random walk solves p^2 + q p = q r.
    q, r = 0.5, 2.0
    run = kalman_filter([0.0], [[5.0]], np.zeros((200, 1)), F=[[1.0]], H=[[1.0]], Q=[[q]], R=[[r]])
    expected = (-q + np.sqrt(q * q + 4 * q * r)) / 2
    np.testing.assert_allclose(run.covariances[-1, 0, 0], expected, rtol=1e-12)


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


def test_nothing_is_mutated() -> None:
    rng = np.random.default_rng(6)
    p, mean, cov = problem(rng), rng.standard_normal(D), spd(rng, D)
    y = rng.standard_normal((STEPS, RUNS, M))
    y[2, 1, 0] = np.nan
    before = [a.copy() for a in (mean, cov, y, *p.values())]
    kalman_filter(mean, cov, y, **p)
    for a, b in zip((mean, cov, y, *p.values()), before, strict=True):
        np.testing.assert_array_equal(a, b)



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


def test_nothing_observed_is_a_forecast() -> None:
    rng = np.random.default_rng(3)
    p, mean, cov = problem(rng, varying=False), rng.standard_normal(D), spd(rng, D)
    run = kalman_filter(mean, cov, np.full((1, M), np.nan), **p)
    np.testing.assert_allclose(run.means[0], p["F"] @ mean, atol=1e-14)
    np.testing.assert_allclose(run.covariances[0], p["F"] @ cov @ p["F"].T + p["Q"], atol=1e-14)
    assert run.log_likelihood[0] == 0.0


@given(seed=st.integers(0, 10**6), runs=st.integers(1, 5), d=st.integers(1, 3), own=st.booleans())
def test_runs_with_gaps_of_their_own_are_filtered_as_if_alone(
    seed: int, runs: int, d: int, own: bool
) -> None:
    """Shared and own covariances; a missing component is its row deleted from H and R."""
    rng = np.random.default_rng(seed)
    p = problem(rng, d=d, varying=False)
    mean, cov = rng.standard_normal((runs, d)), spd(rng, d, (runs,) if own else ())
    y = rng.standard_normal((3, runs, M))
    y[1, rng.random(runs) < 0.5, 0] = np.nan
    run = kalman_filter(mean, cov, y, **p)
    covs = np.broadcast_to(run.covariances, (3, runs, d, d))
    for k in range(runs):
        x, c = mean[k], cov[k] if own else cov
        for t, seen in enumerate(y[:, k]):
            here = ~np.isnan(seen)
            rows = {"H": p["H"][here], "R": p["R"][np.ix_(here, here)]}
            one = kalman_filter(x, c, seen[None, here], F=p["F"], Q=p["Q"], **rows)
            x, c = one.means[0], one.covariances[0]
            np.testing.assert_allclose(run.means[t, k], x, rtol=0, atol=1e-12)
            np.testing.assert_allclose(covs[t, k], c, rtol=0, atol=1e-12)
            assert abs(run.log_likelihood[t, k] - one.log_likelihood[0]) < 1e-11
