"""Ensembles: arrays (..., N, d) whose rows are members, their moments and how to draw them."""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache, partial
from typing import Annotated

import numpy as np

from .linalg import EPS, cholesky, factor, lower_root, solve_upper, symmetrise
from .validation import (
    Array,
    PositiveInt,
    PositiveSemidefinite,
    Rng,
    validated,
)

__all__ = ["Members", "draw", "mean", "sample_covariance"]


def _at_least(members: int, value: Array, name: str) -> None:
    if value.shape[-2] < members:
        raise ValueError(
            f"{name} must have at least {members} members, got {value.shape[-2]}"
        )


Members = Annotated[Array, "... N d", partial(_at_least, 1)]
"""The kind of what has members."""
Ensemble = Annotated[Array, "... N d", partial(_at_least, 2)]
"""The kind of what has a sample covariance."""

# The share of a unit column beside others up to which singular values say if it is one more.
_CLOSE = 1e-6


@validated
def draw(
    mean: Annotated[Array, "d"],
    cov: Annotated[PositiveSemidefinite, "d d"],
    members: PositiveInt,
    *,
    rng: Rng,
    leading: tuple[PositiveInt, ...] = (),
) -> Array:
    """Draw ensembles (*leading, N, d) from a Gaussian.

    Parameters
    ----------
    mean : array_like, (d,)
        The mean.
    cov : array_like, (d, d)
        The covariance, positive semidefinite.
    members : int
        Number N of members.
    rng : numpy.random.Generator
        Source of the draw.
    leading : tuple of int
        Leading axes, such as (runs, agents); every ensemble is drawn independently.

    Examples
    --------
    >>> draw([0.0, 0.0], np.eye(2), 5, rng=np.random.default_rng(0), leading=(3,)).shape
    (3, 5, 2)
    """
    root = factor(cov)
    return mean + rng.standard_normal((*leading, members, mean.size)) @ root.T


@validated
def mean(ensemble: Members) -> Array:
    """Mean over the members, (..., d).

    >>> mean([[1.0, 2.0], [3.0, 4.0]])
    array([2., 3.])
    """
    # A product with equal weights: ten times faster than a reduction over a short inner axis.
    return np.asarray((_equal_weights(ensemble.shape[-2]) @ ensemble)[..., 0, :])


@lru_cache(maxsize=16)
def _equal_weights(members: int) -> Array:
    return np.full((1, members), 1 / members)


def center_ensemble(members: Array) -> tuple[Array, Array]:
    """Mean (..., 1, d) and anomalies (..., N, d), members minus their mean.

    >>> center_ensemble(np.array([[1.0], [3.0]]))
    (array([[2.]]), array([[-1.],
           [ 1.]]))
    """
    centre = _equal_weights(members.shape[-2]) @ members
    return centre, members - centre


@validated
def sample_covariance(ensemble: Ensemble) -> Array:
    """Sample covariance with N - 1 in the denominator, (..., d, d).

    >>> sample_covariance([[0.0, 0.0], [2.0, 4.0]])
    array([[2., 4.],
           [4., 8.]])
    """
    a = center_ensemble(ensemble)[1]
    return symmetrise(a.swapaxes(-1, -2) @ a / (a.shape[-2] - 1))


