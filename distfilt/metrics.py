"""How good an estimate is: error, consistency, score and spread, with intervals.

Shapes: estimates and truths are (..., d), ensembles (..., N, d), covariances (..., d, d). Leading
axes (runs, agents, times) broadcast between an estimate and its truth.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .checks import Array, array, count, covariance, number
from .checks import weights as unit_weights
from .ensembles import mean, sample_covariance
from .intervals import Interval, mean_interval, median_interval, proportion_interval

__all__ = [
    "Interval",
    "crps",
    "ensemble_nees",
    "gaussian_crps",
    "mean_interval",
    "median_interval",
    "nees",
    "nees_band",
    "proportion_interval",
    "rmse",
    "spread",
    "squared_error",
]


def _ensemble(value: ArrayLike, members: int = 1) -> Array:
    out = array(value, "ensemble", (..., "N", "d"))
    if out.shape[-1] < 1:
        raise ValueError(f"ensemble: needs at least one component, got shape {out.shape}")
    if out.shape[-2] < members:
        raise ValueError(f"ensemble: needs at least {members} members, got {out.shape[-2]}")
    return out


def _truth(value: ArrayLike, like: tuple[int, ...], other: str) -> Array:
    """The truth as (..., d), where `like` is the shape (..., d) that it has to broadcast with."""
    out = array(value, "truth", (..., like[-1]))
    try:
        np.broadcast_shapes(out.shape, like)
    except ValueError:
        raise ValueError(
            f"truth: needs leading axes that broadcast with those of {other} {like[:-1]}, "
            f"got {out.shape[:-1]}"
        ) from None
    return out


def squared_error(estimate: ArrayLike, truth: ArrayLike) -> Array:
    r"""Squared length of the error, :math:`\lVert\hat{\mathbf x}-\mathbf x\rVert^2`.

    A sum over the components, not a mean, in units of the state squared.

    Parameters
    ----------
    estimate, truth : array_like, (..., d)
        Leading axes broadcast.

    Returns
    -------
    ndarray, (...)

    Examples
    --------
    >>> float(squared_error([1.0, 2.0], [4.0, 6.0]))
    25.0
    """
    e = array(estimate, "estimate", (..., "d"))
    t = _truth(truth, e.shape, "estimate")
    return np.asarray(((e - t) ** 2).sum(axis=-1))


def rmse(
    estimate: ArrayLike, truth: ArrayLike, *, axis: int | tuple[int, ...] | None = None
) -> Array:
    r"""Root of the mean squared length of the error.

    :math:`\sqrt{\operatorname{mean}\lVert\hat{\mathbf x}-\mathbf x\rVert^2}`: squared lengths are
    sums over the components; the mean goes over the leading axes in `axis`; the root comes last.

    Parameters
    ----------
    estimate, truth : array_like, (..., d)
        Leading axes broadcast.
    axis : int or tuple of int, optional
        Axes of the *leading* shape (...), so -1 is the one before the components. All of them by
        default, ``()`` for none.

    Returns
    -------
    ndarray
        The leading shape without `axis`, in the state's unit.

    Examples
    --------
    >>> float(rmse([[3.0, 4.0], [0.0, 0.0]], [0.0, 0.0]).round(6))
    3.535534
    """
    square = squared_error(estimate, truth)
    axes = _axes(axis, square.ndim)
    if square.size == 0:
        raise ValueError(f"estimate: needs at least one error to average, got shape {square.shape}")
    return np.asarray(np.sqrt(square.mean(axis=axes)))


def _axes(axis: int | tuple[int, ...] | None, ndim: int) -> tuple[int, ...]:
    if axis is None:
        return tuple(range(ndim))
    given = axis if isinstance(axis, tuple) else (axis,)
    whole = all(isinstance(k, int | np.integer) for k in given)
    if not whole or any(not -ndim <= k < ndim for k in given):
        raise ValueError(f"axis: needs integers among the {ndim} leading axes, got {axis!r}")
    found = tuple(int(k) % ndim for k in given)
    if len(set(found)) != len(found):
        raise ValueError(f"axis: needs distinct axes, got {axis!r}")
    return found


def nees(estimate: ArrayLike, covariance: ArrayLike, truth: ArrayLike) -> Array:
    r"""Normalised estimation error squared.

    :math:`\epsilon = (\hat{\mathbf x}-\mathbf x)^\top\mathbf P^{-1}(\hat{\mathbf x}-\mathbf x)`. If
    the error is N(0, P), as an honest filter claims, it is chi-square with d degrees of freedom and
    averages d. More means overconfidence, less means caution.

    Parameters
    ----------
    estimate, truth : array_like, (..., d)
        Leading axes broadcast.
    covariance : array_like, (..., d, d)
        The filter's own covariance P, positive definite.

    Returns
    -------
    ndarray, (...)

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
    gap = e - _truth(truth, e.shape, "estimate")
    p = _covariance(covariance, e.shape[-1])
    try:
        np.broadcast_shapes(gap.shape[:-1], p.shape[:-2])
    except ValueError:
        raise ValueError(
            f"covariance: needs leading axes that broadcast with those of the error "
            f"{gap.shape[:-1]}, got {p.shape[:-2]}"
        ) from None
    return _mahalanobis(np.linalg.cholesky(p), gap)


