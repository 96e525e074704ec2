"""Batched linear algebra on covariances: Cholesky factors and triangular solves, no inverse.

Functions without a door serve loops: they take float64 arrays that fit, and Cholesky factors in
place of covariances.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtrs

from .doors import Array, NonNegative, Semidefinite, door, unchecked

__all__ = ["SolverError", "factor"]

EPS = float(np.finfo(np.float64).eps)
_STEP = 6e-6
"""Of differences: about the cube root of EPS, where truncation and rounding balance."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
_POWERS = (0.5 * (_NODES + 1))[:, None] ** np.arange(21)
"""Powers 0 to 20 of the Gauss-Legendre points of [0, 1]."""


class SolverError(RuntimeError):
    """A solver stopped without a solution; the message names it, its status and the problem."""


def symmetrise(m: Array) -> Array:
    """Average of a square matrix and its transpose, where a product loses symmetry by rounding."""
    return np.asarray(0.5 * (m + m.swapaxes(-1, -2)))


@door
def factor(cov: Semidefinite) -> Array:
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
    if cov.ndim == 2 and cov.size:
        lower, failed = dpotrf(cov, lower=1, clean=1)  # a fifth of numpy's time for one matrix
        if failed:
            raise np.linalg.LinAlgError("Matrix is not positive definite")
        return np.asarray(lower)
    return np.asarray(np.linalg.cholesky(cov))


def _semidefinite_cholesky(cov: Array) -> Array:
    """The lower triangular factor with a zero column where a pivot vanishes."""
    d = cov.shape[-1]
    std = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    unit = np.where(std > 0, std, 1.0)
    scaled = cov / (unit[..., :, None] * unit[..., None, :])
    lower = np.zeros_like(scaled)
    for j in range(d):
        done = lower[..., j:, :j] @ lower[..., j, :j, None]
        column = scaled[..., j:, j] - done[..., 0]
        pivot = column[..., 0]
        root = np.sqrt(np.where(pivot > 16 * d * EPS, pivot, np.inf))
        lower[..., j:, j] = column / root[..., None]
    gap = np.abs(lower @ lower.swapaxes(-1, -2) - scaled).max(axis=(-2, -1), initial=0.0)
    for k in np.argwhere(gap > 32 * d * EPS):
        lower[tuple(k)] = _from_eigenvectors(scaled[tuple(k)])
    return np.asarray(lower * unit[..., :, None])


def _from_eigenvectors(cov: Array) -> Array:
    """The lower triangular factor of one matrix by orthogonal steps, which lose nothing."""
    values, vectors = np.linalg.eigh(cov)
    kept = values > 4 * len(cov) * EPS * values[-1]
    root = vectors[:, kept] * np.sqrt(values[kept])
    upper: Array = np.asarray(np.linalg.qr(root.T, mode="r"))
    lower = np.zeros_like(cov)
    lower[:, : len(upper)] = (upper * np.where(np.diagonal(upper) < 0, -1.0, 1.0)[:, None]).T
    return lower


def leading(wanted: tuple[int, ...], got: tuple[int, ...], name: str) -> tuple[int, ...]:
    """What leading axes broadcast to, or an error that names the argument that does not fit."""
    try:
        return np.broadcast_shapes(wanted, got)
    except ValueError:
        raise ValueError(
            f"{name}: needs leading axes that broadcast with {wanted}, got {got}"
        ) from None


def solve_lower(lower: Array, right: Array) -> Array:
    r"""Solve L out = right, (..., d, d) and (..., d, k); leading axes broadcast."""
    return _triangular(lower, right, 0)


def solve_upper(lower: Array, right: Array) -> Array:
    r"""Solve Lᵀ out = right with the *lower* triangular factor."""
    return _triangular(lower, right, 1)


