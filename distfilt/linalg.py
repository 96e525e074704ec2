"""Batched linear algebra on covariances: Cholesky factors and triangular solves, no inverse.

Functions without a door serve loops: they take float64 arrays that fit, and Cholesky factors in
place of covariances.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
from scipy.linalg.lapack import dposv, dpotrf, dtrtrs

from .validation import Array, PositiveSemidefinite, validated
from .validation.first_use import is_first_use

__all__ = ["SolverError", "factor"]

EPS = float(np.finfo(np.float64).eps)
_STEP = 6e-6
"""Of differences: about the cube root of EPS, where truncation and rounding balance."""


class SolverError(RuntimeError):
    """A solver stopped without a solution; the message names it, its status and the problem."""


def symmetrise(m: Array) -> Array:
    """Average of a square matrix and its transpose, where a product loses symmetry by rounding."""
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
    """The lower Cholesky factor; LinAlgError if a matrix is not positive definite."""
    d = cov.shape[-1]
    if cov.size == d * d > 0:
        # A fifth of numpy's time for one matrix.
        lower, failed = dpotrf(cov.reshape(d, d), lower=1, clean=1)
        if failed:
            raise np.linalg.LinAlgError("Matrix is not positive definite")
        return np.asarray(lower.reshape(cov.shape))
    return np.asarray(np.linalg.cholesky(cov))


def _semidefinite_cholesky(cov: Array) -> Array:
    """The lower triangular factor with a zero column where a pivot vanishes."""
    d = cov.shape[-1]
    scaled, unit = in_units(cov)
    lower = np.zeros_like(scaled)
    for j in range(d):
        done = lower[..., j:, :j] @ lower[..., j, :j, None]
        column = scaled[..., j:, j] - done[..., 0]
        pivot = column[..., 0]
        root = np.sqrt(np.where(pivot > 16 * d * EPS, pivot, np.inf))
        lower[..., j:, j] = column / root[..., None]
    gap = np.abs(lower @ lower.swapaxes(-1, -2) - scaled).max(
        axis=(-2, -1), initial=0.0
    )
    for k in np.argwhere(gap > 32 * d * EPS):
        lower[tuple(k)] = _from_eigenvectors(scaled[tuple(k)])
    return np.asarray(lower * unit[..., :, None])


def _from_eigenvectors(cov: Array) -> Array:
    """The lower triangular factor of one matrix by orthogonal steps, which lose nothing."""
    values, vectors = np.linalg.eigh(cov)
    kept = values > 4 * len(cov) * EPS * values[-1]
    lower = np.zeros_like(cov)
    lower[:, : kept.sum()] = lower_root(vectors[:, kept] * np.sqrt(values[kept]))
    return lower


def lower_root(columns: Array) -> Array:
    """Lower triangular L with L L' = A A' for A of these columns, and a nonnegative diagonal.

    By QR, which leaves no signs or rotations to the machine and loses no definiteness.
    """
    upper: Array = np.asarray(np.linalg.qr(columns.mT, mode="r"))
    sign = np.where(np.diagonal(upper, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    return np.asarray(upper.mT * sign[..., None, :])


def leading(
    wanted: tuple[int, ...], got: tuple[int, ...], name: str
) -> tuple[int, ...]:
    """What leading axes broadcast to, or an error that names the argument that does not fit."""
    if wanted == got:
        return wanted
    try:
        return np.broadcast_shapes(wanted, got)
    except ValueError:
        raise ValueError(
            f"{name} must have leading axes that broadcast with {wanted}, got {got}"
        ) from None


def solve_lower(lower: Array, right: Array) -> Array:
    r"""Solve L out = right, (..., d, d) and (..., d, k); leading axes broadcast."""
    return _triangular(lower, right, 0)


def solve_upper(lower: Array, right: Array) -> Array:
    r"""Solve Lᵀ out = right with the *lower* triangular factor."""
    return _triangular(lower, right, 1)


def solve_definite(matrix: Array, right: Array) -> Array:
    """Solve with symmetric positive definite matrices, (..., m, m) and (..., m, k)."""
    m, k = right.shape[-2:]
    if matrix.size == m * m and right.size == m * k > 0:
        # A third of numpy's time for one system.
        _, out, failed = dposv(matrix.reshape(m, m), right.reshape(m, k), lower=1)
        if not failed:
            return np.asarray(out.reshape(right.shape))
    elif m <= 12 and right.size > 600 * m and matrix.shape[:-2] == right.shape[:-2]:
        with suppress(np.linalg.LinAlgError):  # by rounding one may be indefinite
            return solve_upper(lower := cholesky(matrix), solve_lower(lower, right))
    return np.asarray(np.linalg.solve(matrix, right))


def _triangular(lower: Array, right: Array, transposed: int) -> Array:
    d, k = right.shape[-2:]
    if lower.size == d * d and lower.ndim <= right.ndim:
        return _one_triangular(lower.reshape(d, d), right, transposed)
    leading = lower.shape[:-2]
    if leading != right.shape[:-2]:
        leading = np.broadcast_shapes(leading, right.shape[:-2])
        lower = np.broadcast_to(lower, (*leading, d, d))
        right = np.broadcast_to(right, (*leading, d, k))
    n = math.prod(leading)
    factors = lower.reshape(n, d, d)
    sides = right.reshape(n, d, k)
    if n > 2 * d:
        # Row after row of all of them at once beats a call for each.
        out = _blocks(factors, sides, transposed)
    else:
        out = np.array(
            [_one_triangular(*x, transposed) for x in zip(factors, sides, strict=True)]
        )
    return out.reshape(*leading, d, k)


def _one_triangular(lower: Array, right: Array, transposed: int) -> Array:
    """One factor; all of `right` (..., d, k) are its columns."""
    d, k = right.shape[-2:]
    if not right.size:
        return np.array(right)
    alone = right.size == d * k
    flat = right.reshape(d, k) if alone else np.moveaxis(right, -2, 0).reshape(d, -1)
    if (
        d <= 12 and flat.size > 200 * d * d
    ):  # so many columns that LAPACK's own order costs more
        out = _substituted(
            lower[..., None], np.array(flat[:, None], order="C"), transposed
        )
    else:
        out, failed = dtrtrs(lower, flat, lower=1, trans=transposed)
        if failed:
            raise np.linalg.LinAlgError("Singular matrix")
    if alone:
        return np.asarray(out).reshape(right.shape)
    return np.moveaxis(out.reshape(d, *right.shape[:-2], right.shape[-1]), 0, -2)


def _blocks(lower: Array, right: Array, transposed: int) -> Array:
    """Many small systems, as many at once as a cache holds."""
    out = np.empty(right.shape)
    size = max(1, 2**16 // (1 + lower[0].size + right[0].size))
    for here in [slice(n, n + size) for n in range(0, len(out), size)]:
        factors = np.ascontiguousarray(lower[here].transpose(1, 2, 0))
        x = np.array(right[here].transpose(1, 2, 0), order="C")
        out[here] = _substituted(factors, x, transposed).transpose(2, 0, 1)
    return out


def _substituted(lower: Array, x: Array, transposed: int) -> Array:
    """Solve in place, row after row of (d, k, n), with factors (d, d, n) or (d, d, 1)."""
    for i in reversed(range(len(x))) if transposed else range(len(x)):
        x[i] /= lower[i, i]
        rest = slice(0, i) if transposed else slice(i + 1, None)
        x[rest] -= (lower[i, rest] if transposed else lower[rest, i])[:, None] * x[i]
    return x


def whiten(lower: Array, vectors: Array) -> Array:
    """Solve L out = v for vectors (..., d); leading axes broadcast."""
    if lower.ndim == 2:
        flat = vectors.reshape(
            math.prod(vectors.shape[:-1]), -1 if vectors.size else len(lower)
        )
        return _one_triangular(lower, flat.T, 0).T.reshape(vectors.shape)
    if lower.shape[-3] == 1 and vectors.ndim > 1:
        # One factor for all vectors along the last leading axis: they are its columns.
        return _triangular(lower[..., 0, :, :], vectors.swapaxes(-1, -2), 0).swapaxes(
            -1, -2
        )
    return np.asarray(_triangular(lower, vectors[..., None], 0)[..., 0])


def quadratic_form(lower: Array, vector: Array) -> Array:
    """Squared Mahalanobis length of vectors (..., d), by the covariance's Cholesky factor."""
    return np.asarray((whiten(lower, vector) ** 2).sum(axis=-1))


