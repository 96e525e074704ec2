"""Weighted particles: weights by likelihoods, systematic resampling, jitter, and collapse."""

from __future__ import annotations

import warnings
from typing import Annotated, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..coupling.transform import normalize_weights
from ..linalg import cholesky, factor, log_det, log_sum_exp, solve_lower
from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    Indices,
    Mask,
    PositiveSemidefinite,
    Probabilities,
    Rng,
    all_finite,
    validated,
)

__all__ = ["ParticleCollapse", "effective_size", "jitter", "resample"]

Bandwidth = Annotated[float, Bounds(above=0, at_most=1)]

E = TypeVar("E", bound=np.generic)


_FAR = 10
"""An observation is far from the predictions if its squared distance is so many standard deviations
above the mean."""


class ParticleCollapse(RuntimeWarning):
    """A belief depends on few members: the others are copies, or have no weight."""


def effective_size(log_weights: ArrayLike) -> Array:
    r"""Return the effective sample size :math:`1/\sum_i w_i^2`, between one and N.

    It depends on the weights only: copies of one particle with equal weights count as N.

    Parameters
    ----------
    log_weights : array_like, (..., N)
        Logarithms of weights, in any normalisation; minus infinity is a weight of zero.

    Examples
    --------
    >>> float(effective_size(np.log([0.5, 0.25, 0.25])).round(4))
    2.6667
    """
    return effective_size_of(normalize_weights(log_weights))


def effective_size_of(weights: Array) -> Array:
    """Return the effective sample size 1 / Σ w² of weights (..., N) that sum to one."""
    return np.asarray(1 / (weights * weights).sum(axis=-1))


def describe_collapse(problem: str, option: str) -> str:
    """Return the text of a warning that a belief depends on few members.

    It states the problem and names an option of the filter that helps.
    """
    return f"{problem}; use more members, {option}, or more process noise"


def warn_of_collapse(problem: str) -> None:
    """Warn the caller of an update by an ensemble that its belief depends on few members."""
    # The option of the filter that helps is rejuvenation.
    text = describe_collapse(problem, "rejuvenation=")
    warnings.warn(text, ParticleCollapse, stacklevel=4)


def warn_of_weights(
    log_weights: Array, predicted: Array, observed: Array, noise: Array
) -> None:
    """Warn if one member has all the weight, or the observation is far from the predictions.

    The squared Mahalanobis distance is taken from the mean of an ensemble's predictions, with their
    covariance plus the noise's. Far is ten of its standard deviations above its mean.

    Parameters
    ----------
    log_weights : ndarray, (..., N)
        Log-weights of the members, in any normalisation.
    predicted : ndarray, (..., N, m)
        Each member's prediction of the observation.
    observed : ndarray, (..., m)
        The observation; NaN where there is none.
    noise : ndarray, (m, m) or (..., m, m)
        Covariance of the observation noise.

    Examples
    --------
    The first of two members has all the weight:

    >>> predicted = np.array([[0.0], [1.0]])
    >>> with warnings.catch_warnings(action="error"):
    ...     warn_of_weights(np.array([0.0, -99.0]), predicted, np.zeros(1), np.eye(1))
    Traceback (most recent call last):
    distfilt.updates.particles.ParticleCollapse: an ensemble's weights have an effective size of ...

    Equal weights in two ensembles. The first has no observation; in the second it is 9, where 0
    and 1 are predicted:

    >>> observed = np.array([[np.nan], [9.0]])
    >>> with warnings.catch_warnings(action="error"):
    ...     warn_of_weights(np.zeros((2, 2)), predicted, observed, np.eye(1))
    Traceback (most recent call last):
    distfilt.updates.particles.ParticleCollapse: an observation's squared distance from an ...
    """
    weights = np.exp(log_weights - log_sum_exp(log_weights))
    # The initial value is for a batch without ensembles.
    smallest_size = effective_size_of(weights).min(initial=np.inf)
    # An effective size of 1.1 means that one member has 95 % of the weight.
    if smallest_size < 1.1:
        problem = f"an ensemble's weights have an effective size of {smallest_size:.1f}"
        warn_of_collapse(problem)
        return
    m = observed.shape[-1]
    # Of each observation from the mean of its predictions, in units of their covariance
    distances = _mahalanobis_squared(predicted, observed, noise)
    largest_distance = np.nanmax(distances, initial=0.0)
    # If the ensemble is consistent, the squared distance has a chi-squared distribution with m
    # degrees of freedom: its mean is m, its variance 2 m. Ten of its deviations are so many that
    # chance alone does not give a warning, even in a long run with heavier tails.
    if largest_distance > m + _FAR * np.sqrt(2 * m):
        problem = (
            f"an observation's squared distance from an ensemble's predictions is "
            f"{largest_distance:.0f}, not {m}"
        )
        warn_of_collapse(problem)


