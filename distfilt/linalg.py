"""Batched linear algebra on covariances: Cholesky factors and solves, never an inverse."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .checks import Array, array, covariance, number

__all__ = ["cholesky_solve", "factor", "log_det", "quadratic_form", "symmetrise", "van_loan"]


def symmetrise(matrix: ArrayLike) -> Array:
    """Average of a square matrix and its transpose, (..., d, d).

    Called once, where a product loses symmetry by rounding.

    Examples
    --------
    >>> symmetrise([[1.0, 0.4], [0.2, 1.0]])
    array([[1. , 0.3],
           [0.3, 1. ]])
    """
    m = array(matrix, "matrix", (..., "d", "d"))
    if m.shape[-1] != m.shape[-2]:
        raise ValueError(f"matrix: needs a square matrix, got shape {m.shape}")
    return 0.5 * (m + np.swapaxes(m, -1, -2))


def factor(cov: ArrayLike, *, name: str = "cov") -> Array:
    r"""A matrix :math:`\mathbf L` with :math:`\mathbf L\mathbf L^\top` = `cov`, singular or not.

    Parameters
    ----------
    cov : array_like, (..., d, d)
        Symmetric positive semidefinite.
    name : str
        What an error calls the argument.

    Returns
    -------
    ndarray, (..., d, d)
        Lower triangular: the Cholesky factor, with zero columns where a matrix is singular.

    Raises
    ------
    ValueError
        If a matrix is not symmetric or has a negative eigenvalue.

    Examples
    --------
    >>> L = factor([[4.0, 0.0], [0.0, 0.0]])
    >>> L @ L.T
    array([[4., 0.],
           [0., 0.]])
    """
    c = array(cov, name, (..., "d", "d"))
    try:
        return np.asarray(np.linalg.cholesky(covariance(c, name)), dtype=np.float64)
    except ValueError:
        return _semidefinite_cholesky(covariance(c, name, semidefinite=True))


def _semidefinite_cholesky(cov: Array) -> Array:
    """The lower triangular factor with a zero column where a pivot vanishes.

    Unlike a factor from eigenvectors it is unique, so that draws do not depend on the machine.
    """
    d = cov.shape[-1]
    lower = np.zeros_like(cov)
    smallest = d * np.finfo(float).eps * np.diagonal(cov, axis1=-2, axis2=-1).max(axis=-1)
    for j in range(d):
        done = lower[..., j:, :j] @ lower[..., j, :j, None]
        column = cov[..., j:, j] - done[..., 0]
        pivot = column[..., 0]
        root = np.sqrt(np.where(pivot > smallest, pivot, np.inf))
        lower[..., j:, j] = column / root[..., None]
    return lower


def cholesky_solve(cov: ArrayLike, right: ArrayLike) -> Array:
    """Solve ``cov @ out = right`` for a positive definite `cov` by its Cholesky factor.

    Parameters
    ----------
    cov : array_like, (..., d, d)
        Symmetric positive definite.
    right : array_like, (..., d, k)
        Right-hand sides, as columns.

    Returns
    -------
    ndarray, (..., d, k)

    Raises
    ------
    ValueError
        If `cov` is not symmetric positive definite or the sizes differ.

    Examples
    --------
    >>> cholesky_solve([[4.0, 0.0], [0.0, 2.0]], [[8.0], [1.0]]).ravel()
    array([2. , 0.5])
    """
    c = covariance(cov, "cov")
    b = array(right, "right", (..., c.shape[-1], "k"))
    lower = np.linalg.cholesky(c)
    # numpy has no batched triangular solve; two general solves with a triangular matrix cost the
    # same order and pivot trivially.
    half = np.linalg.solve(lower, b)
    return np.linalg.solve(np.swapaxes(lower, -1, -2), half)


def quadratic_form(cov: ArrayLike, vector: ArrayLike) -> Array:
    r"""Squared Mahalanobis length :math:`\mathbf v^\top \mathbf P^{-1} \mathbf v`.

    Parameters
    ----------
    cov : array_like, (..., d, d)
        Symmetric positive definite.
    vector : array_like, (..., d)

    Returns
    -------
    ndarray, (...)

    Examples
    --------
    >>> float(quadratic_form([[4.0]], [6.0]))
    9.0
    """
    c = covariance(cov, "cov")
    v = array(vector, "vector", (..., c.shape[-1]))
    half = np.linalg.solve(np.linalg.cholesky(c), v[..., None])[..., 0]
    return np.asarray((half**2).sum(axis=-1))


def log_det(cov: ArrayLike) -> Array:
    """Logarithm of the determinant of a positive definite matrix, (...).

    Examples
    --------
    >>> round(float(log_det([[2.0, 0.0], [0.0, 3.0]])), 6)
    1.791759
    """
    lower = np.linalg.cholesky(covariance(cov, "cov"))
    return np.asarray(2.0 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1))


def van_loan(drift: ArrayLike, diffusion: ArrayLike, dt: float) -> tuple[Array, Array]:
    r"""Exact discretisation of :math:`\dot{\mathbf x} = \mathbf A\mathbf x + \text{white noise}`.

    Parameters
    ----------
    drift : array_like, (d, d)
        The matrix A, in 1/s.
    diffusion : array_like, (d, d)
        The noise's spectral density :math:`\mathbf Q_c`, in units of the state squared per s.
    dt : float
        The step, in s, at least 0.

    Returns
    -------
    transition : ndarray, (d, d)
        :math:`\mathbf\Phi = e^{\mathbf A\,dt}`.
    noise : ndarray, (d, d)
        :math:`\mathbf Q = \int_0^{dt} e^{\mathbf A s}\mathbf Q_c e^{\mathbf A^\top s}\,ds`.

    Notes
    -----
    Both come from one matrix exponential of twice the size, C. F. Van Loan, IEEE Transactions on
    Automatic Control 23 (1978) 395-404.

    Examples
    --------
    >>> phi, q = van_loan([[0.0, 1.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 1.0]], 2.0)
    >>> phi
    array([[1., 2.],
           [0., 1.]])
    >>> q.round(6)
    array([[2.666667, 2.      ],
           [2.      , 2.      ]])
    """
    from scipy.linalg import expm

    a = array(drift, "drift", ("d", "d"))
    if a.shape[0] != a.shape[1]:
        raise ValueError(f"drift: needs a square matrix, got shape {a.shape}")
    d = a.shape[0]
    qc = covariance(diffusion, "diffusion", d, semidefinite=True)
    step = number(dt, "dt", at_least=0)
    big = np.zeros((2 * d, 2 * d))
    big[:d, :d], big[:d, d:], big[d:, d:] = -a, qc, a.T
    e = expm(big * step)
    phi = e[d:, d:].T
    return phi, symmetrise(phi @ e[:d, d:])