def log_det(lower: Array) -> Array:
    """Logarithm of a covariance's determinant, by its Cholesky factor."""
    return np.asarray(2.0 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1))


def log_sum(logs: Array) -> Array:
    """Logarithm of the sum of exponentials (..., 1), in a tenth of scipy's time; -inf if all are.

    >>> log_sum(np.zeros(2)).round(4)
    array([0.6931])
    """
    top = np.maximum(logs.max(axis=-1, keepdims=True), -1e300)
    with np.errstate(divide="ignore"):
        return np.asarray(top + np.log(np.exp(logs - top).sum(axis=-1, keepdims=True)))


def in_units(cov: Array) -> tuple[Array, Array]:
    """Covariances in units of the components' standard deviations, and these; 1 of a constant."""
    std = np.sqrt(np.abs(np.diagonal(cov, axis1=-2, axis2=-1)))
    unit = np.where(std > 0, std, 1.0)
    return cov / (unit[..., :, None] * unit[..., None, :]), unit


def central(
    function: Callable[[Array], Array],
    x: Array,
    difference: Callable[[Array, Array], Array] = np.subtract,
    *,
    step: float = _STEP,
) -> Array:
    """Derivative (..., m, d) by central differences, all 2 d moves in two calls.

    Its error is about 1e-10 of the function's scale. Where the values ahead and behind do not lie
    on a line with the one between, moves a hundred times as small are tried, and again.

    Parameters
    ----------
    function : callable
        ``function(x) -> y`` on (..., d) to (..., m).
    x : ndarray, (..., d)
        Where.
    difference : callable
        ``difference(ahead, behind)``, for values that wrap; subtraction by default.
    step : float
        How far each component moves, as a share of it where it is above 1.

    Examples
    --------
    >>> central(lambda x: x**2, np.array([1.0, 3.0])).round(8)
    array([[2., 0.],
           [0., 6.]])
    """
    h = step * np.maximum(1.0, np.abs(x))
    ahead = x[..., None, :] + h[..., None] * np.eye(x.shape[-1])
    behind = x[..., None, :] - h[..., None] * np.eye(x.shape[-1])
    # What was moved by, after rounding, is the difference of the two states.
    moved = np.diagonal(ahead - behind, axis1=-2, axis2=-1)
    front = function(ahead)
    back = function(behind)
    here = function(x[..., None, :])
    slope = difference(front, back)
    bend = np.abs(difference(front, here) + difference(back, here)).max(axis=-1)
    curved = bend > 1e-2 * np.abs(slope).max(axis=-1) + 1e-9 * np.abs(here).max(axis=-1)
    slope = slope / moved[..., None]
    if step > 1e-10 and curved.any():
        finer = central(function, x, difference, step=1e-2 * step)
        slope = np.where(curved[..., None], finer.mT, slope)
    return np.asarray(slope.mT)


