"""Batched linear algebra on covariances: Cholesky factors and triangular solves, no inverse.

Functions without validation serve loops: they take float64 arrays that fit, and Cholesky factors in
place of covariances.
"""

from __future__ import annotations

import math
from contextlib import suppress
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv, dpotrf, dtrtrs

from .validation import Array, PositiveSemidefinite, validated

__all__ = ["SolverError", "factor"]

EPS = float(np.finfo(np.float64).eps)
# Matrices up to this size are solved faster by substitution in numpy than by LAPACK if there are
# many right-hand sides: more than so many for each row of one factor, or more than so many in all
# systems together. The two take equally long at about these numbers.
_SMALL = 12
_MANY_PER_ROW = 200
_MANY_IN_ALL = 600
# Numbers in one block of small systems: half a megabyte stays in the cache.
_BLOCK_SIZE = 2**16


class SolverError(RuntimeError):
    """A solver stopped without a solution; the message names it, its status and the problem."""


class CenteredEnsemble(NamedTuple):
    """Mean (..., 1, d) and anomalies (..., N, d) of an ensemble: members minus their mean."""

    mean: Array
    anomalies: Array


def center_ensemble(members: Array) -> CenteredEnsemble:
    """Subtract the mean from members (..., N, d).

    >>> center_ensemble(np.array([[1.0], [3.0]])).anomalies
    array([[-1.],
           [ 1.]])
    """
    # A product with equal weights: ten times faster than a reduction over a short inner axis.
    mean = equal_weights(members.shape[-2]) @ members
    return CenteredEnsemble(mean, members - mean)


@lru_cache(maxsize=16)
def equal_weights(members: int) -> Array:
    """Weights 1/N as a row, (1, N)."""
    return np.full((1, members), 1 / members)


@lru_cache(maxsize=16)
def identity(dim: int) -> Array:
    """Return the identity matrix, made once for each size and read-only."""
    matrix = np.eye(dim)
    # All callers share the cached array.
    matrix.setflags(write=False)
    return matrix


