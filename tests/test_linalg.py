"""Factors, solves and derivatives against definitions and full matrices."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt import linalg
from distfilt.derivatives import central_difference
from distfilt.sensors import wrap
from tests.support import generator, relative_difference, singular, spd, without_checks

SEEDS = st.integers(0, 10_000)
SIZES = st.integers(1, 7)
EPS = linalg.EPS


def _transpose(a: np.ndarray) -> np.ndarray:
    return np.swapaxes(a, -1, -2)


def _solve(cov: np.ndarray, right: np.ndarray) -> np.ndarray:
    lower = linalg.cholesky(cov)
    return linalg.solve_lower(lower, linalg.solve_lower(lower, right), transposed=True)


def _length(cov: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return linalg.quadratic_form(linalg.cholesky(cov), vector)


def _log_det(cov: np.ndarray) -> np.ndarray:
    return linalg.log_det(linalg.cholesky(cov))


# --- factors ----------------------------------------------------------------------------------


@given(SEEDS, SIZES)
def test_factor_reproduces_its_matrix(seed: int, d: int) -> None:
    cov = spd(generator(seed), d, (2, 3))
    lower = linalg.factor(cov)
    # L Lᵀ = P to rounding, triangular with a positive diagonal.
    assert relative_difference(lower @ _transpose(lower), cov) < 10 * d * EPS
    assert (np.triu(lower, 1) == 0).all()
    diagonals = np.diagonal(lower, axis1=-2, axis2=-1)
    assert (diagonals > 0).all()
    # A matrix of the stack has the factor that it has by itself.
    single = linalg.factor(cov[1, 2])
    assert np.allclose(single, lower[1, 2], rtol=1e-10, atol=1e-12)


@given(SEEDS, st.integers(2, 7), st.data())
def test_factor_of_a_singular_matrix_keeps_every_digit(
    seed: int, d: int, data: st.DataObject
) -> None:
    """Also where elimination meets a pivot of rounding, in any units; zero columns are kept."""
    rank = data.draw(st.integers(1, d - 1))
    rng = generator(seed)
    size = 10.0 ** rng.uniform(-8, 8, d)
    cov = singular(rng, d, rank) * size[:, None] * size
    cov = 0.5 * (cov + cov.T)
    lower = linalg.factor(cov)
    assert relative_difference(lower @ lower.T, cov) < 50 * d * EPS
    assert (np.triu(lower, 1) == 0).all()
    assert (np.diagonal(lower) >= 0).all()


@pytest.mark.parametrize("nearly", [1e-7, 3e-8, 1e-8, 1e-9])
def test_factor_where_a_tiny_pivot_decides(nearly: float) -> None:
    """The second component is the first, up to `nearly` times the third.

    Elimination divides a column by the root of a pivot that rounding has spoilt: a third pivot of
    0.1 below zero would be dropped, and with it a tenth of a variance.
    """
    third = np.array([0.0, nearly, 1.0])
    for k in range(20):
        scale = generator(k).uniform(0.5, 2.0)
        first = scale * np.array([1.0, scale, 0.3])
        # Rank two: the third pivot is zero in exact arithmetic.
        cov = np.outer(first, first) + np.outer(third, third)
        lower = linalg.factor(cov)
        assert relative_difference(lower @ lower.T, cov) < 150 * EPS
        assert (np.triu(lower, 1) == 0).all()


@given(SEEDS, st.integers(2, 6), st.data())
def test_factor_is_unique_where_a_component_is_still(
    seed: int, d: int, data: st.DataObject
) -> None:
    """No free signs or rotations: a draw with it does not depend on the machine."""
    k = data.draw(st.integers(0, d - 1))
    cov = spd(generator(seed), d)
    cov[k] = cov[:, k] = 0.0
    lower = linalg.factor(cov)
    # The other components have the Cholesky factor of their own covariance.
    others = np.arange(d) != k
    block = np.ix_(others, others)
    plain = np.linalg.cholesky(cov[block])
    assert np.allclose(lower[block], plain, rtol=1e-9, atol=1e-12)
    assert (lower[k] == 0).all()
    assert (lower[:, k] == 0).all()


def test_factor_of_nothing_and_of_a_mixed_stack() -> None:
    assert (linalg.factor(np.zeros((2, 3, 3))) == 0).all()
    # Definite, of rank one, and diagonal with zeros
    definite = spd(generator(), 3)
    semidefinite = np.diag([0.0, 4.0, 0.0])
    mixed = np.stack([definite, np.ones((3, 3)), semidefinite])
    lower = linalg.factor(mixed)
    assert relative_difference(lower @ _transpose(lower), mixed) < 100 * EPS
    assert np.allclose(lower[1], [[1, 0, 0], [1, 0, 0], [1, 0, 0]])
    assert lower[2, 1, 1] == 2
    assert np.count_nonzero(lower[2]) == 1


# --- solves -----------------------------------------------------------------------------------

LEADING = [(), (1,), (3,), (40,), (2, 3), (5, 8), (5000,)]
"""One system, a call for each, and substitution in all of them at once, or in several blocks."""


@pytest.mark.parametrize("leading", LEADING)
@pytest.mark.parametrize("d", [1, 2, 5])
def test_triangular_solves_of_every_number_of_systems(
    leading: tuple[int, ...], d: int
) -> None:
    rng = generator(d)
    cov = spd(rng, d, leading)
    lower = np.linalg.cholesky(cov)
    right = rng.standard_normal((*leading, d, 3))
    # A negative definite matrix has no Cholesky factor and is solved otherwise.
    for sign in (1, -1):
        solution = linalg.solve_definite(sign * cov, right)
        assert np.allclose(sign * cov @ solution, right)
    # Neither argument is written to.
    lower.flags.writeable = False
    right.flags.writeable = False
    first = (0,) * len(leading)
    is_close = partial(np.allclose, rtol=1e-11, atol=1e-11)
    for solve, matrix in (
        (linalg.solve_lower, lower),
        (partial(linalg.solve_lower, transposed=True), _transpose(lower)),
    ):
        # A solution for each system
        solution = solve(lower, right)
        assert solution.shape == right.shape
        assert is_close(matrix @ solution, right)
        # One right side for all matrices
        solution = solve(lower, right[first])
        assert is_close(matrix @ solution, right[first])
        # One matrix for all right sides
        solution = solve(lower[first], right)
        assert is_close(matrix[first] @ solution, right)


@pytest.mark.parametrize("leading", LEADING)
def test_whitening_broadcasts_in_every_way(leading: tuple[int, ...]) -> None:
    rng = generator(2)
    lower = np.linalg.cholesky(spd(rng, 4, leading))
    for shape in ((*leading, 4), (4,)):
        v = rng.standard_normal(shape)
        solution = linalg.whiten(lower, v)
        product = (lower @ solution[..., None])[..., 0]
        assert np.allclose(product, np.broadcast_to(v, solution.shape))
    many = rng.standard_normal((*leading, 7, 4))
    # Each factor for seven vectors, then the first factor for all
    per_system = lower[..., None, :, :]
    solution = linalg.whiten(per_system, many)
    assert solution.shape == many.shape
    product = (per_system @ solution[..., None])[..., 0]
    assert np.allclose(product, many)
    first = lower[(0,) * len(leading)]
    solution = linalg.whiten(first, many)
    product = (first @ solution[..., None])[..., 0]
    assert np.allclose(product, many)


@pytest.mark.parametrize("leading", [(), (0,), (3,), (0, 2)])
@pytest.mark.parametrize(("d", "k"), [(0, 0), (0, 2), (2, 0), (2, 1)])
def test_empty_systems(leading: tuple[int, ...], d: int, k: int) -> None:
    cov = np.broadcast_to(np.eye(d), (*leading, d, d))
    right = np.ones((*leading, d, k))
    assert _solve(cov, right).shape == right.shape
    assert _length(cov, np.ones((*leading, d))).shape == leading
    assert _length(np.eye(d), np.ones((*leading, d))).shape == leading
    assert without_checks(linalg.factor)(cov).shape == cov.shape
    assert _log_det(cov).shape == leading


@given(SEEDS, SIZES, st.sampled_from(LEADING))
def test_solves_agree_with_numpy(seed: int, d: int, leading: tuple[int, ...]) -> None:
    rng = generator(seed)
    cov = spd(rng, d, leading)
    v = rng.standard_normal((*leading, d))
    # vᵀ P⁻¹ v and log |P|, as numpy's general routines give them.
    worst = 1e-13 * np.linalg.cond(cov).max()
    plain = np.linalg.solve(cov, v[..., None])[..., 0]
    lengths = (v * plain).sum(-1)
    assert np.allclose(_length(cov, v), lengths, rtol=worst)
    logs = np.linalg.slogdet(cov)[1]
    assert np.allclose(_log_det(cov), logs, rtol=1e-11, atol=1e-11)


# --- derivatives ------------------------------------------------------------------------------


def test_values_that_wrap_and_large_components() -> None:
    slope = central_difference(wrap, np.array([np.pi, 3.0]), lambda a, b: wrap(a - b))
    assert np.abs(slope - np.eye(2)).max() < 1e-9
    slope = central_difference(lambda x: 2 * x, np.array([1e9]))
    assert np.abs(slope - 2).max() < 1e-9
