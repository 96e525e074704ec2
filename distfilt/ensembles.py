"""Ensembles: arrays (..., N, d) whose rows are members, their moments and how to draw them."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from typing import Annotated

import numpy as np

from .linalg import (
    EPS,
    broadcast_leading,
    center_ensemble,
    cholesky,
    equal_weights,
    factor,
    lower_root,
    solve_lower,
    symmetrise,
)
from .validation import (
    Array,
    ArrayInput,
    PositiveDefinite,
    PositiveInt,
    PositiveSemidefinite,
    Rng,
    validated,
)

__all__ = ["Members", "draw", "mean", "sample_covariance"]


def _check_size(members: int, value: Array, name: str) -> None:
    """Raise an error if an ensemble (..., N, d) has fewer members than so many."""
    if value.shape[-2] < members:
        raise ValueError(
            f"{name} must have at least {members} members, got {value.shape[-2]}"
        )


Members = Annotated[ArrayInput, "... N d", partial(_check_size, 1)]
"""Annotation of an argument that is an ensemble of at least one member."""
Ensemble = Annotated[ArrayInput, "... N d", partial(_check_size, 2)]
"""Annotation of an argument that is an ensemble with a sample covariance."""

# Pivots of unit columns up to which a singular value decomposition decides on their rank. Rounding
# leaves pivots of about 1e-15; independent columns rarely have pivots below 1e-6, so that the
# slower decomposition is rarely needed.
_SMALL_PIVOT = 1e-6
# Smallest diagonal entry of the Cholesky factor of a draw's covariance with which to solve: with
# such pivots, of variances of about one, the solution loses no more than a digit.
_SAFE_PIVOT = np.sqrt(0.1)


@validated
def draw(
    mean: Annotated[ArrayInput, "d"],
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
    # x = m + L z with z ~ N(0, I)
    root = factor(cov)
    z = rng.standard_normal((*leading, members, mean.size))
    return np.asarray(mean + z @ root.T)


@validated
def mean(ensemble: Members) -> Array:
    """Mean over the members, (..., d).

    >>> mean([[1.0, 2.0], [3.0, 4.0]])
    array([2., 3.])
    """
    # A product with equal weights: ten times faster than a reduction over a short inner axis.
    weights = equal_weights(ensemble.shape[-2])
    return np.asarray((weights @ ensemble)[..., 0, :])


@validated
def sample_covariance(ensemble: Ensemble) -> Array:
    """Sample covariance with N - 1 in the denominator, (..., d, d).

    >>> sample_covariance([[0.0, 0.0], [2.0, 4.0]])
    array([[2., 4.],
           [4., 8.]])
    """
    # P = Aᵀ A / (N - 1) of the anomalies A.
    anomalies = center_ensemble(ensemble).anomalies
    n = anomalies.shape[-2]
    return symmetrise(anomalies.swapaxes(-1, -2) @ anomalies / (n - 1))


@validated
def match_moments(
    ensemble: Annotated[ArrayInput, "... N d"],
    mean: Annotated[ArrayInput, "... d"],
    cov: PositiveDefinite,
) -> Array:
    r"""Map an ensemble affinely to the given sample mean and covariance.

    .. math:: \mathbf x_i' = \mathbf m + \mathbf A(\mathbf x_i-\bar{\mathbf x}),\qquad
        \mathbf A = \mathbf S^{-\top}(\mathbf S^\top\mathbf P\mathbf S)^{1/2}\mathbf S^{-1},\qquad
        \hat{\mathbf C} = \mathbf S\mathbf S^\top

    A is the optimal transport between Gaussians: of all affine maps with this result it has the
    least mean squared displacement, in units of the new standard deviations.

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
    leading = broadcast_leading(ensemble.shape[:-2], mean.shape[:-1], "mean")
    broadcast_leading(leading, cov.shape[:-2], "cov")
    # Anomalies in units of the new standard deviations are Q R.
    std = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    weights = np.full(n, 1 / n)
    scaled = ensemble / std[..., None, :]
    centre = weights @ scaled
    scaled -= centre[..., None, :]
    q, r = np.linalg.qr(scaled)
    # |R_kk| is the part of component k that those before it do not explain. It must exceed
    # rounding: of the whole component, whose length is that of column k of R, and of its mean,
    # which has been subtracted.
    length = np.sqrt((r**2).sum(axis=-2))
    independent = np.abs(np.diagonal(r, axis1=-2, axis2=-1))
    rounding = 32 * d * EPS * (length + np.abs(centre))
    if (independent <= rounding).any():
        raise ValueError(
            "ensemble must have components that are not constant and not combinations "
            "of others, got a singular sample covariance"
        )
    # Kᵀ Rᵀ = U Σ Vᵀ, and the new anomalies are √(N-1) Q V Uᵀ Kᵀ.
    upper = cholesky(cov / (std[..., :, None] * std[..., None, :])).mT
    u, _singular_values, vh = np.linalg.svd(upper @ r.mT)
    rotation = vh.mT @ (u.mT @ upper)
    anomalies = q @ (np.sqrt(n - 1) * rotation)
    # Q is centred to rounding only, which counts where the old ensemble is almost flat.
    anomalies -= (weights @ anomalies)[..., None, :]
    anomalies *= std[..., None, :]
    return np.asarray(anomalies + mean[..., None, :])


