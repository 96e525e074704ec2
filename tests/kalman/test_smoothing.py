"""The smoother against the joint Gaussian of all states and observations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.kalman import GaussianRun, kalman_filter, rts_smoother
from tests.kalman.problems import RUNS, STEPS, D, M, posterior, problem, spd


@given(seed=st.integers(0, 10**6), share=st.sampled_from([0.0, 0.3, 1.0]))
def test_smoothing_is_conditioning_of_the_joint_gaussian(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    p, mean, cov = problem(rng), rng.standard_normal(D), spd(rng, D)
    y = rng.standard_normal((STEPS, M))
    y[rng.random(y.shape) < share] = np.nan
    run = rts_smoother(kalman_filter(mean, cov, y, **p), F=p["F"], Q=p["Q"])
    means, covs, *_ = posterior(mean, cov, y, p)
    np.testing.assert_allclose(run.means, means, rtol=0, atol=1e-9)
    for k in range(STEPS):
        block = covs[k * D : (k + 1) * D, k * D : (k + 1) * D]
        np.testing.assert_allclose(run.covariances[k], block, rtol=0, atol=1e-9)


@pytest.mark.parametrize("gaps", [False, True])
def test_runs_are_smoothed_as_if_alone(gaps: bool) -> None:
    rng = np.random.default_rng(3)
    p, y = problem(rng, varying=False), rng.standard_normal((STEPS, RUNS, M))
    if gaps:
        y[rng.random(y.shape) < 0.3] = np.nan
    run = kalman_filter(np.zeros(D), np.eye(D), y, **p)
    kept = run.means.copy(), run.covariances.copy()
    smooth = rts_smoother(run, F=p["F"], Q=p["Q"])
    assert smooth.covariances.shape == run.covariances.shape
    assert (smooth.means[-1] == run.means[-1]).all()
    assert np.array_equal(smooth.log_likelihood, run.log_likelihood)
    for k in range(RUNS):
        alone = kalman_filter(np.zeros(D), np.eye(D), y[:, k], **p)
        alone = rts_smoother(alone, F=p["F"], Q=p["Q"])
        np.testing.assert_allclose(smooth.means[:, k], alone.means, rtol=0, atol=1e-12)
    assert (run.means == kept[0]).all() and (run.covariances == kept[1]).all()
    assert (smooth.covariances == np.swapaxes(smooth.covariances, -1, -2)).all()


def test_a_state_that_cannot_be_forecast_raises() -> None:
    lost = GaussianRun(np.zeros((2, 1)), np.zeros((2, 1, 1)), np.zeros(2))
    with pytest.raises(np.linalg.LinAlgError, match="forecast"):
        rts_smoother(lost, F=[[1.0]], Q=[[0.0]])


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 1), (2, 3, 1, 1)])
def test_a_run_s_covariances_have_its_means_axes(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="covariances: needs"):
        GaussianRun(np.zeros((2, 4, 1)), np.ones(shape), np.zeros((2, 4)))
