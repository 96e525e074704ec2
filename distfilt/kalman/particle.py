"""The bootstrap particle filter: weigh draws of the forecast by the likelihood, then resample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, choice, count, generator, number, weights
from ..linalg import cholesky_solve
from ..models import Model
from ..sensors import Sensor
from ._inputs import instantaneous, series

__all__ = [
    "ParticleRun",
    "Particles",
    "effective_size",
    "particle_filter",
    "resample",
    "systematic",
]


_Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Particles:
    """Weighted members of a distribution.

    Parameters
    ----------
    points : array_like, (..., N, d)
    log_weights : array_like, (..., N)
        Logarithms of the weights; they are normalised here, and -inf is a weight of zero.

    Raises
    ------
    ValueError
        If the shapes differ, a point is not finite, or all weights of a set are zero.

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
    top = w.max(axis=-1, keepdims=True)
    if np.isneginf(top).any():
        raise ValueError("log_weights: needs a positive weight in every set, got only zeros")
    # Subtracting the largest first keeps the sum from underflowing.
    total = top + np.log(np.exp(w - top).sum(axis=-1, keepdims=True))
    return np.asarray(w - total)


@dataclass(frozen=True)
class ParticleRun:
    """What a particle filter leaves behind.

    Attributes
    ----------
    means : ndarray, (T, ..., d)
        Weighted means after each observation, before resampling.
    covariances : ndarray, (T, ..., d, d)
        Weighted covariances, likewise.
    effective : ndarray, (T, ...)
        Effective sample sizes, likewise, between 1 and N.
    log_likelihood : ndarray, (T, ...)
        Logarithm of the estimated density of each observation given those before it.
    final : Particles
        The particles after the last observation.

    Examples
    --------
    >>> run = ParticleRun(np.zeros((3, 2)), np.zeros((3, 2, 2)), np.ones(3), np.zeros(3),
    ...                   Particles(np.zeros((9, 2)), np.zeros(9)))
    >>> run.final.weights.sum().round(6)
    np.float64(1.0)
    """

    means: Array
    covariances: Array
    effective: Array
    log_likelihood: Array
    final: Particles


def effective_size(log_weights: ArrayLike) -> Array:
    r"""Effective sample size :math:`1/\sum_i w_i^2`: N for equal weights, 1 for a single one.

    Parameters
    ----------
    log_weights : array_like, (..., N)
        Logarithms of weights, in any normalisation.

    Raises
    ------
    ValueError
        If all weights are zero or one is not a number.

    Examples
    --------
    >>> float(effective_size(np.log([0.5, 0.25, 0.25])).round(4))
    2.6667
    """
    w = array(log_weights, "log_weights", (..., "N"), finite=False)
    return np.asarray(np.exp(-_log_sum(2.0 * _normalised(w, w.shape))))


def _log_sum(values: Array) -> Array:
    top = values.max(axis=-1)
    return np.asarray(top + np.log(np.exp(values - top[..., None]).sum(axis=-1)))


def systematic(probabilities: ArrayLike, *, rng: np.random.Generator) -> _Indices:
    """Draw N indices with one random number: each index appears within one of N times its weight.

    Parameters
    ----------
    probabilities : array_like, (..., N)
        Weights that sum to one.
    rng : numpy.random.Generator

    Returns
    -------
    ndarray of int, (..., N)
        Indices in ascending order.

    Raises
    ------
    ValueError
        If a weight is negative or the sum is not one.

    Notes
    -----
    G. Kitagawa, Journal of Computational and Graphical Statistics 5 (1996) 1-25.

    Examples
    --------
    >>> systematic([0.5, 0.0, 0.25, 0.25], rng=np.random.default_rng(0))
    array([0, 0, 2, 3])
    """
    w = weights(probabilities, "probabilities")
    n = w.shape[-1]
    offset = generator(rng).random((*w.shape[:-1], 1))
    return _invert(w, (np.arange(n) + offset) / n)


def _multinomial(w: Array, rng: np.random.Generator) -> _Indices:
    return _invert(w, np.sort(rng.random(w.shape), axis=-1))


def _invert(w: Array, levels: Array) -> _Indices:
    """Index whose share of the cumulated weights holds each level."""
    n = w.shape[-1]
    edges = np.cumsum(w, axis=-1)
    edges = (edges / edges[..., -1:]).reshape(-1, n)
    # Rounding must not leave a level at the last edge: it would pick an index beyond the weights.
    inside = np.minimum(levels, np.nextafter(1.0, 0.0)).reshape(-1, n)
    rows = [np.searchsorted(e, u, side="right") for e, u in zip(edges, inside, strict=True)]
    return np.array(rows, dtype=np.intp).reshape(levels.shape)


