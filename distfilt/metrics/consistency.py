"""Does the error fit the covariance that the filter claims?"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, covariance, instance, number
from ..checks import count as whole
from ..ensembles import _mean, _sample_covariance
from ..intervals import Interval
from ..linalg import _cholesky, _leading, _quadratic_form
from .errors import _ensemble, _truth

__all__ = ["ensemble_nees", "nees", "nees_band", "nis"]


def nees(estimate: ArrayLike, cov: ArrayLike, truth: ArrayLike) -> Array:
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
    e = array(estimate, "estimate", (..., "d"))
    gap = e - _truth(truth, e.shape)
    return _quadratic_form(_cholesky(_spread(cov, gap.shape)), gap)


def _spread(value: ArrayLike, like: tuple[int, ...]) -> Array:
    """A covariance (..., d, d) for differences of shape `like`, (..., d)."""
    out = covariance(value, "cov", like[-1])
    _leading(like[:-1], out.shape[:-2], "cov")
    return out


def nis(innovation: ArrayLike, cov: ArrayLike) -> Array:
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
    gap = array(innovation, "innovation", (..., "m"))
    return _quadratic_form(_cholesky(_spread(cov, gap.shape)), gap)


def ensemble_nees(ensemble: ArrayLike, truth: ArrayLike) -> Array:
    r"""NEES of an ensemble, (...): its mean against the truth, in units of its sample covariance.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members; the covariance has N - 1 in the denominator.
    truth : array_like, (..., d)

    Raises
    ------
    ValueError
        If N <= d, where the sample covariance is singular, or if the members lie in a subspace.

    Notes
    -----
    When truth and members come from one Gaussian, :math:`\epsilon/(1+1/N)` is Hotelling's T², so
    the average is :math:`d\,(1+1/N)(N-1)/(N-d-2)` for N > d + 2, a little above d: by 4% for d = 6
    and N = 200.

    Examples
    --------
    >>> float(ensemble_nees([[0.0], [1.0], [2.0]], [3.0]))
    4.0
    """
    x = _ensemble(ensemble)
    n, d = x.shape[-2:]
    if n <= d:
        raise ValueError(f"ensemble: needs more members than components ({d}), got {n}")
    middle = _mean(x)
    t = _truth(truth, middle.shape)
    cov = _sample_covariance(x)
    # NEES does not depend on units: scaled to unit variances, rounding does not either, and the
    # test for a subspace compares pure numbers.
    scale = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    if not np.isfinite(scale).all():
        raise ValueError("ensemble: needs members of finite variance, got infinity")
    if (scale <= n * np.finfo(float).eps * np.abs(middle)).any():
        raise ValueError("ensemble: needs members that differ in every component")
    correlation = cov / (scale[..., :, None] * scale[..., None, :])
    if np.linalg.eigvalsh(correlation).min(initial=1.0) <= 10 * n * np.finfo(float).eps:
        raise ValueError("ensemble: needs members that span all components, got a subspace")
    return _quadratic_form(_cholesky(correlation), (middle - t) / scale)


def nees_band(dim: int, count: int, *, level: float = 0.95, normalised: bool = False) -> Interval:
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
    from scipy.stats import chi2

    d, n = whole(dim, "dim"), whole(count, "count")
    tail = (1 - number(level, "level", above=0, below=1)) / 2
    unit = n * d if instance(normalised, "normalised", bool) else n
    low, high = (float(chi2.ppf(p, n * d)) / unit for p in (tail, 1 - tail))
    middle = n * d / unit
    # At tiny levels the band lies below the mean, because the chi-square's median does.
    return Interval(float(min(max(middle, low), high)), low, high, float(np.sqrt(2 * n * d)) / unit)
