"""Affine triangular maps: the exact minimiser, the program as printed, the Kalman filter."""

from __future__ import annotations

from functools import partial

import cvxpy
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.linalg import SolverError
from distfilt.triangular import affine, compose, separable
from distfilt.triangular.affine import _compile_program, fit, fit_convex, objective
from tests.triangular.samples import rng_of, samples

_X = np.random.default_rng(9).standard_normal((20, 2))
_Y = np.random.default_rng(8).standard_normal((20, 1))


@given(st.integers(0, 10_000), st.integers(0, 4), st.integers(1, 5))
def test_map_whitens_and_inverts(seed: int, m: int, d: int) -> None:
    y, x = samples(seed, 60, m, d)
    s = fit(y, x)
    z = s(y, x)
    assert np.allclose(z.mean(axis=0), 0, atol=1e-7)
    assert np.allclose(z.T @ z / len(z), np.eye(d), atol=1e-6)
    assert np.allclose(s.inverse(y, z), x, rtol=1e-9, atol=1e-9)


def test_map_log_det_and_objective_are_batched() -> None:
    y, x = samples(3, leading=(2, 4))
    whole = fit(y, x)
    one = fit(y[1, 2], x[1, 2])
    part = (y[1, 2], x[1, 2])
    assert np.allclose(whole(y, x)[1, 2], one(*part), atol=1e-12)
    assert np.allclose(whole.log_det(y, x)[1, 2], one.log_det(*part))
    assert np.allclose(objective(whole, y, x)[1, 2], objective(one, *part), atol=1e-12)


@given(st.integers(0, 10_000))
def test_log_det_is_the_derivative_s(seed: int) -> None:
    """Finite differences of the map: it is affine, so they are exact up to rounding."""
    y, x = samples(seed)
    s = fit(y, x)
    moved = x[0] + np.eye(3)
    base = s(y[:1], x[:1])
    columns = s(np.repeat(y[:1], 3, axis=0), moved) - base
    assert np.isclose(
        np.linalg.slogdet(columns)[1], s.log_det(y, x)[0], rtol=1e-9, atol=1e-9
    )
    assert np.allclose(np.tril(columns.T), columns.T, atol=1e-9)


def test_rows_and_moments_are_one_map() -> None:
    y, x = samples(21, m=2, d=3)
    s = fit(y, x)
    rows = np.linalg.solve(s.scale, np.hstack([-s.gain, np.eye(3)]))
    rows[:, 2:] = np.tril(rows[:, 2:])
    offset = np.linalg.solve(s.scale, s.gain @ s.observed_mean - s.mean)
    again = affine.from_rows(np.hstack([offset[:, None], rows]), np.array([5.0, -3.0]))
    assert np.allclose(again(y, x), s(y, x), atol=1e-7)


def test_the_program_is_compiled_once_for_each_size() -> None:
    _compile_program.cache_clear()
    for seed in (1, 2):
        y, x = samples(seed, m=1, d=2)
        y = (y - y.mean(0)) / y.std(0)
        x = (x - x.mean(0)) / x.std(0)
        gap = compose(fit(y, x), y, x, y[0]) - compose(fit_convex(y, x), y, x, y[0])
        assert np.abs(gap).max() < 1e-6
    info = _compile_program.cache_info()
    assert (info.misses, info.hits) == (2, 2) and info.maxsize is not None


def test_the_program_forgets_the_samples_before() -> None:
    """The same samples, after others and under another solver: the same bits."""
    y, x = samples(3, m=1, d=2)
    first = fit_convex(y, x)
    fit_convex(*samples(4, m=1, d=2))
    fit_convex(y, x, solver="CLARABEL")
    assert np.array_equal(fit_convex(y, x).scale, first.scale)


@pytest.mark.parametrize(
    ("name", "y", "x"),
    [
        ("x", _Y[:3], _X[:3]),
        ("x", _Y, _X[:, [0, 0]]),
        ("x", _X[:, :1], _X),
        ("x", _Y, np.column_stack([_X, np.full(20, 0.1)])),
        ("y", _Y @ [[1.0, 0.3]], _X),
        ("y", np.zeros((20, 1)), _X),
        ("y", _Y[None], _X),
    ],
)
def test_samples_without_a_map_are_blamed(
    name: str, y: np.ndarray, x: np.ndarray
) -> None:
    """Too few, constant, or combinations of others."""
    for estimator in (fit, partial(separable.fit, order=0)):
        with pytest.raises(ValueError, match=f"^{name} must"):
            estimator(y, x)


def test_a_repeated_variable_s_rounding_is_no_variance() -> None:
    almost = np.array([[4.0, 4.0], [4.0, 4.0 + 4e-15]])  # which has a factor
    assert np.linalg.cholesky(almost)[1, 1] > 0
    with pytest.raises(ValueError, match="x must .* not combinations of others"):
        affine.from_moments(np.ones(2), almost, 1)


@pytest.mark.parametrize(
    ("solver", "limit"), [("ECOS", "max_iters"), ("CLARABEL", "max_iter")]
)
def test_a_solver_that_stops_short_raises_its_status(
    monkeypatch: pytest.MonkeyPatch, solver: str, limit: str
) -> None:
    solve = cvxpy.Problem.solve
    monkeypatch.setattr(
        cvxpy.Problem,
        "solve",
        lambda problem, **options: solve(problem, **options, **{limit: 1}),
    )
    with pytest.raises(SolverError, match=f"{solver}: component 2"):
        fit_convex(_Y, _X, solver=solver)


def _enkf(y: np.ndarray, x: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """The textbook formula x + Σxy Σyy^-1 (y* - y), one ensemble."""
    joint = np.cov(np.hstack([x, y]), rowvar=False)
    d = x.shape[1]
    gain = joint[:d, d:] @ np.linalg.inv(joint[d:, d:])
    return x + (observed - y) @ gain.T


@given(st.integers(0, 10_000), st.integers(1, 4), st.integers(1, 5))
def test_composed_affine_map_is_the_enkf(seed: int, m: int, d: int) -> None:
    y, x = samples(seed, 60, m, d)
    observed = rng_of(seed + 1).standard_normal(m)
    condition = np.linalg.cond(np.cov(y, rowvar=False).reshape(m, -1))
    ours = compose(fit(y, x), y, x, observed)
    theirs = _enkf(y, x, observed)
    assert np.abs(ours - theirs).max() < 1e-12 * max(1, np.abs(theirs).max(), condition)
