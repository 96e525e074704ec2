"""The linear Kalman filter: exact identities, shapes, bad input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from distfilt.kalman import kalman_filter, predict, update
from tests.kalman.bad_input import INDEFINITE, LOPSIDED, linear_cases
from tests.kalman.problems import RUNS, STEPS, D, M, posterior, problem, spd

BAD_INPUT: dict[str, Any] = {
    "distfilt.kalman.kalman_filter": linear_cases(kalman_filter),
    "distfilt.kalman.predict": [
        ("mean", lambda: predict([np.nan], [[1.0]], F=[[1.0]], Q=[[1.0]])),
        ("cov", lambda: predict([0.0, 0.0], INDEFINITE, F=np.eye(2), Q=np.eye(2))),
        ("F", lambda: predict([0.0], [[1.0]], F=np.eye(2), Q=[[1.0]])),
        ("Q", lambda: predict([0.0], [[1.0]], F=[[1.0]], Q=[[-1.0]])),
    ],
    "distfilt.kalman.update": [
        ("mean", lambda: update([np.inf], [[1.0]], [0.0], H=[[1.0]], R=[[1.0]])),
        ("cov", lambda: update([0.0, 0.0], LOPSIDED, [0.0], H=[[1.0, 0.0]], R=[[1.0]])),
        ("observed", lambda: update([0.0], [[1.0]], [0.0, 1.0], H=[[1.0]], R=[[1.0]])),
        ("observed", lambda: update([0.0], [[1.0]], [np.inf], H=[[1.0]], R=[[1.0]])),
        ("H", lambda: update([0.0], [[1.0]], [0.0], H=[[1.0, 0.0]], R=[[1.0]])),
        ("R", lambda: update([0.0], [[1.0]], [0.0], H=[[1.0]], R=[[-1.0]])),
    ],
}
EXEMPT = {"distfilt.kalman.GaussianRun": "a result; rts_smoother, which takes it, looks at it"}


# --- the linear filter: identities ------------------------------------------------------------


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


def test_static_state_is_least_squares() -> None:
    rng = np.random.default_rng(2)
    h, r = rng.standard_normal((STEPS, M, D)), spd(rng, M, (STEPS,))
    y, mean, cov = rng.standard_normal((STEPS, M)), rng.standard_normal(D), spd(rng, D)
    run = kalman_filter(mean, cov, y, F=np.eye(D), H=h, Q=np.zeros((D, D)), R=r)
    # Stack the prior as D more rows and solve one whitened least-squares problem.
    roots = [np.linalg.cholesky(cov), *np.linalg.cholesky(r)]
    systems, values = (np.eye(D), *h), (mean, *y)
    rows = np.concatenate([np.linalg.solve(c, a) for c, a in zip(roots, systems, strict=True)])
    right = np.concatenate([np.linalg.solve(c, b) for c, b in zip(roots, values, strict=True)])
    np.testing.assert_allclose(run.means[-1], np.linalg.lstsq(rows, right)[0], atol=1e-11)


@given(seed=st.integers(0, 10**6), d=st.integers(1, 5), m=st.integers(1, 5))
def test_update_in_information_form(seed: int, d: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    mean, cov, h, r = rng.standard_normal(d), spd(rng, d), rng.standard_normal((m, d)), spd(rng, m)
    y = rng.standard_normal(m)
    x, p, density = update(mean, cov, y, H=h, R=r)
    information = np.linalg.solve(cov, np.eye(d)) + h.T @ np.linalg.solve(r, h)
    vector = np.linalg.solve(cov, mean) + h.T @ np.linalg.solve(r, y)
    np.testing.assert_allclose(information @ p, np.eye(d), atol=1e-9)
    np.testing.assert_allclose(information @ x, vector, atol=1e-9)
    assert np.isclose(density, multivariate_normal(h @ mean, h @ cov @ h.T + r).logpdf(y))


@given(seed=st.integers(0, 10**6), hidden=st.integers(0, 6))
def test_missing_component_is_a_deleted_row(seed: int, hidden: int) -> None:
    rng = np.random.default_rng(seed)
    mean, cov, h, r = rng.standard_normal(D), spd(rng, D), rng.standard_normal((3, D)), spd(rng, 3)
    y = rng.standard_normal(3)
    keep = np.array([not hidden >> k & 1 for k in range(3)])
    x, p, density = update(mean, cov, np.where(keep, y, np.nan), H=h, R=r)
    other = update(mean, cov, y[keep], H=h[keep], R=r[np.ix_(keep, keep)])
    for ours, theirs in zip((x, p, density), other, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12)


def test_nothing_observed_is_a_forecast() -> None:
    rng = np.random.default_rng(3)
    p, mean, cov = problem(rng, varying=False), rng.standard_normal(D), spd(rng, D)
    run = kalman_filter(mean, cov, np.full((1, M), np.nan), **p)
    x, c = predict(mean, cov, F=p["F"], Q=p["Q"])
    np.testing.assert_allclose(run.means[0], x, atol=1e-14)
    np.testing.assert_allclose(run.covariances[0], c, atol=1e-14)
    assert run.log_likelihood[0] == 0.0


@given(seed=st.integers(0, 10**6), share=st.floats(0, 0.9))
def test_covariances_stay_symmetric_and_positive(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    p = problem(rng)
    y = rng.standard_normal((STEPS, RUNS, M))
    y[rng.random(y.shape) < share] = np.nan
    run = kalman_filter(np.zeros(D), spd(rng, D), y, **p)
    assert (run.covariances == np.swapaxes(run.covariances, -1, -2)).all()
    assert np.linalg.eigvalsh(run.covariances).min() > 0


def test_a_diffuse_prior_does_not_break_the_update() -> None:
    cov = update(np.zeros(2), 1e10 * np.eye(2), [1.0], H=[[1.0, 1.0]], R=[[1e-4]])[1]
    assert (np.linalg.eigvalsh(cov) > 0).all()
    np.testing.assert_allclose(np.ones(2) @ cov @ np.ones(2), 1e-4, rtol=1e-2)


def test_stationary_variance_of_a_random_walk() -> None:
    # The stationary analysis variance of a random walk solves p^2 + q p = q r.
    q, r = 0.5, 2.0
    run = kalman_filter([0.0], [[5.0]], np.zeros((200, 1)), F=[[1.0]], H=[[1.0]], Q=[[q]], R=[[r]])
    expected = (-q + np.sqrt(q * q + 4 * q * r)) / 2
    np.testing.assert_allclose(run.covariances[-1, 0, 0], expected, rtol=1e-12)


# --- the linear filter: shapes ---------------------------------------------------


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



@pytest.mark.parametrize("runs", [1, 2, 5])
def test_one_step_of_many_runs_is_each_run_s(runs: int) -> None:
    """Shared, grouped and own covariances; the covariance of a gap is its own."""
    rng = np.random.default_rng(17)
    h, r, y = rng.standard_normal((M, D)), spd(rng, M), rng.standard_normal((runs, M))
    mean, cov, f, q = rng.standard_normal((runs, D)), spd(rng, D), rng.standard_normal((D, D)), 0.2
    for pattern in (np.zeros_like(y, dtype=bool), np.arange(2) == np.arange(runs)[:, None] % 3):
        seen = np.where(pattern, np.nan, y)
        for prior in (cov, spd(rng, D, (runs,))):
            x, p = predict(mean, prior, F=f, Q=q * np.eye(D))
            x, p, density = update(x, p, seen, H=h, R=r)
            p = np.broadcast_to(p, (runs, D, D))
            for k in range(runs):
                own = prior if prior.ndim == 2 else prior[k]
                one = predict(mean[k], own, F=f, Q=q * np.eye(D))
                one = update(*one, seen[k], H=h, R=r)
                for ours, theirs in zip((x[k], p[k], density[k]), one, strict=True):
                    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-13)


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


def test_scalar_states_with_gaps_of_their_own_are_each_run_s() -> None:
    y = np.random.default_rng(5).standard_normal((6, 4, 1))
    y[1, 0], y[2, 1], y[4, 1:3] = np.nan, np.nan, np.nan
    matrices = {"F": [[0.9]], "H": [[1.0]], "Q": [[0.3]], "R": [[0.5]]}
    together = kalman_filter([0.0], [[2.0]], y, **matrices)
    for r in range(4):
        alone = kalman_filter([0.0], [[2.0]], y[:, r], **matrices)
        assert np.allclose(together.means[:, r], alone.means, atol=1e-13)
        assert np.allclose(together.covariances[:, r], alone.covariances, atol=1e-13)


def test_many_readings_update_one_belief_each_for_itself() -> None:
    y = np.random.default_rng(6).standard_normal((5, 3, 2))
    h, r = np.array([[1.0, 0.5], [0.0, 1.0]]), np.diag([0.5, 0.2])
    mean, cov, density = update([0.0, 1.0], np.diag([2.0, 1.0]), y, H=h, R=r)
    assert mean.shape == (5, 3, 2) and density.shape == (5, 3)
    alone = update([0.0, 1.0], np.diag([2.0, 1.0]), y[4, 2], H=h, R=r)
    for found, one in zip((mean[4, 2], cov[0, 0], density[4, 2]), alone, strict=True):
        assert np.allclose(found, one, atol=1e-13)
