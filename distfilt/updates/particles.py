"""Weighted particles: weights from likelihoods, four ways to resample, and jitter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, choice, covariance, generator, number, weights
from ..linalg import _cholesky, _solve_lower, factor

__all__ = ["RESAMPLING", "Particles", "effective_size", "jitter", "resample", "resampled"]

Indices = NDArray[np.intp]

RESAMPLING = ("systematic", "stratified", "residual", "multinomial")
"""The names of the rules by which :func:`resampled` draws."""


@dataclass(frozen=True, eq=False)
class Particles:
    """Weighted members of a distribution.

    Parameters
    ----------
    points : array_like, (..., N, d)
    log_weights : array_like, (..., N)
        Logarithms of the weights; they are normalised here, and -inf is a weight of zero.

    Examples
    --------
    >>> cloud = Particles([[0.0], [4.0]], np.log([3.0, 1.0]))
    >>> cloud.mean, cloud.covariance
    (array([1.]), array([[3.]]))
    """

    points: Array
    log_weights: Array

    def __post_init__(self) -> None:
        points = array(self.points, "points", (..., "N", "d"))
        log_weights = _normalised(self.log_weights, points.shape[:-1])
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "log_weights", log_weights)

    @property
    def weights(self) -> Array:
        """The weights, (..., N); they sum to one."""
        return np.asarray(np.exp(self.log_weights))

    @property
    def mean(self) -> Array:
        """Weighted mean, (..., d)."""
        return np.asarray((self.weights[..., None, :] @ self.points)[..., 0, :])

    @property
    def covariance(self) -> Array:
        """Weighted covariance, (..., d, d)."""
        around = self.points - self.mean[..., None, :]
        return np.asarray(np.swapaxes(around, -1, -2) @ (self.weights[..., None] * around))


def _normalised(log_weights: ArrayLike, shape: tuple[int, ...]) -> Array:
    w = array(log_weights, "log_weights", shape, finite=False)
    if np.isnan(w).any() or np.isposinf(w).any():
        raise ValueError("log_weights: needs numbers below infinity, got NaN or infinity")
    if np.isneginf(w.max(axis=-1)).any():
        raise ValueError("log_weights: needs a positive weight in every set, got only zeros")
    return w - _log_sum(w)


def effective_size(log_weights: ArrayLike) -> Array:
    r"""Effective sample size :math:`1/\sum_i w_i^2`: N for equal weights, 1 for a single one.

    It knows weights only: copies of one particle with equal weights count as N.

    Parameters
    ----------
    log_weights : array_like, (..., N)
        Logarithms of weights, in any normalisation.

    Examples
    --------
    >>> float(effective_size(np.log([0.5, 0.25, 0.25])).round(4))
    2.6667
    """
    w = array(log_weights, "log_weights", (..., "N"), finite=False)
    if not w.shape[-1]:
        raise ValueError(f"log_weights: needs at least one, got shape {w.shape}")
    return _effective_size(_normalised(w, w.shape))


def _effective_size(log_weights: Array) -> Array:
    """As the public one, of normalised weights."""
    return _size_of(np.exp(log_weights))


def _size_of(w: Array) -> Array:
    return np.asarray(1 / (w * w).sum(axis=-1))


def _taken(points: Array, picked: Indices) -> Array:
    """Rows of points (..., N, d) by their indices (..., N)."""
    n, d = points.shape[-2:]
    first = n * np.arange(picked.size // n)[:, None]
    rows = (picked.reshape(-1, n) + first).ravel()
    return np.asarray(points.reshape(-1, d)[rows].reshape(points.shape))


def _log_sum(logs: Array) -> Array:
    """Logarithm of the sum of exponentials (..., 1), a tenth of scipy's time for short vectors."""
    most = logs.max(axis=-1, keepdims=True)
    most = np.where(np.isfinite(most), most, 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(most + np.log(np.exp(logs - most).sum(axis=-1, keepdims=True)))


def resampled(
    probabilities: ArrayLike, *, rng: np.random.Generator, rule: str = "systematic"
) -> Indices:
    """Draw N indices, each as often as its weight says on average.

    Parameters
    ----------
    probabilities : array_like, (..., N)
        Weights that sum to one.
    rng : numpy.random.Generator
    rule : {"systematic", "stratified", "residual", "multinomial"}
        One random number for all, so that an index appears within one of N times its weight; one
        in each of N equal strata; the whole part of N times the weight for sure and the rest
        systematically; or N independent draws, which vary most.

    Returns
    -------
    ndarray of int, (..., N)
        Indices; in ascending order but for the rule ``"residual"``.

    Notes
    -----
    R. Douc, O. Cappé, E. Moulines, Image and Signal Processing and Analysis (2005) 64-69.

    Examples
    --------
    >>> resampled([0.5, 0.0, 0.25, 0.25], rng=np.random.default_rng(0))
    array([0, 0, 2, 3])
    """
    w = weights(probabilities, "probabilities")
    return _resampled(w, generator(rng), choice(rule, "rule", RESAMPLING))


def _resampled(w: Array, rng: np.random.Generator, rule: str) -> Indices:
    return _picked(w, _levels(w.shape, rng, rule), rule)


def _levels(shape: tuple[int, ...], rng: np.random.Generator, rule: str) -> Array:
    """The random numbers that a rule needs; as many whatever the weights are."""
    one = rule in ("systematic", "residual")
    return rng.random((*shape[:-1], 1 if one else shape[-1]))


def _picked(w: Array, drawn: Array, rule: str) -> Indices:
    """The indices of weights (..., N) that the random numbers of :func:`_levels` pick."""
    n = w.shape[-1]
    if rule == "residual":
        return _residual(w, drawn)
    if rule == "systematic":
        return _systematic(w, drawn)
    levels = (np.arange(n) + drawn) / n if rule == "stratified" else np.sort(drawn, axis=-1)
    edges = _edges(w).reshape(-1, n)
    # Rounding must not leave a level at the last edge: it would pick an index beyond the weights.
    inside = np.minimum(levels, np.nextafter(1.0, 0.0)).reshape(-1, n)
    rows = [np.searchsorted(e, u, side="right") for e, u in zip(edges, inside, strict=True)]
    return np.array(rows, dtype=np.intp).reshape(w.shape)


def _edges(w: Array) -> Array:
    edges = np.cumsum(w, axis=-1)
    return np.asarray(edges / edges[..., -1:])


def _systematic(w: Array, offset: Array) -> Indices:
    """Index of the weight that holds each of the levels (k + offset) / n."""
    n = w.shape[-1]
    # How many levels lie below each edge; the last edge has all of them.
    levels = n * _edges(w)
    levels -= offset
    below = np.ceil(levels, out=levels).clip(0, n, out=levels).astype(np.intp)
    below[..., -1] = n
    copies = below.copy()
    copies[..., 1:] -= below[..., :-1]
    return _repeated(copies)


def _repeated(copies: Indices) -> Indices:
    """Each index of the last axis as often as its count says; N in all."""
    n = copies.shape[-1]
    each = np.arange(n) if copies.size == n else np.tile(np.arange(n), copies.size // n)
    return np.repeat(each, copies.reshape(-1)).reshape(copies.shape)


def _residual(w: Array, offset: Array) -> Indices:
    n = w.shape[-1]
    scaled = n * w
    sure = np.floor(scaled + 1e-12 * n).astype(np.intp)
    rest = np.clip(scaled - sure, 0.0, None)
    left = n - sure.sum(axis=-1)
    total = rest.sum(axis=-1, keepdims=True)
    edges = np.cumsum(rest, axis=-1) / np.where(total > 0, total, 1.0)
    below = np.clip(np.ceil(left[..., None] * edges - offset), 0, left[..., None]).astype(np.intp)
    below[..., -1] = left
    return _repeated(sure + np.diff(below, axis=-1, prepend=0))


def resample(
    particles: Particles, *, rng: np.random.Generator, rule: str = "systematic"
) -> Particles:
    """Replace weighted particles by equally weighted copies.

    Parameters
    ----------
    particles, rng, rule
        What to resample; the others as for :func:`resampled`.

    Examples
    --------
    >>> cloud = Particles([[0.0], [4.0]], [0.0, -np.inf])
    >>> resample(cloud, rng=np.random.default_rng(0)).points.ravel()
    array([0., 0.])
    """
    if not isinstance(particles, Particles):
        raise ValueError(f"particles: needs Particles, got {type(particles).__name__}")
    w = particles.weights
    picked = _resampled(w, generator(rng), choice(rule, "rule", RESAMPLING))
    points = np.take_along_axis(particles.points, picked[..., None], axis=-2)
    return Particles(points, np.zeros(w.shape))


def jitter(
    points: ArrayLike, *, rng: np.random.Generator, bandwidth: float | None = None,
    cov: ArrayLike | None = None,
) -> Array:
    r"""Move equally weighted particles apart without moving their mean or covariance.

    .. math:: \mathbf x_i' = \bar{\mathbf x} + \sqrt{1-h^2}\,(\mathbf x_i-\bar{\mathbf x})
        + h\,\mathbf C^{1/2}\boldsymbol\xi_i

    Copies of one particle separate, which a model without noise never does for them.

    Parameters
    ----------
    points : array_like, (..., N, d)
    rng : numpy.random.Generator
    bandwidth : float, optional
        The kernel's width h, in (0, 1]; by default Silverman's
        :math:`(4/(N(d+2)))^{1/(d+4)}`, at most one.
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
    x = array(points, "points", (..., "N", "d"))
    n, d = x.shape[-2:]
    if not n:
        raise ValueError(f"points: needs at least one, got shape {x.shape}")
    h = min(1.0, (4 / (n * (d + 2))) ** (1 / (d + 4)))
    if bandwidth is not None:
        h = number(bandwidth, "bandwidth", above=0, at_most=1)
    if cov is None:
        around = x - x.mean(axis=-2, keepdims=True)
        c = np.swapaxes(around, -1, -2) @ around / n
    else:
        c = covariance(cov, "cov", d, semidefinite=True)
    return _jittered(x, c, h, generator(rng).standard_normal(x.shape))


def _jittered(x: Array, cov: Array, h: float, drawn: Array) -> Array:
    centre = x.mean(axis=-2, keepdims=True)
    moved = drawn @ np.swapaxes(factor(cov), -1, -2)
    return np.asarray(centre + np.sqrt(1 - h * h) * (x - centre) + h * moved)

def _weighed(log_weights: Array, predicted: Array, observed: Array, noise: Array) -> Array:
    """Log-weights (..., N), normalised, after a reading; refused where it rules out every point."""
    joint = log_weights + _log_likelihood(predicted, observed, noise)
    total = _log_sum(joint)
    if not np.isfinite(total).all():
        raise ArithmeticError("every particle has a likelihood of zero")
    # A weight of zero is minus infinity; kept finite, so that it can be told from failure.
    return np.asarray(np.maximum(joint - total, -1e300))


def _log_likelihood(predicted: Array, observed: Array, noise: Array) -> Array:
    """Log-likelihood of each particle's prediction (..., N, m) but for a constant, (..., N)."""
    # Components first: sums over a few of them then run along all particles.
    seen = np.ascontiguousarray(np.swapaxes(predicted, -1, -2))
    gap, cov = observed[..., None] - seen, noise
    missing = np.isnan(observed)
    if np.isnan(seen).any():
        missing = missing | np.isnan(seen).any(axis=-1)
    if missing.any():
        # A missing component gets a zero residual and a unit of its own in R.
        here = ~missing[..., :, None] & ~missing[..., None, :]
        cov = np.where(here, noise, np.eye(noise.shape[-1]))
        gap = np.where(missing[..., None], 0.0, gap)
    # One solve with all particles as right-hand sides: the factor is the same for them.
    half = np.ascontiguousarray(_solve_lower(_cholesky(cov), gap))
    return np.asarray(-0.5 * (half * half).sum(axis=-2))


def _distinct(points: Array) -> Array:
    """Share of particles that differ from all before them, (...)."""
    first = np.sort(points[..., 0], axis=-1)
    return np.asarray((1 + (first[..., 1:] > first[..., :-1]).sum(axis=-1)) / points.shape[-2])
