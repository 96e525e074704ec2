"""One Gaussian: its density, and ensembles that are moved onto it."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ..doors import Array, Cov, door
from ..linalg import EPS, cholesky, leading, log_det, quadratic_form

__all__ = ["log_density", "recolour"]


@door
def log_density(
    x: Annotated[Array, "... d"], mean: Annotated[Array, "... d"], cov: Cov
) -> Array:
    r"""Logarithm of the Gaussian density, (...), relative to the volume in the state's units.

    .. math:: \log N(\mathbf x;\mathbf m,\mathbf P)=-\tfrac12\bigl(
        (\mathbf x-\mathbf m)^\top\mathbf P^{-1}(\mathbf x-\mathbf m)
        +\log\det\mathbf P+d\log2\pi\bigr)

    Parameters
    ----------
    x, mean : array_like, (..., d)
        Points and means.
    cov : array_like, (..., d, d)
        Covariances, positive definite. Leading axes of the three broadcast.

    Examples
    --------
    >>> log_density([[0.0], [2.0]], [0.0], [[4.0]]).round(6)
    array([-1.612086, -2.112086])
    """
    lead = leading(x.shape[:-1], mean.shape[:-1], "mean")
    leading(lead, cov.shape[:-2], "cov")
    lower, constant = cholesky(cov), x.shape[-1] * np.log(2 * np.pi)
    return np.asarray(-0.5 * (quadratic_form(lower, x - mean) + log_det(lower) + constant))


@door
def recolour(
    ensemble: Annotated[Array, "... N d"], mean: Annotated[Array, "... d"], cov: Cov
) -> Array:
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
    x = ensemble
    n, d = x.shape[-2:]
    if n <= d:
        raise ValueError(f"ensemble: needs more than {d} members for {d} components, got {n}")
    unit = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    scaled = x / unit[..., None, :]
    average = np.full(n, 1 / n)
    centre = average @ scaled
    scaled -= centre[..., None, :]
    q, r = np.linalg.qr(scaled)
    _refuse_flat(r, np.abs(centre))
    target = cholesky(cov / (unit[..., :, None] * unit[..., None, :])).mT
    u, _, vh = np.linalg.svd(target @ r.mT)
    turn = vh.mT @ (u.mT @ target)
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
    if (own <= 32 * r.shape[-1] * EPS * (length + centre)).any():
        raise ValueError("ensemble: needs components that are not constant and not combinations "
                         "of others, got a singular sample covariance")
