"""One Gaussian: its density, its update, points that stand for it, ensembles moved onto it."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np

from ..linalg import (
    EPS,
    cholesky,
    broadcast_leading,
    log_det,
    quadratic_form,
    solve_definite,
)
from ..validation import (
    ALLOW_NAN,
    Array,
    Mask,
    PositiveDefinite,
    PositiveSemidefinite,
    all_finite,
    validated,
)

__all__ = ["condition", "log_density", "match_moments", "unscented_points"]


@validated
def log_density(
    x: Annotated[Array, "... d"], mean: Annotated[Array, "... d"], cov: PositiveDefinite
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
    lead = broadcast_leading(x.shape[:-1], mean.shape[:-1], "mean")
    broadcast_leading(lead, cov.shape[:-2], "cov")
    lower = cholesky(cov)
    constant = x.shape[-1] * np.log(2 * np.pi)
    return np.asarray(
        -0.5 * (quadratic_form(lower, x - mean) + log_det(lower) + constant)
    )


@validated
def match_moments(
    ensemble: Annotated[Array, "... N d"],
    mean: Annotated[Array, "... d"],
    cov: PositiveDefinite,
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
    >>> match_moments([[0.0], [2.0]], [5.0], [[8.0]]).ravel()
    array([3., 7.])
    """
    n, d = ensemble.shape[-2:]
    if n <= d:
        raise ValueError(
            f"ensemble must have more than {d} members for {d} components, got {n}"
        )
    lead = broadcast_leading(ensemble.shape[:-2], mean.shape[:-1], "mean")
    broadcast_leading(lead, cov.shape[:-2], "cov")
    unit = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    scaled = ensemble / unit[..., None, :]
    average = np.full(n, 1 / n)
    centre = average @ scaled
    scaled -= centre[..., None, :]
    q, r = np.linalg.qr(scaled)
    length = np.sqrt((r**2).sum(axis=-2))
    own = np.abs(np.diagonal(r, axis1=-2, axis2=-1))
    # What a component has that those before it have not, against the rounding of the members.
    if (own <= 32 * d * EPS * (length + np.abs(centre))).any():
        raise ValueError(
            "ensemble must have components that are not constant and not combinations "
            "of others, got a singular sample covariance"
        )
    target = cholesky(cov / (unit[..., :, None] * unit[..., None, :])).mT
    u, _, vh = np.linalg.svd(target @ r.mT)
    turn = vh.mT @ (u.mT @ target)
    out = q @ (np.sqrt(n - 1) * turn)
    # Where the old spread is almost flat, Q is centred only to rounding over the flatness.
    out -= (average @ out)[..., None, :]
    out *= unit[..., None, :]
    return np.asarray(out + mean[..., None, :])


@validated
def condition(
    mean: Annotated[Array, "... d"],
    cov: PositiveSemidefinite,
    gap: Annotated[Array, "... m", ALLOW_NAN],
    H: Annotated[Array, "... m d"],
    R: Annotated[PositiveDefinite, "... m m"],
) -> tuple[Array, Array]:
    r"""Condition Gaussians on readings :math:`\mathbf y=\mathbf H\mathbf x+\text{noise}`.

    Parameters
    ----------
    mean, cov : array_like, (..., d) and (..., d, d)
        The Gaussians; the covariance may be singular.
    gap : array_like, (..., m)
        The innovation, :math:`\mathbf y` less its prediction: :math:`\mathbf H` times the mean, or
        what a curved sensor makes of it. NaN leaves that component out.
    H, R : array_like, (..., m, d) and (..., m, m)
        How a reading depends on the state, and its noise covariance.

    Returns
    -------
    mean, cov : ndarray, (..., d) and (..., d, d)
        The covariance in Joseph's form. All leading axes broadcast: one covariance serves any
        number of means as long as no single component of theirs is missing.

    Raises
    ------
    numpy.linalg.LinAlgError
        If an innovation covariance is singular in floating point.

    Examples
    --------
    >>> x, p = condition([0.0], [[1.0]], [2.0], [[1.0]], [[1.0]])
    >>> x, p
    (array([1.]), array([[0.5]]))
    """
    missing = None if all_finite(gap) else np.isnan(gap)
    if missing is not None:  # a row of H may be missing too
        H = np.where(missing[..., None], 0.0, H)
        gap = np.where(missing, 0.0, gap)
    cross, inner = innovation(cov, H, R, missing)
    gain = solve_definite(inner, cross).mT
    return mean + (gain @ gap[..., None])[..., 0], joseph(cov, gain, H, R)


def innovation(
    cov: Array, H: Array, R: Array, missing: Mask | None
) -> tuple[Array, Array]:
    """Covariance of a reading's prediction with the state, (..., m, d), and of the innovation.

    Components (..., m) that are missing have no gain, and a one on the innovations' diagonal: that
    takes them out of every sum exactly.
    """
    cross = H @ cov
    inner = cross @ np.ascontiguousarray(H.mT) + R
    if missing is not None and missing.any():
        gone = np.nonzero(np.broadcast_to(missing, inner.shape[:-1]))
        cross = np.broadcast_to(cross, (*inner.shape[:-1], cross.shape[-1])).copy()
        cross[gone] = inner[gone] = inner.mT[gone] = 0.0
        inner[(*gone, gone[-1])] = 1.0
    return cross, inner


def joseph(cov: Array, gain: Array, H: Array, R: Array) -> Array:
    """The covariance after an update with any gain, as a sum of squares: Joseph's form."""
    rest = np.eye(cov.shape[-1]) - gain @ H
    after = rest @ cov @ np.ascontiguousarray(rest.mT) + gain @ R @ gain.mT
    return np.asarray(0.5 * (after + after.mT))


@validated
def unscented_points(
    mean: Annotated[Array, "... d"],
    root: Annotated[Array, "... d d"],
    *,
    kappa: float = 0.0,
) -> tuple[Array, Array]:
    r"""The 2d + 1 unscented points of Gaussians and their weights, which sum to 1.

    The mean, then :math:`\mathbf m\pm\sqrt{d+\kappa}\,\mathbf s_i` with the columns of the square
    root, all plus first. Weighted sums over the points give the Gaussian's mean and covariance.
    With :math:`\kappa=0` the mean weighs nothing; with :math:`\kappa=3-d` fourth moments along
    each axis are a Gaussian's. Points scaled by :math:`\alpha` are those of
    :math:`\kappa'=\alpha^2(d+\kappa)-d`.

    Parameters
    ----------
    mean : array_like, (..., d)
    root : array_like, (..., d, d)
        S with :math:`\mathbf S\mathbf S^\top=\mathbf P`, such as a Cholesky factor.
    kappa : float
        Above -d.

    Returns
    -------
    points : ndarray, (..., 2d + 1, d)
    weights : ndarray, (2d + 1,)

    Examples
    --------
    >>> points, weights = unscented_points([1.0], [[2.0]], kappa=2.0)
    >>> points.round(3).ravel().tolist(), weights.round(3).tolist()
    ([1.0, 4.464, -2.464], [0.667, 0.167, 0.167])
    """
    d = mean.shape[-1]
    if d + kappa <= 0:
        raise ValueError(f"kappa must be above {-d}, got {kappa:g}")
    moves = math.sqrt(d + kappa) * root.mT
    moves = np.concatenate([0 * moves[..., :1, :], moves, -moves], axis=-2)
    weights = np.empty(2 * d + 1)
    weights[:] = 0.5 / (d + kappa)
    weights[0] = kappa / (d + kappa)
    return mean[..., None, :] + moves, weights