def exact_noise(avoid: Array, root: Array, rng: Rng) -> Array:
    r"""Draw noise (..., N, k) whose sample moments are exact: second-order exact draws.

    Over the members the draws average to zero, are uncorrelated with the given anomalies, and have
    exactly the sample covariance asked for. An ensemble with such noise added has the sum of both
    covariances, without the sampling error of a plain draw; otherwise they are as random as can be.

    Parameters
    ----------
    avoid : ndarray, (..., N, p)
        Quantities that the noise must be uncorrelated with, by member: the ensemble, its
        predictions, other noise. Their mean does not matter. p may be 0.
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
    Columns of a plain draw are vectors with one entry per member. They are made orthogonal to the
    constant vector and to the anomalies, then to each other and of unit length, which gives
    :math:`\mathbf Q`. The noise is :math:`\sqrt{N-1}\,\mathbf Q\mathbf L^\top` with
    :math:`\mathbf P=\mathbf L\mathbf L^\top`. No direction is preferred: :math:`\mathbf Q` is
    distributed uniformly over the orthonormal frames of that subspace.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> x = rng.standard_normal((20, 3))
    >>> noise = exact_noise(x, np.array([[2.0, 0.0], [0.5, 1.0]]), rng)
    >>> sample_covariance(noise).round(12)
    array([[4.  , 1.  ],
           [1.  , 1.25]])
    >>> bool((abs(center_ensemble(x).anomalies.T @ noise) < 1e-11).all())
    True
    """
    n = avoid.shape[-2]
    # There seem to be too few members, unless the covariance is singular.
    if n <= avoid.shape[-1] + root.shape[-1]:
        root = _drop_null_columns(root)
    rank = root.shape[-1]
    leading = np.broadcast_shapes(avoid.shape[:-2], root.shape[:-2])
    noise = rng.standard_normal((*leading, n, rank))
    # First orthogonal to the constant vector and to the anomalies, then of the covariance L Lᵀ
    return _set_covariance(_project_out(noise, avoid), root)


def _drop_null_columns(root: Array) -> Array:
    """Reduce a factor (..., k, r) of covariances to as many columns as their rank, up to rounding.

    Noise of a lower rank needs fewer members. In a batch the rank is the largest. The result is
    (..., k, rank).
    """
    # Rows of unit length: the factor of the correlations.
    std = np.sqrt((root**2).sum(axis=-1))
    unit = np.where(std > 0, std, 1.0)[..., None]
    # Singular values count if their squares, the eigenvalues of the correlations, exceed rounding:
    # 64 ε for each component, relative to the largest.
    u, s, _vh = np.linalg.svd(root / unit)
    largest = s.max(axis=-1, initial=0.0, keepdims=True)
    is_positive = s**2 > 64 * s.shape[-1] * EPS * largest**2
    rank = int(is_positive.sum(axis=-1).max(initial=0))
    # L Lᵀ = U S² Uᵀ, so that U S is a factor too, with zero columns last. `lower_root` makes it
    # lower triangular, which is the same on every machine.
    columns = u * (s * is_positive)[..., None, :]
    return lower_root(columns[..., :rank]) * unit