def _triangular(lower: Array, right: Array, transposed: int) -> Array:
    if lower.ndim == 2:
        return _one_triangular(lower, right, transposed)
    d, k = right.shape[-2:]
    leading = lower.shape[:-2]
    if leading != right.shape[:-2]:
        leading = np.broadcast_shapes(leading, right.shape[:-2])
        lower = np.broadcast_to(lower, (*leading, d, d))
        right = np.broadcast_to(right, (*leading, d, k))
    n = math.prod(leading)
    factors, columns = lower.reshape(n, d, d), right.reshape(n, d, k)
    if len(factors) > 2 * d:
        # Many small systems: row after row of all of them at once beats a call for each.
        out = _substitute(factors, columns, transposed)
    else:
        out = np.empty((len(factors), d, k))
        for i, (one, b) in enumerate(zip(factors, columns, strict=True)):
            out[i] = _one_triangular(one, b, transposed)
    return out.reshape(*leading, d, k)


def _one_triangular(lower: Array, right: Array, transposed: int) -> Array:
    """One factor; all of `right` (..., d, k) are its columns."""
    d, k = right.shape[-2:]
    if not right.size:
        return np.array(right)
    alone = right.size == d * k
    flat = right.reshape(d, k) if alone else np.moveaxis(right, -2, 0).reshape(d, -1)
    out, failed = dtrtrs(lower, flat, lower=1, trans=transposed)
    if failed:
        raise np.linalg.LinAlgError("Singular matrix")
    if alone:
        return np.asarray(out).reshape(right.shape)
    return np.moveaxis(out.reshape(d, *right.shape[:-2], right.shape[-1]), 0, -2)


def _substitute(lower: Array, right: Array, transposed: int) -> Array:
    if transposed:
        turned = lower.swapaxes(-1, -2)[:, ::-1, ::-1]
        return _substitute(turned, right[:, ::-1], 0)[:, ::-1]
    out = np.array(right)
    for i in range(out.shape[-2]):
        if i:
            out[:, i] -= (lower[:, i : i + 1, :i] @ out[:, :i])[:, 0]
        out[:, i] /= lower[:, i, i, None]
    return out


def whiten(lower: Array, vectors: Array) -> Array:
    """Solve L out = v for vectors (..., d); leading axes broadcast."""
    if lower.ndim == 2:
        flat = vectors.reshape(math.prod(vectors.shape[:-1]), -1 if vectors.size else len(lower))
        return _one_triangular(lower, flat.T, 0).T.reshape(vectors.shape)
    if lower.shape[-3] == 1 and vectors.ndim > 1:
        # One factor for all vectors along the last leading axis: they are its columns.
        return _triangular(lower[..., 0, :, :], vectors.swapaxes(-1, -2), 0).swapaxes(-1, -2)
    return np.asarray(_triangular(lower, vectors[..., None], 0)[..., 0])


def quadratic_form(lower: Array, vector: Array) -> Array:
    """Squared Mahalanobis length of vectors (..., d), by the covariance's Cholesky factor."""
    return np.asarray((whiten(lower, vector) ** 2).sum(axis=-1))


def log_det(lower: Array) -> Array:
    """Logarithm of a covariance's determinant, by its Cholesky factor."""
    return np.asarray(2.0 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1))


