"""Affine triangular maps: the exact minimiser, the program as printed, the Kalman filter."""

from __future__ import annotations

from functools import partial
from typing import Any

import cvxpy
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from distfilt.linalg import SolverError
from distfilt.triangular import affine, compose, separable
from distfilt.triangular.affine import _compile_program, fit, fit_convex, objective
from tests.triangular.samples import rng_of, samples

_X = np.random.default_rng(9).standard_normal((20, 2))
_Y = np.random.default_rng(8).standard_normal((20, 1))


@given(st.integers(0, 10_000), st.integers(0, 4), st.integers(1, 5))
def test_a_map_whitens_and_inverts(seed: int, m: int, d: int) -> None:
    """The reference samples have mean zero and covariance I, and the inverse gives x back."""
    y, x = samples(seed, 60, m, d)
    s = fit(y, x)
    z = s(y, x)
    # The minimiser's moments are exactly those of N(0, I), with N in the denominator.
    assert np.allclose(z.mean(axis=0), 0, atol=1e-7)
    second_moment = z.T @ z / len(z)
    assert np.allclose(second_moment, np.eye(d), atol=1e-6)
    assert np.allclose(s.inverse(y, z), x, rtol=1e-9, atol=1e-9)


def test_maps_are_batched() -> None:
    """A map of a batch is, ensemble by ensemble, the map of that ensemble."""
    y, x = samples(3, leading=(2, 4))
    batch = fit(y, x)
    ensemble = (y[1, 2], x[1, 2])
    single = fit(*ensemble)
    z = batch(y, x)
    assert np.allclose(z[1, 2], single(*ensemble), atol=1e-12)
    log_det = batch.log_det(y, x)
    assert np.allclose(log_det[1, 2], single.log_det(*ensemble))
    values = objective(batch, y, x)
    expected = objective(single, *ensemble)
    assert np.allclose(values[1, 2], expected, atol=1e-12)


@given(st.integers(0, 10_000))
def test_log_det_is_that_of_the_derivative(seed: int) -> None:
    """Differences of the map are exact up to rounding, since it is affine; and triangular."""
    y, x = samples(seed)
    s = fit(y, x)
    shifted = x[0] + np.eye(3)
    same_y = np.repeat(y[:1], 3, axis=0)
    # S(x + e_j) - S(x) is column j of the derivative.
    rows = s(same_y, shifted) - s(y[:1], x[:1])
    derivative = rows.T
    log_det = np.linalg.slogdet(derivative)[1]
    assert np.isclose(log_det, s.log_det(y, x)[0], rtol=1e-9, atol=1e-9)
    assert np.allclose(np.tril(derivative), derivative, atol=1e-9)


def test_the_objective_is_the_mean_of_minus_the_log_density() -> None:
    """Of x given y, N(x̄ + K (y - ȳ), L Lᵀ), but for ½ d log 2π; of both kinds of maps."""
    y, x = samples(22, m=2, d=3)
    s = fit(y, x)
    covariance = s.scale @ s.scale.T
    total = 0.0
    for observed, member in zip(y, x, strict=True):
        mean = s.mean + s.gain @ (observed - s.observed_mean)
        total -= multivariate_normal(mean, covariance).logpdf(member)
    expected = total / len(x) - 1.5 * np.log(2 * np.pi)
    assert np.isclose(objective(s, y, x), expected, rtol=1e-9)
    # Without bumps the separable map is the same function.
    separate = separable.fit(y, x, order=0)
    assert np.isclose(objective(separate, y, x), expected, rtol=1e-7)


def test_coefficients_and_moments_give_the_same_map() -> None:
    """S = c + B y + A x with A = L^-1, B = -L^-1 K and c = L^-1 (K mean(y) - mean(x))."""
    y, x = samples(21, m=2, d=3)
    s = fit(y, x)
    right = np.hstack([-s.gain, np.eye(3)])
    coefficients = np.linalg.solve(s.scale, right)
    # The solve leaves rounding above the diagonal of A.
    coefficients[:, 2:] = np.tril(coefficients[:, 2:])
    shift = s.gain @ s.observed_mean - s.mean
    offset = np.linalg.solve(s.scale, shift)
    rows = np.hstack([offset[:, None], coefficients])
    # About any y, here another than the mean.
    by_rows = affine.from_rows(rows, np.array([5.0, -3.0]))
    assert np.allclose(by_rows(y, x), s(y, x), atol=1e-7)


# ------------------------------------------------------------------------ the convex program