def _covariance(value: ArrayLike, dim: int) -> Array:
    # `nees` has an argument of the same name as the check.
    return covariance(value, "covariance", dim)


def _mahalanobis(lower: ArrayLike, gap: Array) -> Array:
    half = np.linalg.solve(np.asarray(lower), gap[..., None])[..., 0]
    return np.asarray((half**2).sum(axis=-1))


def ensemble_nees(ensemble: ArrayLike, truth: ArrayLike) -> Array:
    r"""NEES of an ensemble: its mean against the truth, in units of its sample covariance.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members; the covariance has N - 1 in the denominator.
    truth : array_like, (..., d)

    Returns
    -------
    ndarray, (...)

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
    middle = mean(x)
    t = _truth(truth, middle.shape, "ensemble")
    cov = sample_covariance(x)
    # NEES does not depend on units: scaled to unit variances, rounding does not either, and the
    # test for a subspace compares pure numbers.
    scale = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    if (scale <= n * np.finfo(float).eps * np.abs(middle)).any():
        raise ValueError("ensemble: needs members that differ in every component")
    correlation = cov / (scale[..., :, None] * scale[..., None, :])
    if np.linalg.eigvalsh(correlation).min(initial=1.0) <= 10 * n * np.finfo(float).eps:
        raise ValueError("ensemble: needs members that span all components, got a subspace")
    return _mahalanobis(np.linalg.cholesky(correlation), (middle - t) / scale)


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

    d, n = _count(dim, "dim"), _count(count, "count")
    tail = (1 - number(level, "level", above=0, below=1)) / 2
    unit = n * d if normalised else n
    low, high = (float(chi2.ppf(p, n * d)) / unit for p in (tail, 1 - tail))
    middle = n * d / unit
    # At tiny levels the band lies below the mean, because the chi-square's median does.
    return Interval(float(min(max(middle, low), high)), low, high, float(np.sqrt(2 * n * d)) / unit)


def _count(value: Any, name: str) -> int:
    # `nees_band` has an argument of the same name as the check.
    return count(value, name)


def crps(
    ensemble: ArrayLike,
    truth: ArrayLike,
    *,
    fair: bool = False,
    weights: ArrayLike | None = None,
) -> Array:
    r"""Continuous ranked probability score of each component of an ensemble; smaller is better.

    :math:`\operatorname{mean}_i|x_i-y|-\tfrac12\operatorname{mean}_{i,j}|x_i-x_j|`, the integral of
    the squared difference between the members' distribution function and the truth's step. It
    rewards a small error and a spread that fits, in the state's unit. O(N log N) by sorting.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members.
    truth : array_like, (..., d)
    fair : bool
        Average the pairs over i ≠ j, N (N - 1) of them: unbiased for the score of the distribution
        that the members are drawn from. Needs N >= 2.
    weights : array_like, (..., N), optional
        Of the members, with sum one; equal by default. Not together with `fair`.

    Returns
    -------
    ndarray, (..., d)

    Notes
    -----
    T. Gneiting and A. E. Raftery, Journal of the American Statistical Association 102 (2007)
    359-378, equation (21); C. A. T. Ferro, Quarterly Journal of the Royal Meteorological Society
    140 (2014) 1917-1923, for the fair version.

    Examples
    --------
    >>> crps([[0.0], [2.0]], [1.0])
    array([0.5])
    >>> crps([[0.0], [2.0]], [1.0], fair=True)
    array([0.])
    """
    x = _ensemble(ensemble, 2 if fair else 1)
    n = x.shape[-2]
    t = _truth(truth, (*x.shape[:-2], x.shape[-1]), "ensemble")
    if weights is not None:
        return _weighted_crps(x - t[..., None, :], weights, fair)
    # Distances from the truth are as good as the members, and lose fewer digits far from zero.
    gap = np.sort(x - t[..., None, :], axis=-2)
    rank = 2.0 * np.arange(1, n + 1) - n - 1
    pairs = (rank[:, None] * gap).sum(axis=-2) / (n * (n - 1 if fair else n))
    return np.asarray(np.abs(gap).mean(axis=-2) - pairs)


def _weighted_crps(gap: Array, weights: ArrayLike, fair: bool) -> Array:
    if fair:
        raise ValueError("fair: needs members of equal weight, got weights")
    w = unit_weights(array(weights, "weights", gap.shape[:-1]), "weights")
    order = np.argsort(gap, axis=-2)
    gap = np.take_along_axis(gap, order, axis=-2)
    share = np.take_along_axis(np.broadcast_to(w[..., None], gap.shape), order, axis=-2)
    above = 2 * np.cumsum(share, axis=-2) - share - 1
    return np.asarray((share * (np.abs(gap) - above * gap)).sum(axis=-2))


def gaussian_crps(mean: ArrayLike, std: ArrayLike, truth: ArrayLike) -> Array:
    r"""Continuous ranked probability score of Gaussians, componentwise.

    :math:`\sigma\,[z(2\Phi(z)-1)+2\varphi(z)-1/\sqrt\pi]` with :math:`z=(y-\mu)/\sigma`.

    Parameters
    ----------
    mean, truth : array_like, (...)
    std : array_like, (...)
        Standard deviations, positive. The three arrays broadcast.

    Returns
    -------
    ndarray, (...)

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

    m, s, t = array(mean, "mean"), array(std, "std"), array(truth, "truth")
    if s.size and s.min() <= 0:
        raise ValueError(f"std: needs positive standard deviations, got {s.min():.6g}")
    try:
        np.broadcast_shapes(m.shape, s.shape, t.shape)
    except ValueError:
        raise ValueError(
            f"truth: needs a shape that broadcasts with mean {m.shape} and std {s.shape}, "
            f"got {t.shape}"
        ) from None
    z = (t - m) / s
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    return np.asarray(s * (z * (2 * ndtr(z) - 1) + 2 * density - 1 / np.sqrt(np.pi)))


def spread(ensemble: ArrayLike) -> Array:
    r"""Root of the trace of the sample covariance: what the ensemble says its `rmse` should be.

    The trace sums the components' variances as `rmse` sums their squared errors, so the two are
    comparable: mean ``spread**2`` times 1 + 1/N matches mean squared error for an honest ensemble.
    Average over runs or times the square, and take the root last.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        At least two members.

    Returns
    -------
    ndarray, (...)
        In the state's unit.

    Examples
    --------
    >>> float(spread([[0.0, 0.0], [2.0, 0.0], [4.0, 0.0]]))
    2.0
    """
    x = _ensemble(ensemble, 2)
    return np.asarray(np.sqrt(x.var(axis=-2, ddof=1).sum(axis=-1)))
