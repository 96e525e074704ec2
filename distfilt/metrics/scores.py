"""Errors, consistency measures and scores of estimates.

Squared lengths are sums over the components, which make sense only if all have one unit.

Shapes: estimates and truths are (..., d), ensembles (..., N, d), covariances (..., d, d). Leading
axes (runs, agents, times) broadcast between an estimate and its truth.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ..ensembles import Members
from ..gaussians import log_density
from ..linalg import broadcast_leading, cholesky, quadratic_form
from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    PositiveDefinite,
    PositiveInt,
    Probabilities,
    validated,
)
from .intervals import Interval, Level

__all__ = [
    "crps",
    "gaussian_crps",
    "log_score",
    "nees",
    "nees_band",
    "nis",
    "squared_error",
]

Vector = Annotated[ArrayInput, "... d"]


@validated
def squared_error(estimate: Vector, truth: Vector) -> Array:
    r"""Squared length of the error, :math:`\lVert\hat{\mathbf x}-\mathbf x\rVert^2`.

    A sum over the components, not a mean, in units of the state squared.

    Parameters
    ----------
    estimate, truth : array_like, (..., d)
        Leading axes broadcast.

    Examples
    --------
    >>> float(squared_error([1.0, 2.0], [4.0, 6.0]))
    25.0
    """
    broadcast_leading(estimate.shape[:-1], truth.shape[:-1], "truth")
    # |x - y|²
    return np.asarray(((estimate - truth) ** 2).sum(axis=-1))


@validated
def nees(estimate: Vector, cov: PositiveDefinite, truth: Vector) -> Array:
    r"""Normalised estimation error squared, (...).

    :math:`\epsilon = (\hat{\mathbf x}-\mathbf x)^\top\mathbf P^{-1}(\hat{\mathbf x}-\mathbf x)`. If
    the error is N(0, P), as for a consistent filter, it is chi-square with d degrees of freedom and
    averages d. More means overconfident, less means conservative.

    Parameters
    ----------
    estimate, truth : array_like, (..., d)
        Leading axes broadcast.
    cov : array_like, (..., d, d)
        The covariance P that the filter reports, positive definite.

    Notes
    -----
    Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications to Tracking and
    Navigation (2001), section 5.4.

    Examples
    --------
    >>> float(nees([2.0, 0.0], [[4.0, 0.0], [0.0, 1.0]], [0.0, 3.0]))
    10.0
    """
    broadcast_leading(estimate.shape[:-1], truth.shape[:-1], "truth")
    return nis(estimate - truth, cov)


@validated
def nis(
    innovation: Annotated[ArrayInput, "... m"],
    cov: Annotated[PositiveDefinite, "... m m"],
) -> Array:
    r"""Normalised innovation squared, (...), of an observation and its prediction.

    :math:`\mathbf d^\top\mathbf S^{-1}\mathbf d`. For a consistent filter it is chi-square with m
    degrees of freedom, so that ``nees_band(m, n)`` applies to the average of n independent ones. It
    needs no truth.

    Parameters
    ----------
    innovation : array_like, (..., m)
        Observation minus predicted observation; angles wrapped.
    cov : array_like, (..., m, m)
        Covariance S of the innovation, HPHᵀ + R: the prediction's and the noise's. Positive
        definite; leading axes broadcast.

    Examples
    --------
    >>> float(nis([2.0, 3.0], [[4.0, 0.0], [0.0, 1.0]]))
    10.0
    """
    broadcast_leading(innovation.shape[:-1], cov.shape[:-2], "cov")
    return quadratic_form(cholesky(cov), innovation)


@validated
def nees_band(
    dim: PositiveInt,
    count: PositiveInt,
    *,
    level: Level = 0.95,
    normalised: bool = False,
) -> Interval:
    r"""Band in which the average of independent NEES values of a consistent filter falls.

    The sum of `count` values is chi-square with ``count * dim`` degrees of freedom, so the average
    lies between its quantiles divided by `count`. The average itself is not divided by `dim`: it is
    near `dim`. With `normalised` everything is divided by `dim`, for NEES/d near 1.

    Parameters
    ----------
    dim : int
        Number d of components.
    count : int
        Number of *independent* values in the average: runs, not times of one run.
    level : float
        Probability of the band, in (0, 1); both tails are equal.
    normalised : bool
        Divide by `dim`.

    Returns
    -------
    Interval
        The expected average, the band, and the average's standard deviation.

    Examples
    --------
    >>> print(nees_band(6, 100))
    6 [5.34, 6.7]
    >>> print(nees_band(6, 100, normalised=True))
    1 [0.89, 1.12]
    """
    from scipy.special import gammaincinv

    # The sum of `count` values has count · dim degrees of freedom.
    tail = (1 - level) / 2
    total = count * dim
    divisor = total if normalised else count
    # Quantiles of chi-square with k degrees of freedom are 2 gammaincinv(k / 2, p).
    low = 2 * float(gammaincinv(total / 2, tail)) / divisor
    high = 2 * float(gammaincinv(total / 2, 1 - tail)) / divisor
    # At tiny levels the band lies below the mean, because the chi-square's median does.
    expected = float(min(max(total / divisor, low), high))
    # The variance of chi-square is twice its degrees of freedom.
    error = float(np.sqrt(2 * total)) / divisor
    return Interval(expected, low, high, error)


@validated
def crps(
    ensemble: Members,
    truth: Vector,
    *,
    weights: Annotated[Probabilities, "... N"] | None = None,
) -> Array:
    r"""Continuous ranked probability score (..., d) of an ensemble by component; smaller is better.

    :math:`\operatorname{mean}_i|x_i-y|-\tfrac12\operatorname{mean}_{i,j}|x_i-x_j|`, the integral of
    the squared difference between the members' distribution function and the truth's step. It
    rewards a small error and a fitting spread, in the state's unit. O(N log N) by sorting.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members.
    truth : array_like, (..., d)
    weights : array_like, (..., N), optional
        Of the members, with sum one; equal by default.

    Notes
    -----
    T. Gneiting and A. E. Raftery, Journal of the American Statistical Association 102 (2007)
    359-378, equation (21).

    Examples
    --------
    >>> crps([[0.0], [2.0]], [1.0])
    array([0.5])
    >>> crps(np.zeros((2, 4, 1)), [1.0], weights=np.full((3, 4), 0.25))
    Traceback (most recent call last):
    ValueError: weights must have leading axes that broadcast with (2,), got (3,)
    """
    n = ensemble.shape[-2]
    broadcast_leading(ensemble.shape[:-2], truth.shape[:-1], "truth")
    # The score depends on differences only, which lose fewer digits far from zero.
    errors = ensemble - truth[..., None, :]
    if weights is None:
        errors = np.sort(errors, axis=-2)
        w = np.full((n, 1), 1 / n)
    else:
        broadcast_leading(errors.shape[:-2], weights.shape[:-1], "weights")
        # Errors in ascending order, and each one's weight beside it
        order = np.argsort(errors, axis=-2)
        errors = np.take_along_axis(errors, order, axis=-2)
        columns = np.broadcast_to(weights[..., None], errors.shape)
        w = np.take_along_axis(columns, order, axis=-2)
    # The score is Σ_i w_i |e_i| - ½ Σ_ij w_i w_j |e_i - e_j|. Of sorted errors half the second sum,
    # in which each pair appears twice, is Σ_i w_i e_i (2 W_i - w_i - 1), with W_i the sum of the
    # weights up to i: e_i is the larger of pairs with weight W_i - w_i, and the smaller of 1 - W_i.
    coefficients = 2 * np.cumsum(w, axis=-2) - w - 1
    return np.asarray((w * (np.abs(errors) - coefficients * errors)).sum(axis=-2))


@validated
def gaussian_crps(
    mean: Annotated[ArrayInput, "..."],
    std: Annotated[ArrayInput, "...", Bounds(above=0)],
    truth: Annotated[ArrayInput, "..."],
) -> Array:
    r"""Continuous ranked probability score of Gaussians, componentwise, (...).

    :math:`\sigma\,[z(2\Phi(z)-1)+2\varphi(z)-1/\sqrt\pi]` with :math:`z=(y-\mu)/\sigma`.

    Parameters
    ----------
    mean, truth : array_like, (...)
    std : array_like, (...)
        Standard deviations, positive. The three arrays broadcast.

    Notes
    -----
    T. Gneiting and A. E. Raftery, Journal of the American Statistical Association 102 (2007)
    359-378, section 4.2.

    Examples
    --------
    >>> float(gaussian_crps(0.0, 1.0, 0.0).round(6))
    0.233695
    """
    from scipy.special import ndtr

    shape = broadcast_leading(mean.shape, std.shape, "std")
    broadcast_leading(shape, truth.shape, "truth")
    # In units of the standard deviation the score depends on z only.
    z = (truth - mean) / std
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    score = z * (2 * ndtr(z) - 1) + 2 * density - 1 / np.sqrt(np.pi)
    return np.asarray(std * score)


@validated
def log_score(estimate: Vector, cov: PositiveDefinite, truth: Vector) -> Array:
    r"""Minus the log-density of a Gaussian estimate at the truth, (...); smaller is better.

    It rewards a small error and a fitting covariance of all components together. The score of a
    consistent Gaussian is :math:`\tfrac12\log\det(2\pi e\mathbf P)` on average, and every other
    covariance scores worse.

    Parameters
    ----------
    estimate, truth : array_like, (..., d)
        Leading axes broadcast.
    cov : array_like, (..., d, d)
        The estimate's covariance, positive definite.

    Examples
    --------
    >>> float(log_score([0.0], [[1.0]], [1.0]).round(6))
    1.418939
    """
    return -log_density(truth, estimate, cov)