def _project_out(noise: Array, avoid: Array) -> Array:
    """Subtract from a draw (..., N, r) its mean, and its projection on the anomalies of `avoid`.

    Raises an error if there are too few members for r columns that are independent of those.
    """
    n, rank = noise.shape[-2:]
    anomalies = center_ensemble(avoid).anomalies
    length = np.sqrt((anomalies**2).sum(axis=-2, keepdims=True))
    # Columns of length one; an orthonormal basis of their span, (..., N, p), and its dimension.
    unit_columns = anomalies / np.where(length > 0, length, 1.0)
    basis, independent = _orthonormal_basis(unit_columns)
    # Of N dimensions the constant vector takes one, and the anomalies take theirs.
    if n <= independent + rank:
        raise ValueError(
            f"ensemble must have more than {independent} + {rank} members, for "
            f"{independent} independent anomalies and noise of rank {rank}, got {n}"
        )
    # Twice, since rounding leaves a small projection the first time.
    for _ in range(2):
        noise = center_ensemble(noise - basis @ (basis.mT @ noise)).anomalies
    return noise


def _orthonormal_basis(columns: Array) -> tuple[Array, int]:
    """Return an orthonormal basis of the span of unit columns (..., n, p), and its dimension.

    The basis has as many columns as the input; those that are not needed are zero. In a batch the
    dimension is the largest.
    """
    q, r = np.linalg.qr(columns)
    # The diagonal of R is the part of each column that those before it do not span.
    is_independent = np.abs(np.diagonal(r, axis1=-2, axis2=-1)) > _SMALL_PIVOT
    # A small part may be rounding only. Taken for a direction, it would cost a degree of freedom
    # and make the draw depend on the last bit. The singular values of R are those of the columns
    # and show their rank reliably; with R = U S Vᵀ the basis is Q U.
    if not is_independent.all():
        u, values, _vh = np.linalg.svd(r, full_matrices=False)
        largest = values.max(axis=-1, initial=0.0, keepdims=True)
        is_independent = values > columns.shape[-2] * EPS * largest
        q = q @ u
    rank = int(is_independent.sum(axis=-1).max(initial=0))
    return np.asarray(q * is_independent[..., None, :]), rank


def _set_covariance(noise: Array, root: Array) -> Array:
    """Transform a draw (..., N, r) linearly so that its sample covariance is L Lᵀ, (..., N, k).

    The draw is centred; `root` is L, (..., k, r).
    """
    n = noise.shape[-2]
    transposed_root = root.swapaxes(-1, -2)
    # Whitening: with Zᵀ Z / (N - 1) = C Cᵀ the sample covariance of Z C⁻ᵀ is the identity, and
    # that of Z C⁻ᵀ Lᵀ is L Lᵀ.
    with suppress(np.linalg.LinAlgError):
        transposed = np.ascontiguousarray(noise.swapaxes(-1, -2))
        lower = cholesky(transposed @ noise / (n - 1))
        pivots = np.diagonal(lower, axis1=-2, axis2=-1)
        if pivots.min(initial=1.0) >= _SAFE_PIVOT:
            # C⁻ᵀ Lᵀ
            transform = solve_lower(lower, transposed_root, transposed=True)
            return np.asarray(noise @ transform)
    # With a small pivot, or none, the solution would lose digits. Z = Q R loses none:
    # √(N-1) Q has the identity as sample covariance too.
    q, r = np.linalg.qr(noise)
    # LAPACK leaves the signs of Q open. With a positive diagonal of R it is Z C⁻ᵀ of the above.
    diagonal = np.diagonal(r, axis1=-2, axis2=-1)
    sign = np.where(diagonal < 0, -1.0, 1.0)[..., None, :]
    return np.asarray(np.sqrt(n - 1) * ((q * sign) @ transposed_root))
