"""Ensembles moved onto a Gaussian by optimal transport, and the barycentre of covariances."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, SolverError, array, count, covariance, number
from ..checks import weights as unit_weights
from ..linalg import _EPS, _cholesky, _symmetrise

__all__ = ["bures_barycentre", "recolour"]


def recolour(ensemble: ArrayLike, mean: ArrayLike, cov: ArrayLike) -> Array:
    r"""Move an ensemble affinely so that its sample mean and covariance are the given ones.

    .. math:: \mathbf x_i' = \mathbf m + \mathbf A(\mathbf x_i-\bar{\mathbf x}),\qquad
        \mathbf A = \mathbf S^{-\top}(\mathbf S^\top\mathbf P\mathbf S)^{1/2}\mathbf S^{-1},\qquad
        \hat{\mathbf C} = \mathbf S\mathbf S^\top

    A is the optimal transport between Gaussians: of all affine maps with this result it moves the
    members least, with each component measured by its new standard deviation.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members, more than d.
    mean : array_like, (..., d)
        The new mean.
    cov : array_like, (..., d, d)
        The new sample covariance, positive definite.

    Notes
    -----
    Anomalies in units of the new standard deviations are :math:`\mathbf Q\mathbf R`, so that
    :math:`\mathbf S=\mathbf R^\top/\sqrt{N-1}`; let :math:`\mathbf P=\mathbf K\mathbf K^\top` and
    :math:`\mathbf K^\top\mathbf S=\mathbf U\boldsymbol\Sigma\mathbf V^\top`. Then the new
    anomalies, :math:`\mathbf Q\mathbf R\mathbf A`, are
    :math:`\sqrt{N-1}\,\mathbf Q\mathbf V\mathbf U^\top\mathbf K^\top`: products of orthogonal
    matrices and one factor, in which the condition of either covariance does not appear.

    Examples
    --------
    >>> recolour([[0.0], [2.0]], [5.0], [[8.0]]).ravel()
    array([3., 7.])
    """
    x = array(ensemble, "ensemble", (..., "N", "d"))
    n, d = x.shape[-2:]
    if n <= d:
        raise ValueError(f"ensemble: needs more than {d} members for {d} components, got {n}")
    centre = array(mean, "mean", (*x.shape[:-2], d))
    return _recolour(x, centre, covariance(array(cov, "cov", (*x.shape[:-2], d, d)), "cov"))


def _recolour(x: Array, mean: Array, cov: Array) -> Array:
    """As the public one, for more members than components; it too refuses a flat ensemble."""
    n = x.shape[-2]
    unit = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    scaled = x / unit[..., None, :]
    average = np.full(n, 1 / n)
    centre = average @ scaled
    scaled -= centre[..., None, :]
    q, r = np.linalg.qr(scaled)
    _refuse_flat(r, np.abs(centre))
    target = _cholesky(cov / (unit[..., :, None] * unit[..., None, :])).swapaxes(-1, -2)
    u, _, vh = np.linalg.svd(target @ r.swapaxes(-1, -2))
    turn = vh.swapaxes(-1, -2) @ (u.swapaxes(-1, -2) @ target)
    out = q @ (np.sqrt(n - 1) * turn)
    # Where the old spread is almost flat, Q is centred only to rounding over the flatness.
    out -= (average @ out)[..., None, :]
    out *= unit[..., None, :]
    out += mean[..., None, :]
    return np.asarray(out)


def _refuse_flat(r: Array, centre: Array) -> None:
    """Refuse anomalies, by their triangular factor, that are combinations of one another."""
    length = np.sqrt((r**2).sum(axis=-2))
    own = np.abs(np.diagonal(r, axis1=-2, axis2=-1))
    # What a component has that those before it have not, against the rounding of the members.
    if (own <= 32 * r.shape[-1] * _EPS * (length + centre)).any():
        raise ValueError("ensemble: needs components that are not constant and not combinations "
                         "of others, got a singular sample covariance")


def bures_barycentre(
    covs: ArrayLike, weights: ArrayLike, *, tolerance: float = 1e-10, iterations: int = 500
) -> Array:
    r"""Covariance (..., d, d) of the Wasserstein barycentre of centred Gaussians.

    The solution of
    :math:`\mathbf S=\sum_b\omega_b(\mathbf S^{1/2}\mathbf P_b\mathbf S^{1/2})^{1/2}` by the fixed
    point

    .. math:: \mathbf S\leftarrow\mathbf S^{-1/2}\Bigl(\sum_b\omega_b
        (\mathbf S^{1/2}\mathbf P_b\mathbf S^{1/2})^{1/2}\Bigr)^2\mathbf S^{-1/2}.

    Parameters
    ----------
    covs : array_like, (..., S, d, d)
        Covariances, positive definite.
    weights : array_like, (..., S)
        Nonnegative, with sum 1. What stands at a source of weight 0 does not matter.
    tolerance : float
        Stop when the largest change of any run, relative to its largest entry, is below it.
    iterations : int
        At most this many.

    Raises
    ------
    SolverError
        If the change is not below `tolerance` after `iterations`.

    Notes
    -----
    P. C. Álvarez-Esteban, E. del Barrio, J. A. Cuesta-Albertos and C. Matrán, Journal of
    Mathematical Analysis and Applications 441 (2016) 744-762.

    Examples
    --------
    Standard deviations are averaged where the covariances commute:

    >>> bures_barycentre([[[1.0]], [[9.0]]], [0.5, 0.5]).round(9)
    array([[4.]])
    """
    p = array(covs, "covs", (..., "S", "d", "d"), finite=False)
    omega = unit_weights(array(weights, "weights", p.shape[:-2]), "weights")
    covariance(p[omega > 0], "covs")
    small = number(tolerance, "tolerance", above=0)
    return _bures_barycentre(p, omega, small, count(iterations, "iterations"))


def _bures_barycentre(covs: Array, weights: Array, tolerance: float, iterations: int) -> Array:
    share = weights[..., None, None]
    p = covs if (weights > 0).all() else np.where(share > 0, covs, np.eye(covs.shape[-1]))
    s = _symmetrise((share * p).sum(axis=-3))
    change = np.full(s.shape[:-2], np.inf)
    for _ in range(iterations):
        open_ = change >= tolerance
        root, inverse = _roots(s)
        wide = root[..., None, :, :]
        inner = (share * _roots(_symmetrise(wide @ p @ wide))[0]).sum(axis=-3)
        half = inverse @ inner
        new = _symmetrise(half @ half.swapaxes(-1, -2))
        moved = np.abs(new - s).max(axis=(-2, -1)) / np.abs(s).max(axis=(-2, -1))
        # What is settled stays: the others' need for more steps must not move it.
        s = np.where(open_[..., None, None], new, s)
        change = np.where(open_, moved, change)
        if (change < tolerance).all():
            return s
    raise SolverError(
        f"bures_barycentre: relative change {change.max():.3g} after {iterations} iterations, "
        f"needs less than {tolerance:g}"
    )


def _roots(cov: Array) -> tuple[Array, Array]:
    """Symmetric square root of a positive semidefinite matrix, and the root's inverse."""
    values, vectors = np.linalg.eigh(cov)
    roots = np.sqrt(np.maximum(values, _EPS**2 * values[..., -1:]))[..., None, :]
    turned = vectors.swapaxes(-1, -2)
    return np.asarray((vectors * roots) @ turned), np.asarray((vectors / roots) @ turned)