def _mahalanobis_squared(predicted: Array, observed: Array, noise: Array) -> Array:
    """Return the squared Mahalanobis distance of each observation from its predictions, (...).

    It is (y - ȳ)' (C + R)⁻¹ (y - ȳ), with the predictions' mean ȳ and covariance C. Shapes are
    those of :func:`warn_of_weights`; the distance is NaN where a component is. R is the noise's
    covariance.
    """
    mean = predicted.mean(axis=-2, keepdims=True)
    innovation = observed - mean[..., 0, :]
    anomalies = predicted - mean
    covariance = anomalies.mT @ anomalies / predicted.shape[-2] + noise
    whitened = np.linalg.solve(covariance, innovation[..., None])[..., 0]
    return np.asarray((innovation * whitened).sum(axis=-1))


def repeat_by_count(points: NDArray[E], counts: Indices) -> NDArray[E]:
    """Repeat the rows of points (..., N, d), each as often as its count (..., N), N in all."""
    # Counts sum to N in every ensemble, so one call can repeat the rows of a whole batch.
    rows = points.reshape(-1, points.shape[-1])
    return np.repeat(rows, counts.reshape(-1), axis=0).reshape(points.shape)


@validated
def resample(probabilities: Annotated[Probabilities, "... n"], *, rng: Rng) -> Indices:
    """Draw N indices by systematic resampling, each N times its weight on average.

    One random number serves all, so that a count differs from N times the weight by less than one.

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
    offset = rng.random((*probabilities.shape[:-1], 1))
    counts = systematic_counts(probabilities, offset)
    # Each index as a point of one component, repeated as often as it was drawn.
    indices = np.arange(counts.shape[-1])[:, None]
    each = np.broadcast_to(indices, (*counts.shape, 1))
    return np.asarray(repeat_by_count(each, counts)[..., 0])


def systematic_counts(weights: Array, offset: Array) -> Indices:
    """Return how often systematic resampling draws each particle, by its weight (..., N).

    The weights divide [0, 1] into N intervals. A particle is drawn once for each of the levels
    (k + offset) / N, k = 0, ..., N - 1, that lies in its interval. The offset (..., 1) is a uniform
    number from 0 to 1.
    """
    n = weights.shape[-1]
    # The ends of the intervals; rounding must not move the last one from 1.
    edges = weights.cumsum(axis=-1)
    # A copy of the last edge, which the division in place would change on its way.
    edges /= edges[..., -1:].copy()
    # (k + offset) / N < edge holds for ceil(N edge - offset) values of k, and all N lie below 1.
    edges *= n
    edges -= offset
    counts: Indices = np.ceil(edges, out=edges).astype(np.intp)
    counts[..., -1] = n
    # Levels below an interval's end, less those below its start.
    counts[..., 1:] -= counts[..., :-1]
    return counts


@validated
def jitter(
    points: Annotated[ArrayInput, "... n d"],
    *,
    rng: Rng,
    bandwidth: Bandwidth,
    cov: PositiveSemidefinite | None = None,
) -> Array:
    r"""Add noise to equally weighted particles that keeps their mean and covariance on average.

    .. math:: \mathbf x_i' = \bar{\mathbf x} + \sqrt{1-h^2}\,(\mathbf x_i-\bar{\mathbf x})
        + h\,\mathbf C^{1/2}\boldsymbol\xi_i

    Copies of one particle separate, which they would never do under a model without noise.

    Parameters
    ----------
    points : array_like, (..., N, d)
    rng : numpy.random.Generator
    bandwidth : float
        The kernel's width h, in (0, 1].
    cov : array_like, (..., d, d), optional
        C; by default the particles' covariance. If one weight dominated before resampling, the
        copies have none: pass the covariance of the unweighted particles.

    Returns
    -------
    ndarray, (..., N, d)
        Mean and covariance are kept on average if C is the particles' covariance.

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
    # C = sum (x_i - x̄)(x_i - x̄)' / N.
    if cov is None:
        anomalies = points - points.mean(axis=-2, keepdims=True)
        cov = anomalies.mT @ anomalies / points.shape[-2]
    return add_jitter(points, cov, bandwidth, rng.standard_normal(points.shape))


def silverman(n: int, d: int) -> float:
    """Return Silverman's bandwidth for n particles of d components, at most one.

    In units of the standard deviation it is the best for a Gaussian kernel and a Gaussian density:
    B. W. Silverman, Density Estimation for Statistics and Data Analysis (1986).
    """
    bandwidth = (4 / (n * (d + 2))) ** (1 / (d + 4))
    return float(min(1.0, bandwidth))


def add_jitter(
    points: Array,
    covariance: Array,
    bandwidth: float,
    normal: Array,
    is_copy: Mask | None = None,
) -> Array:
    """Add the noise of :func:`jitter` to points (..., N, d), made of standard normal draws.

    If `is_copy` (..., N) says which particles are copies of others, only they are moved, and not
    shrunk towards the mean, as in C. Musso, N. Oudjane, F. Le Gland, in: Sequential Monte Carlo
    Methods in Practice (2001) 247-271. The covariance is C, (..., d, d), the bandwidth h, and the
    draws (..., N, d).
    """
    # L ξ_i with C = L Lᵀ.
    noise = normal @ factor(covariance).mT
    if is_copy is not None:
        moved = points + bandwidth * noise
        return np.asarray(np.where(is_copy[..., None], moved, points))
    # The shrinkage takes as much covariance off as the noise adds.
    mean = points.mean(axis=-2, keepdims=True)
    shrinkage = np.sqrt(1 - bandwidth * bandwidth)
    return np.asarray(mean + shrinkage * (points - mean) + bandwidth * noise)