def exact_noise(avoid: Array, root: Array, rng: Rng) -> Array:
    r"""Draw noise (..., N, k) whose sample moments are exact: second-order exact draws.

    Over the members the draws average to zero, are uncorrelated with the given anomalies, and have
    exactly the sample covariance asked for. An ensemble with such noise added has the sum of both
    covariances, without the sampling error of a plain draw; otherwise they are as random as can be.

    Parameters
    ----------
    avoid : ndarray, (..., N, p)
        What the noise has to be uncorrelated with, by member: the ensemble, its predictions, other
        noise. Only differences from their mean matter, so ensembles serve as well. p may be 0.
    root : ndarray, (..., k, r)
        A factor of the noise's covariance. Leading axes broadcast.
    rng : numpy.random.Generator
        Source of the draw.

    Raises
    ------
    ValueError
        If there are too few members: N has to exceed the number of independent anomalies plus the
        rank of the covariance.

    Notes
    -----
    A plain draw is projected onto what is orthogonal over the members to the constant and to the
    anomalies, orthonormalised, which is whitening by the Cholesky factor of its own covariance, and
    coloured: :math:`\sqrt{N-1}\,\mathbf Q\mathbf L^\top` with :math:`\mathbf P=\mathbf L
    \mathbf L^\top`. :math:`\mathbf Q` is distributed uniformly over the orthonormal frames there.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = rng.standard_normal((20, 3))
    >>> noise = exact_noise(x, np.array([[2.0, 0.0], [0.5, 1.0]]), rng)
    >>> sample_covariance(noise).round(12)
    array([[4.  , 1.  ],
           [1.  , 1.25]])
    >>> bool((abs(center_ensemble(x)[1].T @ noise) < 1e-11).all())
    True
    """
    n = avoid.shape[-2]
    if n <= avoid.shape[-1] + root.shape[-1]:
        root = _narrow(root)
    rank = root.shape[-1]
    shape = np.broadcast_shapes(avoid.shape[:-2], root.shape[:-2])
    drawn = _projected(rng.standard_normal((*shape, n, rank)), avoid)
    return _coloured(drawn, root)


def _narrow(root: Array) -> Array:
    """A factor with as many columns as the rank, up to rounding: it asks for fewer members."""
    std = np.sqrt((root**2).sum(axis=-1))
    unit = np.where(std > 0, std, 1.0)[..., None]
    u, s, _ = np.linalg.svd(root / unit)
    kept = (
        s**2 > 64 * s.shape[-1] * EPS * s.max(axis=-1, initial=0.0, keepdims=True) ** 2
    )
    width = int(kept.sum(axis=-1).max(initial=0))
    return lower_root((u * (s * kept)[..., None, :])[..., :width]) * unit


def _projected(drawn: Array, avoid: Array) -> Array:
    """What is left of a draw without its mean and the anomalies."""
    (n, rank) = drawn.shape[-2:]
    around = center_ensemble(avoid)[1]
    size = np.sqrt((around**2).sum(axis=-2, keepdims=True))
    frame, independent = _frame(around / np.where(size > 0, size, 1.0))
    if n <= independent + rank:
        raise ValueError(
            f"ensemble must have more than {independent} + {rank} members, for "
            f"{independent} independent anomalies and noise of rank {rank}, got {n}"
        )
    for _ in range(2):
        drawn = center_ensemble(drawn - frame @ (frame.mT @ drawn))[1]
    return drawn


def _frame(columns: Array) -> tuple[Array, int]:
    """Orthonormal columns, or zeros, that span unit columns (..., n, p), and the largest rank."""
    q, r = np.linalg.qr(columns)
    good = np.abs(np.diagonal(r, axis1=-2, axis2=-1)) > _CLOSE
    # A small pivot may be rounding, magnified by columns that are close to one another: to avoid
    # its direction would cost a member, and would leave the draw to the last bit.
    if not good.all():
        u, values, _ = np.linalg.svd(r, full_matrices=False)
        good = values > columns.shape[-2] * EPS * values.max(
            axis=-1, initial=0.0, keepdims=True
        )
        q = q @ u
    return np.asarray(q * good[..., None, :]), int(good.sum(axis=-1).max(initial=0))


def _coloured(drawn: Array, root: Array) -> Array:
    """The draw (..., N, r) turned linearly so that its sample covariance is root root'."""
    n = drawn.shape[-2]
    # A pivot so small that solving with the factor would lose digits: by orthogonal steps.
    with suppress(np.linalg.LinAlgError):
        lower = cholesky(np.ascontiguousarray(drawn.swapaxes(-1, -2)) @ drawn / (n - 1))
        if np.diagonal(lower, axis1=-2, axis2=-1).min(initial=1.0) >= np.sqrt(0.1):
            return np.asarray(drawn @ solve_upper(lower, root.swapaxes(-1, -2)))
    q, r = np.linalg.qr(drawn)
    # A positive diagonal makes the frame that of whitening, whatever signs LAPACK prefers.
    sign = np.where(np.diagonal(r, axis1=-2, axis2=-1) < 0, -1.0, 1.0)[..., None, :]
    return np.asarray(np.sqrt(n - 1) * ((q * sign) @ root.swapaxes(-1, -2)))
