"""Weighted particles: weights from likelihoods, systematic resampling, jitter, and collapse."""

from __future__ import annotations

import warnings
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..coupling.transform import normalize_weights
from ..linalg import cholesky, factor, log_sum, solve_lower
from ..validation import (
    Array,
    Bounds,
    Mask,
    PositiveSemidefinite,
    Probabilities,
    Rng,
    all_finite,
    validated,
)

__all__ = ["ParticleCollapse", "effective_size", "jitter", "resample"]

Indices = NDArray[np.intp]
Bandwidth = Annotated[float, Bounds(above=0, at_most=1)]


class ParticleCollapse(RuntimeWarning):
    """A belief rests on few members: the others are copies, or have no weight."""


def effective_size(log_weights: ArrayLike) -> Array:
    r"""Effective sample size :math:`1/\sum_i w_i^2`: N for equal weights, 1 for a single one.

    It knows weights only: copies of one particle with equal weights count as N.

    Parameters
    ----------
    log_weights : array_like, (..., N)
        Logarithms of weights, in any normalisation; minus infinity is a weight of zero.

    Examples
    --------
    >>> float(effective_size(np.log([0.5, 0.25, 0.25])).round(4))
    2.6667
    """
    return size_of(normalize_weights(log_weights))


def size_of(w: Array) -> Array:
    """Effective sample size of normalised weights."""
    return np.asarray(1 / (w * w).sum(axis=-1))


def warn_of_collapse(what: str, option: str) -> None:
    """Tell whoever called a filter, or an update, that what it believes rests on few members."""
    text = (
        f"{what}; more members, {option}, or more process noise keep its belief alive"
    )
    warnings.warn(text, ParticleCollapse, stacklevel=4)


def warn_of_weights(
    log_weights: Array, predicted: Array, observed: Array, noise: Array
) -> None:
    """Warn where one member has all the weight, or the reading is beyond what members believe.

    >>> two = np.array([[0.0, -99.0], [0.0, 0.0]]), np.array([[[0.0], [1.0]]] * 2)
    >>> with warnings.catch_warnings(action="error"):
    ...     warn_of_weights(*two, np.zeros((2, 1)), np.eye(1))
    Traceback (most recent call last):
    distfilt.updates.particles.ParticleCollapse: an ensemble's weights have an effective size of ...
    >>> with warnings.catch_warnings(action="error"):
    ...     warn_of_weights(0 * two[0], two[1], np.array([[np.nan], [9.0]]), np.eye(1))
    Traceback (most recent call last):
    distfilt.updates.particles.ParticleCollapse: a reading's squared distance from an ensemble's ...
    """
    m = observed.shape[-1]
    gap = observed - predicted.mean(axis=-2)
    around = predicted - predicted.mean(axis=-2, keepdims=True)
    cov = around.mT @ around / predicted.shape[-2] + noise
    miss = (gap * np.linalg.solve(cov, gap[..., None])[..., 0]).sum(axis=-1)
    least = size_of(np.exp(log_weights - log_sum(log_weights))).min(initial=np.inf)
    if least < 1.1:
        what = f"an ensemble's weights have an effective size of {least:.1f}"
    elif (most := np.nanmax(miss, initial=0.0)) > m + 10 * np.sqrt(2 * m):
        what = f"a reading's squared distance from an ensemble's belief is {most:.0f}, not {m}"
    else:
        return
    warn_of_collapse(what, "rejuvenation=")


def repeat_by_count(points: Any, counts: Indices) -> Any:
    """Rows of points (..., N, d), each as often as its count (..., N), N in all."""
    rows = points.reshape(-1, points.shape[-1])
    return np.repeat(rows, counts.reshape(-1), axis=0).reshape(points.shape)


@validated
def resample(probabilities: Annotated[Probabilities, "... n"], *, rng: Rng) -> Indices:
    """Draw N indices, each as often as its weight says on average: systematic resampling.

    One random number serves all, so that an index appears within one of N times its weight.

    Parameters
    ----------
    probabilities : array_like, (..., N)
        Weights that sum to one.
    rng : numpy.random.Generator

    Returns
    -------
    ndarray of int, (..., N)
        Indices, in ascending order.

    Notes
    -----
    R. Douc, O. Cappé, E. Moulines, Image and Signal Processing and Analysis (2005) 64-69.

    Examples
    --------
    >>> resample([0.5, 0.0, 0.25, 0.25], rng=np.random.default_rng(0))
    array([0, 0, 2, 3])
    """
    counts = systematic_counts(
        probabilities, rng.random((*probabilities.shape[:-1], 1))
    )
    each = np.broadcast_to(np.arange(counts.shape[-1])[:, None], (*counts.shape, 1))
    return np.asarray(repeat_by_count(each, counts)[..., 0])


