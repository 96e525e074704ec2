"""The linear Kalman filter and its smoother: the joint Gaussian, runs, missing data, shapes."""

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


def _joint_states(
    mean: np.ndarray, cov: np.ndarray, model: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All states as a matrix (T D, (T+1) D) times the first state and the noises.

    Those are independent Gaussians, of which mean and covariance are returned too.
    """
    size = D * (STEPS + 1)
    state = np.eye(D, size)
    rows = []
    for k, f in enumerate(model["F"], 1):
        # x_k = F x_{k-1} + w_k
        state = f @ state + np.eye(D, size, D * k)
        rows.append(state)
    joint_mean = np.concatenate([mean, np.zeros(D * STEPS)])
    joint_cov = block_diag(cov, *model["Q"])
    return np.concatenate(rows), joint_mean, joint_cov


@given(seed=st.integers(0, 10**6), missing=st.sampled_from([0.0, 0.3, 1.0]))
def test_filter_and_smoother_are_conditioning_of_the_joint_gaussian(
    seed: int, missing: float
) -> None:
    """All states (the filter's last is the smoother's) and the likelihood."""
    rng = np.random.default_rng(seed)
    model = problem(rng)
    mean = rng.standard_normal(D)
    cov = spd(rng, D)
    y = rng.standard_normal((STEPS, M))
    y[rng.random(y.shape) < missing] = np.nan
    run = kalman_filter(mean, cov, y, **model)
    smooth = rts_smoother(run, F=model["F"], Q=model["Q"])
    states, joint_mean, joint_cov = _joint_states(mean, cov, model)
    # Present observations y = C z + noise(R) of the independent Gaussians z
    present = ~np.isnan(y).ravel()
    values = y.ravel()[present]
    h = block_diag(*model["H"])[present]
    c = h @ states
    r = block_diag(*model["R"])[np.ix_(present, present)]
    innovation_cov = c @ joint_cov @ c.T + r
    # K = Cov(x, y) S⁻¹, mean = E x + K (y - E y), Cov = (X - K C) P Xᵀ
    gain = np.linalg.solve(innovation_cov, c @ joint_cov @ states.T).T
    innovation = values - c @ joint_mean
    means = states @ joint_mean + gain @ innovation
    covs = (states - gain @ c) @ joint_cov @ states.T
    np.testing.assert_allclose(smooth.means.ravel(), means, rtol=0, atol=1e-9)
    for k in range(STEPS):
        rows = slice(k * D, (k + 1) * D)
        block = covs[rows, rows]
        np.testing.assert_allclose(smooth.covariances[k], block, rtol=0, atol=1e-9)
    if present.any():
        expected = multivariate_normal(c @ joint_mean, innovation_cov).logpdf(values)
        # p(y) = Π p(y_k | y_1 ... y_{k-1}): the increments of the filter add up.
        total = run.log_likelihood.sum()
        np.testing.assert_allclose(total, expected, rtol=1e-11, atol=1e-10)


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_runs_are_smoothed_independently(missing: float) -> None:
    """In a batch and one by one; covariances are shared if no component is missing."""
    rng = np.random.default_rng(3)
    model = problem(rng, varying=False)
    matrices = {"F": model["F"], "Q": model["Q"]}
    y = rng.standard_normal((STEPS, RUNS, M))
    y[rng.random(y.shape) < missing] = np.nan
    run = kalman_filter(np.zeros(D), np.eye(D), y, **model)
    smooth = rts_smoother(run, **matrices)
    # Without gaps one covariance serves all runs: it does not depend on the values.
    assert smooth.covariances.shape == run.covariances.shape
    assert (smooth.covariances == smooth.covariances.mT).all()
    for k in range(RUNS):
        single = kalman_filter(np.zeros(D), np.eye(D), y[:, k], **model)
        single = rts_smoother(single, **matrices)
        means = smooth.means[:, k]
        np.testing.assert_allclose(means, single.means, rtol=0, atol=1e-12)


def test_run_axes_broadcast() -> None:
    """Observations (2, 3), means (3,), covariances (2, 1): run (1, 2) by itself."""
    rng = np.random.default_rng(5)
    model = problem(rng)
    y = rng.standard_normal((STEPS, 2, 3, M))
    means = rng.standard_normal((3, D))
    covs = spd(rng, D, (2, 1))
    run = kalman_filter(means, covs, y, **model)
    # (2, 3) of the observations, (3,) of the means and (2, 1) of the covariances
    assert run.means.shape == (STEPS, 2, 3, D)
    assert run.log_likelihood.shape == (STEPS, 2, 3)
    single = kalman_filter(means[2], covs[1, 0], y[:, 1, 2], **model)
    np.testing.assert_allclose(run.means[:, 1, 2], single.means, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        run.covariances[:, 1, 2], single.covariances, rtol=0, atol=1e-12
    )
    # Nine priors and three series: the priors' first axis is new to the observations.
    priors = np.stack([means, -means, 2 * means])
    run = kalman_filter(priors, covs[1, 0], y[:, 1], **model)
    np.testing.assert_allclose(run.means[:, 0, 2], single.means, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("steps", "runs"), [(0, RUNS), (STEPS, 0)])
def test_no_steps_and_no_runs_give_empty_results(steps: int, runs: int) -> None:
    model = problem(np.random.default_rng(18), varying=False)
    y = np.zeros((steps, runs, M))
    run = kalman_filter(np.zeros(D), np.eye(D), y, **model)
    assert run.means.shape == (steps, runs, D)
    assert run.log_likelihood.shape == (steps, runs)
    # The shared covariance has one run.
    assert run.covariances.shape == (steps, 1, D, D)


@pytest.mark.parametrize("shared", [True, False])
def test_a_singular_innovation_covariance_raises(shared: bool) -> None:
    """R so small that H P Hᵀ + R is singular in floating point."""
    # Two observations of one state: 1e30 (1 1; 1 1) + 1e-10 I rounds to rank one.
    y = np.zeros((1, 3, 2))
    if not shared:
        # Another pattern of missing components gives each run its own covariance.
        y[0, 2, 0] = np.nan
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
