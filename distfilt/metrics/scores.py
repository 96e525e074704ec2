"""How good an estimate is: error, consistency and score, with intervals.

Lengths sum over the components, which has a meaning only where they have one unit.

Shapes: estimates and truths are (..., d), ensembles (..., N, d), covariances (..., d, d). Leading
axes (runs, agents, times) broadcast between an estimate and its truth.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np

from ..ensembles import Members
from ..gaussians import log_density
from ..linalg import cholesky, broadcast_leading, quadratic_form
from ..validation import (
    Array,
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

Vector = Annotated[Array, "... d"]


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
    return np.asarray(((estimate - truth) ** 2).sum(axis=-1))


@validated
def nees(estimate: Vector, cov: PositiveDefinite, truth: Vector) -> Array:
    r"""Normalised estimation error squared, (...).

    :math:`\epsilon = (\hat{\mathbf x}-\mathbf x)^\top\mathbf P^{-1}(\hat{\mathbf x}-\mathbf x)`. If
    the error is N(0, P), as an honest filter claims, it is chi-square with d degrees of freedom and
    averages d. More means overconfidence, less means caution.

    Parameters
    ----------
    estimate, truth : array_like, (..., d)
        Leading axes broadcast.
    cov : array_like, (..., d, d)
        The filter's own covariance P, positive definite.

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
    innovation: Annotated[Array, "... m"], cov: Annotated[PositiveDefinite, "... m m"]
) -> Array:
    r"""Normalised innovation squared, (...): how far a reading is from its prediction.

    :math:`\mathbf d^\top\mathbf S^{-1}\mathbf d`. Of an honest filter it is chi-square with m
    degrees of freedom, so that ``nees_band(m, n)`` holds the average of n independent ones. Needs
    no truth.

    Parameters
    ----------
    innovation : array_like, (..., m)
        Reading minus predicted reading; angles as the shorter way round.
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
    r"""Where the average of independent NEES values of an honest filter falls.

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

    tail = (1 - level) / 2
    total = count * dim
    unit = total if normalised else count
    low, high = (2 * float(gammaincinv(total / 2, p)) / unit for p in (tail, 1 - tail))
    # At tiny levels the band lies below the mean, because the chi-square's median does.
    middle = float(min(max(total / unit, low), high))
    return Interval(middle, low, high, float(np.sqrt(2 * total)) / unit)


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
    rewards a small error and a spread that fits, in the state's unit. O(N log N) by sorting.

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
    # Distances from the truth are as good as the members, and lose fewer digits far from zero.
    gap = ensemble - truth[..., None, :]
    if weights is None:
        gap = np.sort(gap, axis=-2)
        share = np.full((n, 1), 1 / n)
    else:
        broadcast_leading(gap.shape[:-2], weights.shape[:-1], "weights")
        order = np.argsort(gap, axis=-2)
        gap = np.take_along_axis(gap, order, axis=-2)
        share = np.take_along_axis(
            np.broadcast_to(weights[..., None], gap.shape), order, axis=-2
        )
    above = 2 * np.cumsum(share, axis=-2) - share - 1
    return np.asarray((share * (np.abs(gap) - above * gap)).sum(axis=-2))


@validated
def gaussian_crps(
    mean: Annotated[Array, "..."],
    std: Annotated[Array, "...", Bounds(above=0)],
    truth: Annotated[Array, "..."],
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

    broadcast_leading(
        broadcast_leading(mean.shape, std.shape, "std"), truth.shape, "truth"
    )
    z = (truth - mean) / std
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    return np.asarray(std * (z * (2 * ndtr(z) - 1) + 2 * density - 1 / np.sqrt(np.pi)))


@validated
def log_score(estimate: Vector, cov: PositiveDefinite, truth: Vector) -> Array:
    r"""Minus the log-density of a Gaussian estimate at the truth, (...); smaller is better.

    It rewards a small error and a covariance that fits, of all components together. The score of
    an honest Gaussian is :math:`\tfrac12\log\det(2\pi e\mathbf P)` on average, and every other
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