def resample(
    particles: Particles, *, rng: np.random.Generator, method: str = "systematic"
) -> Particles:
    """Replace weighted particles by equally weighted copies.

    Parameters
    ----------
    particles : Particles
    rng : numpy.random.Generator
    method : {"systematic", "multinomial"}
        Systematic has the smaller variance; multinomial draws independently.

    Raises
    ------
    ValueError
        If an argument is of another kind or the method is unknown.

    Examples
    --------
    >>> cloud = Particles([[0.0], [4.0]], [0.0, -np.inf])
    >>> resample(cloud, rng=np.random.default_rng(0)).points.ravel()
    array([0., 0.])
    """
    if not isinstance(particles, Particles):
        raise ValueError(f"particles: needs Particles, got {type(particles).__name__}")
    generator(rng)
    w = particles.weights
    if choice(method, "method", ("systematic", "multinomial")) == "systematic":
        picked = systematic(w, rng=rng)
    else:
        picked = _multinomial(w, rng)
    points = np.take_along_axis(particles.points, picked[..., None], axis=-2)
    return Particles(points, np.zeros(w.shape))


def particle_filter(
    points: ArrayLike,
    observations: ArrayLike,
    *,
    model: Model,
    sensors: Sequence[Sensor],
    times: ArrayLike,
    rng: np.random.Generator,
    t0: float = 0.0,
    threshold: float = 0.5,
    method: str = "systematic",
) -> ParticleRun:
    """Run the bootstrap particle filter over a series of observations, for any number of runs.

    Parameters
    ----------
    points : array_like, (..., N, d)
        Equally weighted members of the prior at `t0`; leading axes are runs.
    observations : array_like, (T, ..., m)
        The observations of all sensors, one after the other; NaN marks a missing component.
    model : Model
    sensors : sequence of Sensor
        Sensors of the present state.
    times : array_like, (T,)
        Observation times, in s.
    rng : numpy.random.Generator
    t0 : float
        The time of the prior, in s.
    threshold : float
        A run resamples when its effective sample size falls below this share of N, in [0, 1].
    method : {"systematic", "multinomial"}

    Returns
    -------
    ParticleRun

    Raises
    ------
    ValueError
        If a shape, a time or an option is wrong.

    Notes
    -----
    N. J. Gordon, D. J. Salmond, A. F. M. Smith, IEE Proceedings F 140 (1993) 107-113.

    Examples
    --------
    >>> from distfilt.sensors import direct
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> rng = np.random.default_rng(1)
    >>> run = particle_filter(rng.standard_normal((500, 1)), [[3.0]], model=walk,
    ...                       sensors=[direct([0], std=1.0)], times=[1.0], rng=rng)
    >>> run.means.round(1)
    array([[2.]])
    """
    sensor = instantaneous(sensors)
    start = array(points, "points", (..., "N", model.dim))
    y, grid = series(observations, times, t0, sensor.dim)
    runs = np.broadcast_shapes(start.shape[:-2], y.shape[1:-1])
    limit = number(threshold, "threshold", at_least=0, at_most=1) * count(
        start.shape[-2], "points"
    )
    choice(method, "method", ("systematic", "multinomial"))
    now = np.broadcast_to(start, (*runs, *start.shape[-2:]))
    cloud = Particles(now, np.zeros(now.shape[:-1]))
    means, covs, sizes, density = [], [], [], []
    for k in range(len(y)):
        moved = model.sample_step(cloud.points, grid[k], grid[k + 1] - grid[k], rng=rng)
        joint = cloud.log_weights + _log_likelihood(sensor, y[k], moved)
        density.append(_log_sum(joint))
        cloud = Particles(moved, joint)
        means.append(cloud.mean)
        covs.append(cloud.covariance)
        sizes.append(effective_size(cloud.log_weights))
        cloud = _resample_where(cloud, sizes[-1] < limit, rng, method)
    return ParticleRun(np.array(means), np.array(covs), np.array(sizes), np.array(density), cloud)


def _resample_where(
    cloud: Particles, poor: NDArray[np.bool_], rng: np.random.Generator, method: str
) -> Particles:
    """Resample the runs marked in `poor` (...), keep the others."""
    if not poor.any():
        return cloud
    fresh = resample(cloud, rng=rng, method=method)
    return Particles(
        np.where(poor[..., None, None], fresh.points, cloud.points),
        np.where(poor[..., None], fresh.log_weights, cloud.log_weights),
    )


def _log_likelihood(sensor: Sensor, y: Array, x: Array) -> Array:
    """Log density of the observations (..., m) for each particle, (..., N)."""
    h = sensor.predict(x)
    observed = np.broadcast_to(y[..., None, :], h.shape)
    gap = sensor.residual(observed, h)
    seen = ~np.isnan(y)
    # A missing component gets a zero residual and a unit of its own in R: it adds a factor one.
    here = seen[..., :, None] & seen[..., None, :]
    noise = np.where(here, sensor.cov, np.eye(sensor.dim))
    gap = np.where(seen[..., None, :], gap, 0.0)
    solved = np.swapaxes(cholesky_solve(noise, np.swapaxes(gap, -1, -2)), -1, -2)
    log_det = np.linalg.slogdet(noise)[1]
    size = seen.sum(axis=-1) * np.log(2 * np.pi)
    return np.asarray(-0.5 * ((gap * solved).sum(axis=-1) + (log_det + size)[..., None]))
