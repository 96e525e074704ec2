"""The two lowest floors: checks and linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from distfilt import checks, linalg
from distfilt.progress import track

NAN = float("nan")
INDEFINITE = [[1.0, 2.0], [2.0, 1.0]]
ASYMMETRIC = [[1.0, 0.5], [0.0, 1.0]]

_C = "distfilt.checks."
_L = "distfilt.linalg."
BAD_INPUT = {
    _C + "array": [
        ("x", lambda: checks.array("three", "x")),
        ("x", lambda: checks.array([1.0, NAN], "x")),
        ("x", lambda: checks.array([1.0], "x", (2,))),
        ("x", lambda: checks.array([1.0], "x", (..., "N", 1))),
        ("x", lambda: checks.array([[1.0, 2.0], [3.0]], "x")),
    ],
    _C + "callable_": [("f", lambda: checks.callable_(1, "f"))],
    _C + "choice": [("c", lambda: checks.choice("z", "c", ("a", "b")))],
    _C + "count": [
        ("n", lambda: checks.count(0, "n")),
        ("n", lambda: checks.count(True, "n")),
        ("n", lambda: checks.count(2.0, "n")),
    ],
    _C + "covariance": [
        ("P", lambda: checks.covariance(INDEFINITE, "P")),
        ("P", lambda: checks.covariance(ASYMMETRIC, "P")),
        ("P", lambda: checks.covariance([[1.0, 0.0]], "P")),
        ("P", lambda: checks.covariance(np.eye(2), "P", 3)),
        ("P", lambda: checks.covariance(np.zeros((2, 2)), "P")),
        ("P", lambda: checks.covariance(-np.eye(2), "P", semidefinite=True)),
    ],
    _C + "generator": [
        ("rng", lambda: checks.generator(None)),
        ("rng", lambda: checks.generator(np.random.RandomState(0))),
    ],
    _C + "increasing": [
        ("times", lambda: checks.increasing([1.0, 1.0], "times")),
        ("times", lambda: checks.increasing([[1.0]], "times")),
    ],
    _C + "number": [
        ("a", lambda: checks.number(NAN, "a")),
        ("a", lambda: checks.number("x", "a")),
        ("a", lambda: checks.number(0, "a", above=0)),
        ("a", lambda: checks.number(1, "a", below=1)),
        ("a", lambda: checks.number(2, "a", at_most=1)),
        ("a", lambda: checks.number(-1, "a", at_least=0)),
        ("a", lambda: checks.number([1.0], "a")),
    ],
    _C + "same_length": [("a", lambda: checks.same_length([1], [], "a", "b"))],
    _C + "weights": [
        ("w", lambda: checks.weights([0.5, 0.4], "w")),
        ("w", lambda: checks.weights([1.5, -0.5], "w")),
        ("w", lambda: checks.weights([1.0], "w", 2)),
    ],
    "distfilt.progress.track": [("items", lambda: track(3, show=True))],
    _L + "cholesky_solve": [
        ("cov", lambda: linalg.cholesky_solve(INDEFINITE, np.eye(2))),
        ("right", lambda: linalg.cholesky_solve(np.eye(2), np.eye(3))),
    ],
    _L + "factor": [
        ("cov", lambda: linalg.factor(-np.eye(2))),
        ("cov", lambda: linalg.factor(ASYMMETRIC)),
    ],
    _L + "log_det": [("cov", lambda: linalg.log_det(INDEFINITE))],
    _L + "quadratic_form": [
        ("cov", lambda: linalg.quadratic_form(INDEFINITE, [1.0, 2.0])),
        ("vector", lambda: linalg.quadratic_form(np.eye(2), [1.0])),
    ],
    _L + "symmetrise": [("matrix", lambda: linalg.symmetrise([[1.0, 2.0]]))],
    _L + "van_loan": [
        ("drift", lambda: linalg.van_loan([[0.0, 1.0]], np.eye(2), 0.1)),
        ("diffusion", lambda: linalg.van_loan(np.eye(2), -np.eye(2), 0.1)),
        ("dt", lambda: linalg.van_loan(np.eye(2), np.eye(2), -0.1)),
    ],
}
EXEMPT = {
    "distfilt.__version__": "a constant",
    _C + "Array": "a type",
    _C + "SolverError": "an exception",
}


def _covariance(seed: int, d: int, leading: tuple[int, ...] = ()) -> np.ndarray:
    a = np.random.default_rng(seed).standard_normal((*leading, d, d))
    return linalg.symmetrise(a @ np.swapaxes(a, -1, -2) + 0.1 * np.eye(d))


@given(arrays(np.float64, (3, 4), elements=st.floats(-1e3, 1e3)))
def test_array_keeps_values_and_does_not_copy(values: np.ndarray) -> None:
    out = checks.array(values, "x", (..., "N", 4))
    assert np.shares_memory(out, values)


def test_inputs_are_not_changed() -> None:
    cov = _covariance(0, 3)
    before = cov.copy()
    linalg.factor(cov)
    linalg.cholesky_solve(cov, np.eye(3))
    assert (cov == before).all()


@given(st.integers(0, 10_000), st.integers(1, 6))
def test_factor_reproduces_its_matrix(seed: int, d: int) -> None:
    cov = _covariance(seed, d, (2,))
    lower = linalg.factor(cov)
    assert np.allclose(lower @ np.swapaxes(lower, -1, -2), cov, rtol=1e-12, atol=1e-12)


@given(st.integers(0, 10_000), st.integers(2, 6))
def test_factor_of_a_singular_matrix(seed: int, d: int) -> None:
    a = np.random.default_rng(seed).standard_normal((d, d - 1))
    cov = linalg.symmetrise(a @ a.T)
    lower = linalg.factor(cov)
    assert np.allclose(lower @ lower.T, cov, atol=1e-10 * np.abs(cov).max())


@given(st.integers(0, 10_000), st.integers(1, 6))
def test_solve_quadratic_form_and_log_det_agree_with_numpy(seed: int, d: int) -> None:
    cov = _covariance(seed, d)
    v = np.random.default_rng(seed + 1).standard_normal(d)
    solved = linalg.cholesky_solve(cov, v[:, None])[:, 0]
    assert np.allclose(cov @ solved, v, atol=1e-9)
    assert np.isclose(linalg.quadratic_form(cov, v), v @ solved, rtol=1e-9)
    assert np.isclose(linalg.log_det(cov), np.linalg.slogdet(cov)[1], rtol=1e-10, atol=1e-10)


def test_van_loan_composes() -> None:
    """Two half steps make one step: Φ and Q of the whole follow from those of the halves."""
    rng = np.random.default_rng(5)
    drift, density = rng.standard_normal((4, 4)), _covariance(6, 4)
    phi, q = linalg.van_loan(drift, density, 0.6)
    half, noise = linalg.van_loan(drift, density, 0.3)
    assert np.allclose(half @ half, phi, rtol=1e-12)
    assert np.allclose(half @ noise @ half.T + noise, q, rtol=1e-12)


def test_van_loan_without_time() -> None:
    phi, q = linalg.van_loan(np.eye(3), np.eye(3), 0.0)
    assert (phi == np.eye(3)).all() and (q == 0).all()


def test_solver_error_is_a_runtime_error() -> None:
    with pytest.raises(RuntimeError, match="stopped"):
        raise checks.SolverError("stopped")


def test_progress_is_silent_under_a_test(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(track(range(3), show=True)) == [0, 1, 2]
    assert capsys.readouterr() == ("", "")


@given(st.integers(0, 10_000), st.integers(2, 6))
def test_factor_is_lower_triangular_also_where_a_component_is_still(seed: int, d: int) -> None:
    """Unique, so a draw with it does not depend on the machine: no free signs or rotations."""
    cov = _covariance(seed, d)
    cov[-1] = cov[:, -1] = 0.0
    lower = linalg.factor(cov)
    assert (np.triu(lower, 1) == 0).all() and (np.diagonal(lower) >= 0).all()
    plain = np.linalg.cholesky(cov[:-1, :-1])
    assert np.allclose(lower[:-1, :-1], plain, rtol=1e-9, atol=1e-12)
    assert (lower[-1] == 0).all()
