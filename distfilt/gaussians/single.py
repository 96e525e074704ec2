"""One Gaussian: its density, its update, its unscented points."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Annotated

import numpy as np

from ..linalg import (
    broadcast_leading,
    cholesky,
    identity,
    log_det,
    quadratic_form,
    solve_definite,
    symmetrise,
)
from ..validation import (
    ALLOW_NAN,
    Array,
    ArrayInput,
    Mask,
    PositiveDefinite,
    PositiveSemidefinite,
    all_finite,
    validated,
)

__all__ = ["condition", "log_density", "unscented_points"]

# From this size of the state on, few numbers are observed of it in one update, such as of a joint
# state of many bodies or of earlier times, and two products of whole matrices take long.
_LARGE = 24


@validated
def log_density(
    x: Annotated[ArrayInput, "... d"],
    mean: Annotated[ArrayInput, "... d"],
    cov: PositiveDefinite,
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
    leading = broadcast_leading(x.shape[:-1], mean.shape[:-1], "mean")
    broadcast_leading(leading, cov.shape[:-2], "cov")
    lower = cholesky(cov)
    constant = x.shape[-1] * np.log(2 * np.pi)
    squared_length = quadratic_form(lower, x - mean)
    return np.asarray(-0.5 * (squared_length + log_det(lower) + constant))


@validated
def condition(
    mean: Annotated[ArrayInput, "... d"],
    cov: PositiveSemidefinite,
    innovation: Annotated[ArrayInput, "... m", ALLOW_NAN],
    H: Annotated[ArrayInput, "... m d"],
    R: Annotated[PositiveDefinite, "... m m"],
) -> tuple[Array, Array]:
    r"""Condition Gaussians on observations :math:`\mathbf y=\mathbf H\mathbf x+\text{noise}`.

    Parameters
    ----------
    mean, cov : array_like, (..., d) and (..., d, d)
        The Gaussians; the covariance may be singular.
    innovation : array_like, (..., m)
        The observation :math:`\mathbf y` minus its prediction: :math:`\mathbf H` times the mean,
        or the prediction of a nonlinear sensor. NaN leaves that component out.
    H, R : array_like, (..., m, d) and (..., m, m)
        Observation matrix and noise covariance.

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
    missing = None
    if not all_finite(innovation):
        missing = np.isnan(innovation)
        # The row of H may be NaN too, where the component cannot be predicted.
        H = np.where(missing[..., None], 0.0, H)
        innovation = np.where(missing, 0.0, innovation)
    return condition_complete(mean, cov, innovation, H, R, missing)


def condition_complete(
    mean: Array,
    cov: Array,
    innovation: Array,
    H: Array,
    R: Array,
    missing: Mask | None = None,
) -> tuple[Array, Array]:
    """Condition Gaussians unchecked, by innovations that are zero where one is missing.

    >>> one = np.ones((1, 1))
    >>> condition_complete(np.zeros(1), one, np.array([2.0]), one, one)
    (array([1.]), array([[0.5]]))
    """
    cross, innovation_cov = innovation_moments(cov, H, R, missing)
    # K = P Hᵀ S⁻¹, by a solve instead of an inverse.
    gain = solve_definite(innovation_cov, cross).mT
    change = (gain @ innovation[..., None])[..., 0]
    return mean + change, joseph(cov, gain, H, R)


def innovation_moments(
    cov: Array, H: Array, R: Array, missing: Mask | None
) -> tuple[Array, Array]:
    """Cross-covariance H P of prediction and state, (..., m, d), and S = H P Hᵀ + R.

    Components (..., m) that are missing have no gain, and a one on the diagonal of S: that takes
    them out of every sum exactly.
    """
    cross = H @ cov
    # A copy of the transpose is multiplied faster than its view.
    innovation_cov = cross @ np.ascontiguousarray(H.mT) + R
    if missing is not None and missing.any():
        shape = innovation_cov.shape[:-1]
        index = np.nonzero(np.broadcast_to(missing, shape))
        cross = np.broadcast_to(cross, (*shape, cross.shape[-1])).copy()
        cross[index] = 0.0
        # Rows and columns of the missing components (columns are rows of the transposed view), and
        # their entries of the diagonal, whose column is the row, the last part of the index.
        innovation_cov[index] = 0.0
        innovation_cov.mT[index] = 0.0
        innovation_cov[(*index, index[-1])] = 1.0
    return cross, innovation_cov


def joseph(cov: Array, gain: Array, H: Array, R: Array) -> Array:
    """The covariance (..., d, d) after an update with any gain K (..., d, m), in Joseph's form.

    Errors of the gain enter in second order only. As a sum of squares a small covariance cannot
    become indefinite by rounding.
    """
    # P⁺ = (I - K H) P (I - K H)ᵀ + K R Kᵀ
    if cov.shape[-1] >= _LARGE:
        # With A = (I - K H) P it is A - (A Hᵀ - K R) Kᵀ: no product of two matrices (d, d).
        left = cov - gain @ (H @ cov)
        return symmetrise(left - (left @ H.mT - gain @ R) @ gain.mT)
    reduction = identity(cov.shape[-1]) - gain @ H
    prior_part = reduction @ cov @ np.ascontiguousarray(reduction.mT)
    posterior = prior_part + gain @ R @ gain.mT
    return symmetrise(posterior)


@validated
def unscented_points(
    mean: Annotated[ArrayInput, "... d"],
    root: Annotated[ArrayInput, "... d d"],
    *,
    kappa: float = 0.0,
) -> tuple[Array, Array]:
    r"""The 2d + 1 unscented points of Gaussians and their weights, which sum to 1.

    The mean, then :math:`\mathbf m\pm\sqrt{d+\kappa}\,\mathbf s_i` with the columns of the square
    root, all plus first. Weighted sums over the points give the Gaussian's mean and covariance.
    With :math:`\kappa=0` the mean has weight 0; with :math:`\kappa=3-d` fourth moments along
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
    # Rows are √(d + κ) s_i for the columns s_i of the root.
    offsets = math.sqrt(d + kappa) * root.mT
    zero = 0 * offsets[..., :1, :]
    offsets = np.concatenate([zero, offsets, -offsets], axis=-2)
    # A copy, since all callers share the cached weights.
    return mean[..., None, :] + offsets, make_unscented_weights(d, kappa).copy()


@lru_cache(maxsize=16)
def make_unscented_weights(d: int, kappa: float) -> Array:
    """Weights of the 2d + 1 points, read-only and made once.

    >>> make_unscented_weights(1, 2.0).round(3).tolist()
    [0.667, 0.167, 0.167]
    """
    weights = np.full(2 * d + 1, 0.5 / (d + kappa))
    weights[0] = kappa / (d + kappa)
    # Read-only, since all callers share the cached array.
    weights.setflags(write=False)
    return weights
