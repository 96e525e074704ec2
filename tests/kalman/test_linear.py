"""The linear Kalman filter and its smoother: the joint Gaussian, runs, gaps, shapes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import block_diag
from scipy.stats import multivariate_normal

from distfilt.kalman import kalman_filter, rts_smoother
from tests.kalman.problems import RUNS, STEPS, D, M, problem
from tests.support import spd


@given(seed=st.integers(0, 10**6), share=st.sampled_from([0.0, 0.3, 1.0]))
def test_filter_and_smoother_are_conditioning_of_the_joint_gaussian(
    seed: int, share: float
) -> None:
    """All states (the filter's last is the smoother's) and the readings' likelihood."""
    rng = np.random.default_rng(seed)
    p = problem(rng)
    mean = rng.standard_normal(D)
    cov = spd(rng, D)
    y = rng.standard_normal((STEPS, M))
    y[rng.random(y.shape) < share] = np.nan
    run = kalman_filter(mean, cov, y, **p)
    smooth = rts_smoother(run, F=p["F"], Q=p["Q"])
    # States are rows times the first state and all noises, which are independent.
    now = np.eye(D, D * (STEPS + 1))
    rows = []
    for k, f in enumerate(p["F"], 1):
        now = f @ now + np.eye(D, D * (STEPS + 1), D * k)
        rows.append(now)
    here = ~np.isnan(y).ravel()
    states = np.concatenate(rows)
    seen = (p["H"] @ rows).reshape(STEPS * M, -1)[here]
    root = block_diag(cov, *p["Q"])
    start = np.concatenate([mean, np.zeros(D * STEPS)])
    inner = seen @ root @ seen.T + block_diag(*p["R"])[np.ix_(here, here)]
    gain = np.linalg.solve(inner, seen @ root @ states.T).T
    means = states @ start + gain @ (y.ravel()[here] - seen @ start)
    covs = (states - gain @ seen) @ root @ states.T
    np.testing.assert_allclose(smooth.means.ravel(), means, rtol=0, atol=1e-9)
    for k in range(STEPS):
        block = covs[k * D : (k + 1) * D, k * D : (k + 1) * D]
        np.testing.assert_allclose(smooth.covariances[k], block, rtol=0, atol=1e-9)
    if here.any():
        expected = multivariate_normal(seen @ start, inner).logpdf(y.ravel()[here])
        np.testing.assert_allclose(
            run.log_likelihood.sum(), expected, rtol=1e-11, atol=1e-10
        )


@pytest.mark.parametrize("gaps", [False, True])
def test_runs_are_smoothed_as_if_alone(gaps: bool) -> None:
    rng = np.random.default_rng(3)
    p = problem(rng, varying=False)
    y = rng.standard_normal((STEPS, RUNS, M))
    if gaps:
        y[rng.random(y.shape) < 0.3] = np.nan
    run = kalman_filter(np.zeros(D), np.eye(D), y, **p)
    smooth = rts_smoother(run, F=p["F"], Q=p["Q"])
    assert smooth.covariances.shape == run.covariances.shape
    for k in range(RUNS):
        alone = kalman_filter(np.zeros(D), np.eye(D), y[:, k], **p)
        alone = rts_smoother(alone, F=p["F"], Q=p["Q"])
        np.testing.assert_allclose(smooth.means[:, k], alone.means, rtol=0, atol=1e-12)
    assert (smooth.covariances == np.swapaxes(smooth.covariances, -1, -2)).all()


def test_run_axes_broadcast() -> None:
    rng = np.random.default_rng(5)
    p = problem(rng)
    y = rng.standard_normal((STEPS, 2, 3, M))
    means = rng.standard_normal((3, D))
    covs = spd(rng, D, (2, 1))
    run = kalman_filter(means, covs, y, **p)
    assert run.means.shape == (STEPS, 2, 3, D) and run.log_likelihood.shape == (
        STEPS,
        2,
        3,
    )
    one = kalman_filter(means[2], covs[1, 0], y[:, 1, 2], **p)
    np.testing.assert_allclose(run.means[:, 1, 2], one.means, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        run.covariances[:, 1, 2], one.covariances, rtol=0, atol=1e-12
    )
    many = np.stack([means, -means, 2 * means])  # nine priors, three series
    series = kalman_filter(many, covs[1, 0], y[:, 1], **p).means
    np.testing.assert_allclose(series[:, 0, 2], one.means, rtol=0, atol=1e-12)


def test_no_steps_and_no_runs() -> None:
    p = problem(np.random.default_rng(18), varying=False)
    for steps, runs in ((0, RUNS), (STEPS, 0)):
        run = kalman_filter(np.zeros(D), np.eye(D), np.zeros((steps, runs, M)), **p)
        assert run.means.shape == (steps, runs, D) and run.log_likelihood.shape == (
            steps,
            runs,
        )
        assert run.covariances.shape == (steps, 1, D, D)


@pytest.mark.parametrize("shared", [True, False])
def test_a_lost_covariance_raises(shared: bool) -> None:
    """A noise so small that H P H' + R is singular in floating point."""
    y = (
        np.zeros((1, 2, 2))
        if shared
        else np.array([[[0.0, 0.0], [0.0, 0.0], [np.nan, 0.0]]])
    )
    with pytest.raises(np.linalg.LinAlgError, match="innovation"):
        kalman_filter(
            [0.0],
            [[1e30]],
            y,
            F=[[1.0]],
            Q=[[0.0]],
            H=[[1.0], [1.0]],
            R=1e-10 * np.eye(2),
        )