@lru_cache(maxsize=16)
def upper_triangle(dim: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows and columns of a matrix's upper triangle, made once and read-only."""
    rows, columns = np.triu_indices(dim)
    # All callers share the cached arrays.
    rows.setflags(write=False)
    columns.setflags(write=False)
    return rows, columns


def symmetrise(m: Array) -> Array:
    """Average matrices (..., d, d) and their transposes, which differ by rounding only."""
    total = m + m.mT
    total *= 0.5
    return np.asarray(total)


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
    :math:`\sqrt{P_{ii}P_{jj}}`. If it is clear which components are linear combinations of those
    before them, a singular matrix has one such factor, and draws with it do not depend on the
    machine. Where rounding decides whether a pivot is zero, elimination can miss `cov`, and the
    factor is computed from the eigenvectors by QR instead.

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
    """Lower Cholesky factors (..., d, d); LinAlgError if a matrix is not positive definite."""
    d = cov.shape[-1]
    # A single matrix, whose leading axes, if any, have length 1.
    if cov.size == d * d > 0:
        # LAPACK itself takes a fifth of numpy's time for one matrix; `clean` puts zeros above the
        # diagonal.
        lower, failed = dpotrf(cov.reshape(d, d), lower=1, clean=1)
        if failed:
            raise np.linalg.LinAlgError("Matrix is not positive definite")
        return np.asarray(lower.reshape(cov.shape))
    return np.asarray(np.linalg.cholesky(cov))


def _semidefinite_cholesky(cov: Array) -> Array:
    """Return lower triangular factors (..., d, d), with a zero column where a pivot vanishes.

    Covariances are (..., d, d), and may be singular.
    """
    d = cov.shape[-1]
    # With unit variances, rounding has the same size in every entry: a few d ε.
    scaled, std = to_unit_variances(cov)
    lower = np.zeros_like(scaled)
    for j in range(d):
        # Column j of the Schur complement: A[j:, j] - L[j:, :j] L[j, :j]ᵀ
        product = lower[..., j:, :j] @ lower[..., j, :j, None]
        column = scaled[..., j:, j] - product[..., 0]
        pivot = column[..., 0]
        # A pivot of rounding counts as zero; division by infinity gives a zero column.
        root = np.sqrt(np.where(pivot > 16 * d * EPS, pivot, np.inf))
        lower[..., j:, j] = column / root[..., None]
    # Elimination has failed if L Lᵀ misses the matrix by more than the pivots left out can do.
    error = np.abs(lower @ lower.swapaxes(-1, -2) - scaled)
    largest_error = error.max(axis=(-2, -1), initial=0.0)
    # There the factor is found in another way, which costs more.
    for index in np.argwhere(largest_error > 32 * d * EPS):
        matrix = tuple(index)
        lower[matrix] = _factor_from_eigenvectors(scaled[matrix])
    return np.asarray(lower * std[..., :, None])


def _factor_from_eigenvectors(cov: Array) -> Array:
    """Return the lower triangular factor of one matrix (d, d), from its eigenvectors by QR."""
    values, vectors = np.linalg.eigh(cov)
    # Eigenvalues have an error of about d ε times the largest; those below it count as zero.
    positive = values > 4 * len(cov) * EPS * values[-1]
    # P = A Aᵀ with the columns √λ v of A.
    columns = vectors[:, positive] * np.sqrt(values[positive])
    lower = np.zeros_like(cov)
    lower[:, : positive.sum()] = lower_root(columns)
    return lower


def lower_root(columns: Array) -> Array:
    """Return the lower triangular L with L Lᵀ = A Aᵀ, for columns A (..., d, k).

    L has d rows, and as many columns as the smaller of d and k. QR does not form A Aᵀ, so that
    rounding cannot make it indefinite. The sign of each column of L is arbitrary: the diagonal is
    made nonnegative, so that the result is the same on every machine.
    """
    # Aᵀ = Q R, so A Aᵀ = Rᵀ R.
    upper: Array = np.asarray(np.linalg.qr(columns.mT, mode="r"))
    diagonal = np.diagonal(upper, axis1=-2, axis2=-1)
    sign = np.where(diagonal < 0, -1.0, 1.0)
    return np.asarray(upper.mT * sign[..., None, :])


def broadcast_leading(
    first: tuple[int, ...], second: tuple[int, ...], name: str
) -> tuple[int, ...]:
    """Return the shape to which two shapes of leading axes, such as (runs, agents), broadcast.

    If they do not, raise an error; `name` is that of the argument with the second shape.
    """
    if first == second:
        return first
    try:
        return np.broadcast_shapes(first, second)
    except ValueError:
        raise ValueError(
            f"{name} must have leading axes that broadcast with {first}, got {second}"
        ) from None


def solve_lower(lower: Array, right: Array, *, transposed: bool = False) -> Array:
    """Solve L x = b, or Lᵀ x = b if `transposed`, for lower triangular L.

    Shapes are (..., d, d) and (..., d, k), where leading axes broadcast; the result's is that of
    the right-hand side.
    """
    d, k = right.shape[-2:]
    # One factor for all right-hand sides.
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
        # Some numpy calls for each of d rows, of all systems at once, are fewer than one call of
        # LAPACK for each of n systems.
        solution = _solve_in_blocks(factors, sides, transposed)
    else:
        solution = np.empty((n, d, k))
        for i in range(n):
            # The first of the two substitutes in numpy: faster for a small factor and many columns.
            if d <= _SMALL and k > _MANY_PER_ROW * d:
                solution[i] = _solve_one_factor(factors[i], sides[i], transposed)
            else:
                solution[i], failed = dtrtrs(
                    factors[i], sides[i], lower=1, trans=int(transposed)
                )
                if failed:
                    raise np.linalg.LinAlgError("Singular matrix")
    return solution.reshape(*leading, d, k)


def solve_definite(matrix: Array, right: Array) -> Array:
    """Solve with symmetric positive definite matrices, (..., m, m) and (..., m, k)."""
    m, k = right.shape[-2:]
    if matrix.size == m * m and right.size == m * k > 0:
        # LAPACK itself takes a third of numpy's time for one system.
        _factor, solution, failed = dposv(
            matrix.reshape(m, m), right.reshape(m, k), lower=1
        )
        if not failed:
            return np.asarray(solution.reshape(right.shape))
    elif _has_many_small_systems(matrix, right):
        # P = L Lᵀ, so P⁻¹ b = L⁻ᵀ L⁻¹ b. A matrix that is indefinite by rounding has no factor.
        with suppress(np.linalg.LinAlgError):
            lower = cholesky(matrix)
            half = solve_lower(lower, right)
            return solve_lower(lower, half, transposed=True)
    # LU decomposition, which needs no definite matrix.
    return np.asarray(np.linalg.solve(matrix, right))


def solve_semidefinite(matrix: Array, right: Array) -> Array:
    """Solve P X = B, (..., m, m) and (..., m, k), where components may be known constants.

    A component without variance has zero rows in P and in B, and gets zeros in X.

    >>> solve_semidefinite(np.diag([2.0, 0.0]), np.array([[4.0], [0.0]])).ravel()
    array([2., 0.])
    """
    is_known = np.diagonal(matrix, axis1=-2, axis2=-1) == 0
    if np.count_nonzero(is_known):
        # With a one on the diagonal its equation is x = 0.
        matrix = matrix + np.where(is_known[..., None], np.eye(matrix.shape[-1]), 0.0)
    return np.asarray(np.linalg.solve(matrix, right))


def _has_many_small_systems(matrix: Array, right: Array) -> bool:
    """Whether substitution in numpy is faster than a LAPACK call for each system (m, m)."""
    m = right.shape[-2]
    same_axes = matrix.shape[:-2] == right.shape[:-2]
    return m <= _SMALL and right.size > _MANY_IN_ALL * m and same_axes


def _solve_one_factor(lower: Array, right: Array, transposed: bool) -> Array:
    """Solve with one factor (d, d) for right-hand sides (..., d, k), as columns of one matrix.

    The factor is lower triangular; `transposed` solves with its transpose.
    """
    d, k = right.shape[-2:]
    if not right.size:
        return np.array(right)
    # All right-hand sides as columns of one matrix (d, n)
    is_matrix = right.size == d * k
    if is_matrix:
        columns = right.reshape(d, k)
    else:
        # The axis of d rows first, all others behind it
        columns = np.moveaxis(right, -2, 0).reshape(d, -1)
    if d <= _SMALL and columns.shape[1] > _MANY_PER_ROW * d:
        # With so many columns LAPACK's copy to its own order costs more than the solution, which is
        # found row after row by numpy: one factor (d, d, 1) for right-hand sides (d, 1, n).
        x = np.array(columns[:, None], order="C")
        solution = _substitute(lower[..., None], x, transposed)
    else:
        solution, failed = dtrtrs(lower, columns, lower=1, trans=int(transposed))
        if failed:
            raise np.linalg.LinAlgError("Singular matrix")
    # Back to the axes of the right-hand sides
    if is_matrix:
        return np.asarray(solution).reshape(right.shape)
    solution = solution.reshape(d, *right.shape[:-2], k)
    return np.moveaxis(solution, 0, -2)


def _solve_in_blocks(lower: Array, right: Array, transposed: bool) -> Array:
    """Solve many small systems (n, d, d) and (n, d, k), as many at once as the cache holds.

    The factors are lower triangular; `transposed` solves with their transposes.
    """
    solution = np.empty(right.shape)
    # One more than there are, so that empty systems do not lead to a division by zero.
    numbers_each = 1 + lower[0].size + right[0].size
    block = max(1, _BLOCK_SIZE // numbers_each)
    for start in range(0, len(solution), block):
        systems = slice(start, start + block)
        # Systems last, so that each row operation runs over contiguous memory.
        factors = np.ascontiguousarray(lower[systems].transpose(1, 2, 0))
        x = np.array(right[systems].transpose(1, 2, 0), order="C")
        solution[systems] = _substitute(factors, x, transposed).transpose(2, 0, 1)
    return solution


def _substitute(lower: Array, x: Array, transposed: bool) -> Array:
    """Solve n systems with factors (d, d, n), or one of all (d, d, 1), row after row.

    The right-hand sides `x` (d, k, n) are overwritten by the solutions, which are also returned.
    The factors are lower triangular; `transposed` solves with their transposes.
    """
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
    """Solve L z = v for vectors v (..., d) and factors L (..., d, d); leading axes broadcast.

    If v has the covariance L Lᵀ, the components of z are independent with unit variance.
    """
    if lower.ndim == 2:
        # One factor for all vectors: they are the columns of one right-hand side.
        n_vectors = math.prod(vectors.shape[:-1])
        rows = vectors.reshape(n_vectors, vectors.shape[-1])
        solution = _solve_one_factor(lower, rows.T, transposed=False)
        return solution.T.reshape(vectors.shape)
    if lower.shape[-3] == 1 and vectors.ndim > 1:
        # One factor for all vectors along the last leading axis.
        columns = vectors.swapaxes(-1, -2)
        white = solve_lower(lower[..., 0, :, :], columns)
        return white.swapaxes(-1, -2)
    white = solve_lower(lower, vectors[..., None])
    return np.asarray(white[..., 0])


def quadratic_form(lower: Array, vector: Array) -> Array:
    """Squared Mahalanobis length vᵀ P⁻¹ v of vectors (..., d), by the Cholesky factor of P."""
    # vᵀ P⁻¹ v = |L⁻¹ v|² for P = L Lᵀ
    return np.asarray((whiten(lower, vector) ** 2).sum(axis=-1))


def log_det(lower: Array) -> Array:
    """Logarithm of a covariance's determinant, (...), by its Cholesky factor L (..., d, d)."""
    # log det L Lᵀ = 2 Σ log L_ii
    diagonal = np.diagonal(lower, axis1=-2, axis2=-1)
    return np.asarray(2.0 * np.log(diagonal).sum(axis=-1))


def log_sum_exp(logs: Array) -> Array:
    """Logarithm of the sum of exponentials (..., 1), in a tenth of scipy's time; -inf if all are.

    >>> log_sum_exp(np.zeros(2)).round(4)
    array([0.6931])
    """
    # log Σ exp(l) = t + log Σ exp(l - t) with the largest l for t, so that nothing overflows. The
    # bound keeps -inf - (-inf), which is NaN, out of the differences.
    largest = np.maximum(logs.max(axis=-1, keepdims=True), -1e300)
    total = np.exp(logs - largest).sum(axis=-1, keepdims=True)
    if np.count_nonzero(total) == total.size:
        return np.asarray(largest + np.log(total))
    # The logarithm of a sum of zero is -inf, which is no reason for a warning.
    with np.errstate(divide="ignore"):
        return np.asarray(largest + np.log(total))


def deviations(cov: Array) -> Array:
    """Return the standard deviations (..., d) of covariances (..., d, d).

    >>> deviations(np.diag([4.0, 0.0]))
    array([2., 0.])
    """
    # A variance may be negative by rounding.
    variances = cov.diagonal(axis1=-2, axis2=-1)
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


class ScaledCovariance(NamedTuple):
    """Correlations P_ij / (s_i s_j) of covariances, (..., d, d), and the deviations s (..., d)."""

    correlation: Array
    deviation: Array


def to_unit_variances(cov: Array) -> ScaledCovariance:
    """Scale covariances (..., d, d) to unit variances.

    A constant, whose deviation is zero, is left as it is: its s is 1.
    """
    # A variance may be negative by rounding.
    std = np.sqrt(np.abs(np.diagonal(cov, axis1=-2, axis2=-1)))
    scale = np.where(std > 0, std, 1.0)
    correlation = cov / (scale[..., :, None] * scale[..., None, :])
    return ScaledCovariance(correlation, scale)
