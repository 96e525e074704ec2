"""Batched linear algebra on covariances: Cholesky factors and triangular solves, no inverse.

Functions without validation serve loops: they take float64 arrays that fit, and Cholesky factors in
place of covariances.
"""

from __future__ import annotations

import math
from contextlib import suppress
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv, dpotrf, dtrtrs

from .validation import Array, PositiveSemidefinite, validated

__all__ = ["SolverError", "factor"]

EPS = float(np.finfo(np.float64).eps)
# Matrices up to this size are solved faster by substitution in numpy, if there are many.
_SMALL = 12
# Numbers in one block of small systems: half a megabyte stays in the cache.
_BLOCK_SIZE = 2**16


class SolverError(RuntimeError):
    """A solver stopped without a solution; the message names it, its status and the problem."""


def center_ensemble(members: Array) -> tuple[Array, Array]:
    """Mean (..., 1, d) and anomalies (..., N, d) of rows (..., N, d): members minus their mean.

    >>> center_ensemble(np.array([[1.0], [3.0]]))
    (array([[2.]]), array([[-1.],
           [ 1.]]))
    """
    # A product with equal weights: ten times faster than a reduction over a short inner axis.
    mean = equal_weights(members.shape[-2]) @ members
    return mean, members - mean


@lru_cache(maxsize=16)
def equal_weights(members: int) -> Array:
    """Weights 1/N as a row, (1, N)."""
    return np.full((1, members), 1 / members)


@lru_cache(maxsize=16)
def identity(dim: int) -> Array:
    """Return the identity matrix, made once for each size and read-only."""
    matrix = np.eye(dim)
    matrix.setflags(write=False)
    return matrix