def test_the_program_is_compiled_once_for_each_size() -> None:
    """Two fits of two components compile two programs; the composed map is the exact one's."""
    _compile_program.cache_clear()
    for seed in (1, 2):
        y, x = samples(seed, m=1, d=2)
        y = (y - y.mean(axis=0)) / y.std(axis=0)
        x = (x - x.mean(axis=0)) / x.std(axis=0)
        exact = compose(fit(y, x), y, x, y[0])
        solved = compose(fit_convex(y, x), y, x, y[0])
        assert np.abs(exact - solved).max() < 1e-6
    # Component k has k + 1 variables: two sizes, each met twice.
    info = _compile_program.cache_info()
    assert (info.misses, info.hits) == (2, 2)
    assert info.maxsize is not None


def test_the_program_does_not_depend_on_earlier_samples() -> None:
    """After other samples, and after another solver, the same samples give the same bits."""
    y, x = samples(3, m=1, d=2)
    first = fit_convex(y, x)
    # Neither a warm start nor a solver's setting may remain in the compiled program.
    fit_convex(*samples(4, m=1, d=2))
    fit_convex(y, x, solver="CLARABEL")
    assert np.array_equal(fit_convex(y, x).scale, first.scale)


@pytest.mark.parametrize(
    ("solver", "limit"), [("ECOS", "max_iters"), ("CLARABEL", "max_iter")]
)
def test_a_solver_that_stops_early_raises_its_status(
    monkeypatch: pytest.MonkeyPatch, solver: str, limit: str
) -> None:
    """After one iteration, with the component's number."""
    solve = cvxpy.Problem.solve

    def solve_once(problem: cvxpy.Problem, **options: Any) -> Any:
        return solve(problem, **options, **{limit: 1})

    monkeypatch.setattr(cvxpy.Problem, "solve", solve_once)
    with pytest.raises(SolverError, match=f"{solver}: component 2"):
        fit_convex(_Y, _X, solver=solver)


# ----------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("name", "y", "x"),
    [
        # Too few members.
        ("x", _Y[:3], _X[:3]),
        # A repeated variable, of x and of y.
        ("x", _Y, _X[:, [0, 0]]),
        ("x", _X[:, :1], _X),
        ("y", _Y @ [[1.0, 0.3]], _X),
        # A constant variable.
        ("x", _Y, np.column_stack([_X, np.full(20, 0.1)])),
        ("y", np.zeros((20, 1)), _X),
        # Other leading axes.
        ("y", _Y[None], _X),
    ],
)
def test_samples_without_a_map_are_refused_by_name(
    name: str, y: np.ndarray, x: np.ndarray
) -> None:
    """By both estimators."""
    for estimator in (fit, partial(separable.fit, order=0)):
        with pytest.raises(ValueError, match=f"^{name} must"):
            estimator(y, x)


def test_the_rounding_of_a_repeated_variable_is_no_variance() -> None:
    """Such a covariance may have a Cholesky factor."""
    covariance = np.array([[4.0, 4.0], [4.0, 4.0 + 4e-15]])
    # 4 + 4e-15 - 4² / 4 is rounding, but positive.
    assert np.linalg.cholesky(covariance)[1, 1] > 0
    with pytest.raises(ValueError, match=r"x must .* not combinations of others"):
        affine.from_moments(np.ones(2), covariance, 1)


def test_samples_of_another_size_than_the_map_are_refused() -> None:
    """By `objective` itself, before the map is evaluated."""
    s = fit(_Y, _X)
    with pytest.raises(ValueError, match="^x must"):
        objective(s, _Y, _X[:, :1])
    with pytest.raises(ValueError, match="^y must"):
        objective(s, _X, _X)


# ---------------------------------------------------------------------------- Kalman filter


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(1, 5))
def test_the_composed_affine_map_is_the_enkf(seed: int, m: int, d: int) -> None:
    """x + C_xy C_yy^-1 (y* - y), up to the condition of C_yy."""
    y, x = samples(seed, 60, m, d)
    observed = rng_of(seed + 1).standard_normal(m)
    joint = np.cov(np.hstack([x, y]), rowvar=False)
    # K = C_xy C_yy⁻¹; the noise is part of the predictions y.
    cross = joint[:d, d:]
    predicted_cov = joint[d:, d:]
    gain = cross @ np.linalg.inv(predicted_cov)
    expected = x + (observed - y) @ gain.T
    composed = compose(fit(y, x), y, x, observed)
    condition = np.linalg.cond(predicted_cov)
    unit = max(1, np.abs(expected).max(), condition)
    assert np.abs(composed - expected).max() < 1e-12 * unit