def reweight(
    log_weights: Array, predicted: Array, observed: Array, noise: Array
) -> Array:
    """Return normalised log-weights (..., N) after an observation (..., m), by Bayes' rule.

    `predicted` (..., N, m) are the particles' predictions, `noise` (..., m, m) is the covariance of
    the observation's noise. Raises an error if all likelihoods are zero.
    """
    # log w_i + log p(y | x_i), and the logarithm of their sum.
    log_likelihoods = log_likelihood(predicted, observed, noise, contradict=True)
    joint = log_weights + log_likelihoods
    total = log_sum_exp(joint)
    if not all_finite(total):
        raise ArithmeticError("every particle has a likelihood of zero")
    # The logarithm of a zero weight stays finite, though exp of it is zero: so minus infinity
    # never gets into a state, and differences of logarithms are never NaN.
    return np.asarray(np.maximum(joint - total, -1e300))


def log_likelihood(
    predicted: Array, observed: Array, noise: Array, *, contradict: bool = False
) -> Array:
    """Return the log-likelihood of each particle's prediction (..., N, m), up to a constant.

    A component that some particle cannot predict is left out. With `contradict` it is left out only
    if no particle can: otherwise those that cannot have a likelihood of zero. Observations are
    (..., m); `noise` is the covariance R of their noise, (m, m) or (..., m, m).

    >>> predicted = np.array([[1.0], [np.nan]])
    >>> log_likelihood(predicted, np.array([1.0]), np.eye(1), contradict=True)
    array([ -0., -inf])
    """
    # Components first: sums over a few of them then run along all particles.
    residual = np.subtract(observed[..., None], predicted.mT, order="C")
    covariance = noise
    contradicting: Mask | None = None
    if not all_finite(residual):
        # NaN where the observation is missing, or a particle cannot predict it: (..., m, N).
        is_unseen = np.isnan(residual)
        missing = np.asarray(is_unseen.any(axis=-1))
        if contradict:
            missing = np.asarray(is_unseen.all(axis=-1))
            # Particles that cannot predict a component which others can.
            contradicting = np.asarray((is_unseen & ~missing[..., None]).any(axis=-2))
            residual = np.where(is_unseen, 0.0, residual)
        # A missing component gets a zero residual and a unit variance of its own in R.
        present = ~missing
        both_present = present[..., :, None] & present[..., None, :]
        covariance = np.where(both_present, noise, np.eye(noise.shape[-1]))
        residual = np.where(missing[..., None], 0.0, residual)
    # -|L⁻¹ r|² / 2 with R = L Lᵀ: one solve with all particles as right-hand sides.
    whitened = solve_lower(cholesky(covariance), residual)
    logs = np.asarray(-0.5 * (whitened * whitened).sum(axis=-2))
    if contradicting is not None:
        logs[contradicting] = -np.inf
    return logs


def log_normalizer(observed: Array, noise: Array) -> Array:
    """Return the constant that :func:`log_likelihood` leaves out, (...), of observations (..., m).

    Missing components, which are NaN, do not count. The covariance of the noise is (m, m) or
    (..., m, m).

    >>> log_normalizer(np.array([[0.0, 0.0], [0.0, np.nan]]), np.eye(2)).round(4)
    array([-1.8379, -0.9189])
    """
    present = ~np.isnan(observed)
    # -(log det R + m log 2π) / 2 of the present components; the others have a unit variance.
    is_pair = present[..., :, None] & present[..., None, :]
    covariance = np.where(is_pair, noise, np.eye(noise.shape[-1]))
    size = present.sum(axis=-1)
    log_volume = log_det(cholesky(covariance))
    return np.asarray(-0.5 * (log_volume + size * np.log(2 * np.pi)))


def distinct_fraction(points: Array) -> Array:
    """Return the fraction of particles that differ from all others, (...).

    Points are (..., N, d), with copies of a particle one after another. They are compared in one
    component only: the one that changes most often from one particle to the next. Any one would
    do, but for those that are known exactly, in which all particles are equal.

    >>> exact_first = np.array([[0.0, 1.0], [0.0, 2.0]])
    >>> exact_last = np.array([[1.0, 0.0], [2.0, 0.0]])
    >>> distinct_fraction(np.stack([exact_first, exact_last]))
    array([1., 1.])
    """
    *lead, n, d = points.shape
    # Components first, so that comparisons and sums run along all particles.
    rows = np.ascontiguousarray(points.mT).reshape(-1, d, n)
    changes = (rows[..., 1:] != rows[..., :-1]).sum(axis=-1)
    chosen = rows[np.arange(len(rows)), changes.argmax(axis=-1)]
    # Sorted, equal values are neighbours: each increase is a new value.
    values = np.sort(chosen).reshape(*lead, n)
    increases = (values[..., 1:] > values[..., :-1]).sum(axis=-1)
    return np.asarray((1 + increases) / n)