@door
def van_loan(
    drift: Annotated[Array, "d d"], diffusion: Annotated[Semidefinite, "d d"], dt: NonNegative
) -> tuple[Array, Array]:
    r"""Exact discretisation of :math:`\dot{\mathbf x} = \mathbf A\mathbf x + \text{white noise}`.

    Parameters
    ----------
    drift : array_like, (d, d)
        The matrix A, in 1/s. Slow and fast modes may stand side by side.
    diffusion : array_like, (d, d)
        The noise's spectral density :math:`\mathbf Q_c`, in units of the state squared per s.
    dt : float
        The step, in s, at least 0.

    Returns
    -------
    transition : ndarray, (d, d)
        :math:`\mathbf\Phi = e^{\mathbf A\,dt}`.
    noise : ndarray, (d, d)
        :math:`\mathbf Q = \int_0^{dt} e^{\mathbf A s}\mathbf Q_c e^{\mathbf A^\top s}\,ds`,
        symmetric positive semidefinite.

    Raises
    ------
    ValueError
        If the arguments do not fit, or the step is so long that the transition overflows.

    Notes
    -----
    The pair that C. F. Van Loan, IEEE Transactions on Automatic Control 23 (1978) 395-404, reads
    off one exponential of twice the size. That exponential holds :math:`e^{-\mathbf A\,dt}`, and is
    useless for a fast decay. So the step is halved until :math:`\lVert\mathbf A\rVert_1h\le1`,
    where a Taylor sum gives the exponential and ten Gauss-Legendre points the integral, and both
    are doubled back:

    .. math:: \mathbf Q_{2h}=\mathbf Q_h+\mathbf\Phi_h\mathbf Q_h\mathbf\Phi_h^\top,\qquad
        \mathbf\Phi_{2h}=\mathbf\Phi_h^2.

    Only positive semidefinite matrices are added up: nothing cancels.

    Examples
    --------
    >>> phi, q = van_loan([[0.0, 1.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]], 2.0)
    >>> phi.round(9)
    array([[1., 2.],
           [0., 1.]])
    >>> q.round(6)
    array([[2.666667, 2.      ],
           [2.      , 2.      ]])
    """
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        size = np.abs(drift).sum(axis=0).max() * dt
        halvings = max(0, int(np.ceil(np.log2(max(size, 1.0))))) if np.isfinite(size) else 0
        h = dt * 0.5**halvings
        phi, q = _short_step(drift * dt * 0.5**halvings, unchecked(factor)(diffusion), h)
        for _ in range(halvings):
            q = symmetrise(q + phi @ q @ phi.T)
            phi = phi @ phi
    if not (np.isfinite(phi).all() and np.isfinite(q).all()):
        raise ValueError(f"dt: needs a step over which the transition is finite, got {dt:g}")
    return phi, q


def _short_step(a: Array, root: Array, h: float) -> tuple[Array, Array]:
    """Transition and noise over a step h with a = A h of norm at most 1."""
    terms = [np.eye(len(a))]
    for k in range(1, _POWERS.shape[1]):  # the first one left out, 1/21!, is below rounding
        terms.append(terms[-1] @ a / k)
    taylor = np.array(terms)
    # One factor of the noise beside the other, (d, 10 d): the integral is its product with itself.
    wide = np.tensordot(_POWERS, taylor, axes=1) @ root
    wide *= np.sqrt(0.5 * h * _WEIGHTS)[:, None, None]
    flat = wide.transpose(1, 0, 2).reshape(len(a), -1)
    return taylor.sum(axis=0), symmetrise(flat @ flat.T)


def central(
    function: Callable[[Array], Array], x: Array,
    difference: Callable[[Array, Array], Array] = np.subtract
) -> Array:
    """Derivative (..., m, d) by central differences, all 2 d moves in two calls.

    Its error is about 1e-10 of the function's scale.

    Parameters
    ----------
    function : callable
        ``function(x) -> y`` on (..., d) to (..., m).
    x : ndarray, (..., d)
        Where.
    difference : callable
        ``difference(ahead, behind)``, for values that wrap; subtraction by default.

    Examples
    --------
    >>> central(lambda x: x**2, np.array([1.0, 3.0])).round(8)
    array([[2., 0.],
           [0., 6.]])
    """
    h = _STEP * np.maximum(1.0, np.abs(x))
    ahead = x[..., None, :] + h[..., None] * np.eye(x.shape[-1])
    behind = x[..., None, :] - h[..., None] * np.eye(x.shape[-1])
    # What was moved by, after rounding, is the difference of the two states.
    moved = np.diagonal(ahead - behind, axis1=-2, axis2=-1)
    slope = difference(function(ahead), function(behind)) / moved[..., None]
    return np.asarray(np.swapaxes(slope, -1, -2))