def as_derivative(
    owner: Any,
    given: tuple[Any, ...],
    full: tuple[int, ...],
    near: Callable[..., Array],
    still: Array | float = 0.0,
) -> Array:
    """What an owner's `derivative` returns, (m, d) or (..., m, d), as the latter; differences
    where it has none.

    The first time it is compared with differences: a transposed one may have the right shape too.
    Rows may be a tenth of their largest entry off, and lack what hardly matters beside others.

    Parameters
    ----------
    owner : FrozenModel
        Whose derivative it is; what the library made itself is trusted.
    given, full : tuple
        What it gets, arrays as copies, and the shape that it needs.
    near : callable
        ``near(step=step)`` by :func:`central`. Rows that depend on the step say nothing.
    still : ndarray, optional
        The derivative of a state that stays, which is no merit of a model's.
    """
    if owner.derivative is None:
        return near()
    slope = np.asarray(
        owner.derivative(*[np.copy(x) if np.ndim(x) else x for x in given])
    )
    if slope.shape not in (full, full[-2:]):
        raise ValueError(f"derivative must return shape {full}, got {slope.shape}")
    if is_first_use(owner, "derivative"):
        found = near(step=_STEP)
        wide = near(step=4 * _STEP)
        row = np.abs(found - still).max(axis=-1, keepdims=True)
        sure = np.abs(found - wide).max(axis=-1, keepdims=True) <= 1e-2 * row
        bound = 0.1 * row + 1e-4 * row.max(axis=-2, keepdims=True)
        if (sure & (np.abs(slope - found) > bound)).any():
            warnings.warn(
                "derivative must be that of its function, got another",
                RuntimeWarning,
                4,
            )
    return np.broadcast_to(slope, full)