@lru_cache(maxsize=16)
def upper_triangle(dim: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows and columns of a matrix's upper triangle, made once and read-only."""
    rows, columns = np.triu_indices(dim)
    rows.setflags(write=False)
    columns.setflags(write=False)
    return rows, columns


def symmetrise(m: Array) -> Array:
    """Average a square matrix and its transpose, where a product loses symmetry by rounding."""
    return np.asarray(0.5 * (m + m.swapaxes(-1, -2)))


@validated
def factor(cov: PositiveSemidefinite) -> Array:
    r"""A matrix :math:`\mathbf L` with :math:`\mathbf L\mathbf L^\top` = `cov`, singular or not.

    Parameters
    ----------
    cov : array_like, (..., d, d)
        Symmetric positive semidefinite.

    Returns
    -------
    ndarray, (..., d, d)
        Lower triangular with a nonnegative diagonal: the Cholesky factor, with zero columns where a
        matrix is singular.

    Notes
    -----
    :math:`\mathbf L\mathbf L^\top` meets `cov` to some 50 d units of rounding of
    :math:`\sqrt{P_{ii}P_{jj}}`. A singular matrix has one such factor as long as each component
    either is determined by those before it or is not: then draws with it do not depend on the
    machine. Where a pivot is so small that rounding decides, elimination misses `cov`, and an
    orthogonal reduction of the eigenvectors takes its place.

    Examples
    --------
    >>> L = factor([[4.0, 0.0], [0.0, 0.0]])
    >>> L @ L.T
    array([[4., 0.],
           [0., 0.]])
    """
    try:
        return cholesky(cov)
    except np.linalg.LinAlgError:
        return _semidefinite_cholesky(cov)


def cholesky(cov: Array) -> Array:
    """Return the lower Cholesky factor; LinAlgError if a matrix is not positive definite."""
    d = cov.shape[-1]
    if cov.size == d * d > 0:
        # LAPACK itself takes a fifth of numpy's time for one matrix.
        lower, failed = dpotrf(cov.reshape(d, d), lower=1, clean=1)
        if failed:
            raise np.linalg.LinAlgError("Matrix is not positive definite")
        return np.asarray(lower.reshape(cov.shape))
    return np.asarray(np.linalg.cholesky(cov))


def _semidefinite_cholesky(cov: Array) -> Array:
    """Return the lower triangular factor with a zero column where a pivot vanishes."""
    d = cov.shape[-1]
    scaled, unit = to_unit_variances(cov)
    lower = np.zeros_like(scaled)
    for j in range(d):
        # Column j of the Schur complement: A[j:, j] - L[j:, :j] L[j, :j]ᵀ
        product = lower[..., j:, :j] @ lower[..., j, :j, None]
        column = scaled[..., j:, j] - product[..., 0]
        pivot = column[..., 0]
        # A pivot of rounding counts as zero; division by infinity gives a zero column.
        root = np.sqrt(np.where(pivot > 16 * d * EPS, pivot, np.inf))
        lower[..., j:, j] = column / root[..., None]
    error = np.abs(lower @ lower.swapaxes(-1, -2) - scaled)
    worst = error.max(axis=(-2, -1), initial=0.0)
    for index in np.argwhere(worst > 32 * d * EPS):
        place = tuple(index)
        lower[place] = _factor_from_eigenvectors(scaled[place])
    return np.asarray(lower * unit[..., :, None])


def _factor_from_eigenvectors(cov: Array) -> Array:
    """Return the lower triangular factor of one matrix by orthogonal steps, which lose nothing."""
    values, vectors = np.linalg.eigh(cov)
    positive = values > 4 * len(cov) * EPS * values[-1]
    # P = A Aᵀ with the columns √λ v of A.
    columns = vectors[:, positive] * np.sqrt(values[positive])
    lower = np.zeros_like(cov)
    lower[:, : positive.sum()] = lower_root(columns)
    return lower


def lower_root(columns: Array) -> Array:
    """Return the lower triangular L with L Lᵀ = A Aᵀ for A of these columns.

    By QR, which loses no definiteness. The diagonal is nonnegative, which leaves no signs to the
    machine.
    """
    # Aᵀ = Q R, so A Aᵀ = Rᵀ R.
    upper: Array = np.asarray(np.linalg.qr(columns.mT, mode="r"))
    diagonal = np.diagonal(upper, axis1=-2, axis2=-1)
    sign = np.where(diagonal < 0, -1.0, 1.0)
    return np.asarray(upper.mT * sign[..., None, :])


def broadcast_leading(
    first: tuple[int, ...], second: tuple[int, ...], name: str
) -> tuple[int, ...]:
    """Broadcast leading axes, or raise an error that names the argument with the second ones."""
    if first == second:
        return first
    try:
        return np.broadcast_shapes(first, second)
    except ValueError:
        raise ValueError(
            f"{name} must have leading axes that broadcast with {first}, got {second}"
        ) from None


def solve_lower(lower: Array, right: Array, *, transposed: bool = False) -> Array:
    r"""Solve L x = b, or Lᵀ x = b, (..., d, d) and (..., d, k); leading axes broadcast."""
    d, k = right.shape[-2:]
    if lower.size == d * d and lower.ndim <= right.ndim:
        return _solve_one_factor(lower.reshape(d, d), right, transposed)
    leading = lower.shape[:-2]
    if leading != right.shape[:-2]:
        leading = np.broadcast_shapes(leading, right.shape[:-2])
        lower = np.broadcast_to(lower, (*leading, d, d))
        right = np.broadcast_to(right, (*leading, d, k))
    n = math.prod(leading)
    factors = lower.reshape(n, d, d)
    sides = right.reshape(n, d, k)
    if n > 2 * d:
        # Row after row of all systems at once is faster than a call for each.
        solution = _solve_in_blocks(factors, sides, transposed)
    else:
        solution = np.empty((n, d, k))
        for i in range(n):
            if d <= _SMALL and k > 200 * d:
                solution[i] = _solve_one_factor(factors[i], sides[i], transposed)
            else:
                solution[i], failed = dtrtrs(
                    factors[i], sides[i], lower=1, trans=int(transposed)
                )
                if failed:
                    raise np.linalg.LinAlgError("Singular matrix")
    return solution.reshape(*leading, d, k)


def solve_upper(lower: Array, right: Array) -> Array:
    r"""Solve Lᵀ x = b with the *lower* triangular factor."""
    return solve_lower(lower, right, transposed=True)


def solve_definite(matrix: Array, right: Array) -> Array:
    """Solve with symmetric positive definite matrices, (..., m, m) and (..., m, k)."""
    m, k = right.shape[-2:]
    if matrix.size == m * m and right.size == m * k > 0:
        # LAPACK itself takes a third of numpy's time for one system.
        _, solution, failed = dposv(matrix.reshape(m, m), right.reshape(m, k), lower=1)
        if not failed:
            return np.asarray(solution.reshape(right.shape))
    elif _has_many_small_systems(matrix, right):
        with suppress(np.linalg.LinAlgError):  # by rounding one may be indefinite
            lower = cholesky(matrix)
            return solve_upper(lower, solve_lower(lower, right))
    return np.asarray(np.linalg.solve(matrix, right))


def solve_semidefinite(matrix: Array, right: Array) -> Array:
    """Solve P X = B for covariances of which some components may be known constants.

    A component without variance has zero rows in P and in B, and gets zeros in X.

    >>> solve_semidefinite(np.diag([2.0, 0.0]), np.array([[4.0], [0.0]])).ravel()
    array([2., 0.])
    """
    is_known = np.diagonal(matrix, axis1=-2, axis2=-1) == 0
    if np.count_nonzero(is_known):
        # A one on the diagonal takes the component out of the sums.
        matrix = matrix + np.where(is_known[..., None], np.eye(matrix.shape[-1]), 0.0)
    return np.asarray(np.linalg.solve(matrix, right))


def _has_many_small_systems(matrix: Array, right: Array) -> bool:
    """Whether substitution in numpy is faster than a LAPACK call for each system."""
    m = right.shape[-2]
    same_axes = matrix.shape[:-2] == right.shape[:-2]
    return m <= _SMALL and right.size > 600 * m and same_axes


def _solve_one_factor(lower: Array, right: Array, transposed: bool) -> Array:
    """Solve with one factor (d, d), of which all of `right` (..., d, k) are columns."""
    d, k = right.shape[-2:]
    if not right.size:
        return np.array(right)
    is_matrix = right.size == d * k
    if is_matrix:
        columns = right.reshape(d, k)
    else:
        columns = np.moveaxis(right, -2, 0).reshape(d, -1)
    if d <= _SMALL and columns.size > 200 * d * d:
        # With so many columns LAPACK's copy to its own order costs more than the solution.
        x = np.array(columns[:, None], order="C")
        solution = _substitute(lower[..., None], x, transposed)
    else:
        solution, failed = dtrtrs(lower, columns, lower=1, trans=int(transposed))
        if failed:
            raise np.linalg.LinAlgError("Singular matrix")
    if is_matrix:
        return np.asarray(solution).reshape(right.shape)
    solution = solution.reshape(d, *right.shape[:-2], k)
    return np.moveaxis(solution, 0, -2)


def _solve_in_blocks(lower: Array, right: Array, transposed: bool) -> Array:
    """Solve many small systems (n, d, d), as many at once as the cache holds."""
    solution = np.empty(right.shape)
    block = max(1, _BLOCK_SIZE // (1 + lower[0].size + right[0].size))
    for start in range(0, len(solution), block):
        systems = slice(start, start + block)
        # Systems last, so that each row operation runs over contiguous memory.
        factors = np.ascontiguousarray(lower[systems].transpose(1, 2, 0))
        x = np.array(right[systems].transpose(1, 2, 0), order="C")
        solution[systems] = _substitute(factors, x, transposed).transpose(2, 0, 1)
    return solution


def _substitute(lower: Array, x: Array, transposed: bool) -> Array:
    """Solve in place, row after row of (d, k, n), with factors (d, d, n) or (d, d, 1)."""
    d = len(x)
    if transposed:
        # Backward: x_i = b_i / L_ii, then b_j -= L_ij x_i for j < i.
        for i in reversed(range(d)):
            x[i] /= lower[i, i]
            x[:i] -= lower[i, :i][:, None] * x[i]
    else:
        # Forward: x_i = b_i / L_ii, then b_j -= L_ji x_i for j > i.
        for i in range(d):
            x[i] /= lower[i, i]
            x[i + 1 :] -= lower[i + 1 :, i][:, None] * x[i]
    return x


def whiten(lower: Array, vectors: Array) -> Array:
    """Solve L z = v for vectors (..., d); leading axes broadcast."""
    if lower.ndim == 2:
        # One factor for all vectors: they are its columns.
        n_vectors = math.prod(vectors.shape[:-1])
        rows = vectors.reshape(n_vectors, len(lower) if not vectors.size else -1)
        return _solve_one_factor(lower, rows.T, False).T.reshape(vectors.shape)
    if lower.shape[-3] == 1 and vectors.ndim > 1:
        # One factor for all vectors along the last leading axis.
        columns = vectors.swapaxes(-1, -2)
        white = solve_lower(lower[..., 0, :, :], columns)
        return white.swapaxes(-1, -2)
    white = solve_lower(lower, vectors[..., None])
    return np.asarray(white[..., 0])


def quadratic_form(lower: Array, vector: Array) -> Array:
    """Squared Mahalanobis length of vectors (..., d), by the covariance's Cholesky factor."""
    return np.asarray((whiten(lower, vector) ** 2).sum(axis=-1))


def log_det(lower: Array) -> Array:
    """Logarithm of a covariance's determinant, by its Cholesky factor."""
    diagonal = np.diagonal(lower, axis1=-2, axis2=-1)
    return np.asarray(2.0 * np.log(diagonal).sum(axis=-1))


def log_sum_exp(logs: Array) -> Array:
    """Logarithm of the sum of exponentials (..., 1), in a tenth of scipy's time; -inf if all are.

    >>> log_sum_exp(np.zeros(2)).round(4)
    array([0.6931])
    """
    # The bound keeps -inf - (-inf) out of the differences.
    top = np.maximum(logs.max(axis=-1, keepdims=True), -1e300)
    total = np.exp(logs - top).sum(axis=-1, keepdims=True)
    if np.count_nonzero(total) == total.size:
        return np.asarray(top + np.log(total))
    with np.errstate(divide="ignore"):
        return np.asarray(top + np.log(total))


def deviations(cov: Array) -> Array:
    """Return the standard deviations (..., d) of covariances (..., d, d).

    >>> deviations(np.diag([4.0, 0.0]))
    array([2., 0.])
    """
    # A variance may be negative by rounding.
    variances = cov.diagonal(axis1=-2, axis2=-1)
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def to_unit_variances(cov: Array) -> tuple[Array, Array]:
    """Scale covariances to unit variances; also return the standard deviations, 1 of a constant."""
    std = np.sqrt(np.abs(np.diagonal(cov, axis1=-2, axis2=-1)))
    unit = np.where(std > 0, std, 1.0)
    return cov / (unit[..., :, None] * unit[..., None, :]), unit