def systematic_counts(w: Array, offset: Array) -> Indices:
    """How many of the levels (k + offset) / N each weight (..., N) holds."""
    n = w.shape[-1]
    # How many levels lie below each edge; the last edge has all of them.
    levels = w.cumsum(axis=-1)
    levels /= levels[..., -1:].copy()
    levels *= n
    levels -= offset
    counts: Indices = np.ceil(levels, out=levels).astype(np.intp)
    counts[..., -1] = n
    counts[..., 1:] -= counts[..., :-1]
    return counts


@validated
def jitter(
    points: Annotated[Array, "... n d"],
    *,
    rng: Rng,
    bandwidth: Bandwidth,
    cov: PositiveSemidefinite | None = None,
) -> Array:
    r"""Move equally weighted particles apart without moving their mean or covariance.

    .. math:: \mathbf x_i' = \bar{\mathbf x} + \sqrt{1-h^2}\,(\mathbf x_i-\bar{\mathbf x})
        + h\,\mathbf C^{1/2}\boldsymbol\xi_i

    Copies of one particle separate, which a model without noise never does for them.

    Parameters
    ----------
    points : array_like, (..., N, d)
    rng : numpy.random.Generator
    bandwidth : float
        The kernel's width h, in (0, 1].
    cov : array_like, (..., d, d), optional
        C; by default the particles' own. When one weight dominated before resampling the copies
        have none: pass the covariance of the unweighted particles.

    Returns
    -------
    ndarray, (..., N, d)
        Mean and covariance are kept on average where C is the particles' own.

    Notes
    -----
    J. Liu, M. West, in: Sequential Monte Carlo Methods in Practice (2001) 197-223.

    Examples
    --------
    >>> copies = np.zeros((4, 1))
    >>> moved = jitter(copies, rng=np.random.default_rng(0), bandwidth=0.1, cov=[[1.0]])
    >>> len(set(moved.ravel().tolist()))
    4
    """
    if cov is None:
        around = points - points.mean(axis=-2, keepdims=True)
        cov = around.mT @ around / points.shape[-2]
    return add_jitter(points, cov, bandwidth, rng.standard_normal(points.shape))


def silverman(n: int, d: int) -> float:
    """The bandwidth for n particles of d components, at most one."""
    return float(min(1.0, (4 / (n * (d + 2))) ** (1 / (d + 4))))


def add_jitter(
    x: Array, cov: Array, h: float, drawn: Array, copied: Mask | None = None
) -> Array:
    """As :func:`jitter`, with standard normal draws.

    Where it is known which were copied, these alone move: C. Musso, N. Oudjane, F. Le Gland, in the
    same book, 247-271.
    """
    moved = drawn @ factor(cov).mT
    if copied is not None:
        return np.asarray(np.where(copied[..., None], x + h * moved, x))
    centre = x.mean(axis=-2, keepdims=True)
    return np.asarray(centre + np.sqrt(1 - h * h) * (x - centre) + h * moved)


def reweight(
    log_weights: Array, predicted: Array, observed: Array, noise: Array
) -> Array:
    """Log-weights (..., N), normalised, after a reading; refused where it rules out every point."""
    joint = log_weights + log_likelihood(predicted, observed, noise)
    total = log_sum(joint)
    if not all_finite(total):
        raise ArithmeticError("every particle has a likelihood of zero")
    # A weight of zero is minus infinity; kept finite, so that it can be told from failure.
    return np.asarray(np.maximum(joint - total, -1e300))


def log_likelihood(predicted: Array, observed: Array, noise: Array) -> Array:
    """Log-likelihood of each particle's prediction (..., N, m) but for a constant, (..., N)."""
    # Components first: sums over a few of them then run along all particles.
    gap = np.subtract(observed[..., None], predicted.mT, order="C")
    cov = noise
    if not all_finite(gap):
        missing = np.asarray(np.isnan(gap).any(axis=-1))
        # A missing component gets a zero residual and a unit of its own in R.
        here = ~missing[..., :, None] & ~missing[..., None, :]
        cov = np.where(here, noise, np.eye(noise.shape[-1]))
        gap = np.where(missing[..., None], 0.0, gap)
    # One solve with all particles as right-hand sides: the factor is the same for them.
    half = np.ascontiguousarray(solve_lower(cholesky(cov), gap))
    return np.asarray(-0.5 * (half * half).sum(axis=-2))


def distinct_fraction(points: Array) -> Array:
    """Share of particles that differ from all before them in the component that tells most, (...).

    Mostly that is the first, but it may be known exactly.

    >>> one, other = (
    ...     np.array([[0.0, 1.0], [0.0, 2.0]]),
    ...     np.array([[1.0, 0.0], [2.0, 0.0]]),
    ... )
    >>> distinct_fraction(np.stack([one, other]))
    array([1., 1.])
    """
    changes = (points[..., 1:, :] != points[..., :-1, :]).sum(axis=-2, keepdims=True)
    x = np.sort(
        np.take_along_axis(points, changes.argmax(axis=-1, keepdims=True), axis=-1)[
            ..., 0
        ]
    )
    return np.asarray((1 + (x[..., 1:] > x[..., :-1]).sum(axis=-1)) / points.shape[-2])
