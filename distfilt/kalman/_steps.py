"""Forecast and analysis of the nonlinear Kalman filters on means (R, d) and covariances (R, d, d).

Without checks; what a caller sees is in `nonlinear` and `multiplicative`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, number
from ..linalg import _symmetrise
from ..models import Model
from ..sensors import Sensor
from ._algebra import analysis, forecast_cov
from ._inputs import common_runs, fill_axes, prior
from .linear import GaussianRun

__all__: list[str] = []

Forecast = Callable[[Array, Array, float, float], tuple[Array, Array]]
Analysis = Callable[[Array, Array, Array], tuple[Array, Array, Array]]


def extended_forecast(x: Array, p: Array, model: Model, t: float, dt: float) -> tuple[Array, Array]:
    """Means moved by the model, covariances by its Jacobian."""
    slope = model._jacobian(x, t, dt)
    return model._step(x, t, dt), moved_cov(p, slope, model.noise(t, dt))


def moved_cov(p: Array, slope: Array, noise: Array) -> Array:
    """J P J' + Q for stacks (R, d, d); J and Q may be one for all."""
    out = forecast_cov(last(p), last(slope), last(noise))
    return np.ascontiguousarray(np.moveaxis(out, -1, 0))


def last(a: Array) -> Array:
    """A stack (R, …) with the runs last; a single matrix as it is."""
    return np.ascontiguousarray(np.moveaxis(a, 0, -1)) if a.ndim == 3 else a


def extended_analysis(x: Array, p: Array, y: Array, sensor: Sensor) -> tuple[Array, Array, Array]:
    """Means, covariances and log densities after readings (R, m) of a linearised sensor."""
    innovation, slope = linearised(x, y, sensor)
    moved, p, density = analysed(np.zeros_like(x), p, innovation, slope, sensor.cov)
    if not np.isfinite(moved).all():
        raise np.linalg.LinAlgError("mean: needs a prediction without overflow, got infinity")
    return x + moved, p, density


def linearised(
    x: Array, y: Array, sensor: Sensor, previous: Array | None = None
) -> tuple[Array, Array]:
    """Innovations (R, m), NaN where missing, and the sensor's Jacobian, (R, m, d) or (m, d)."""
    innovation = sensor._residual(y, sensor._predict(x, previous))
    slope = sensor._jacobian(x, previous)
    if slope.ndim == 3:
        # Where there is no prediction there is no derivative either; the row is not used.
        slope = np.where(np.isnan(innovation)[..., None], 0.0, slope)
    if not np.isfinite(slope).all():
        raise ValueError("sensor: needs a finite derivative where it has a prediction")
    return innovation, slope


def analysed(
    x: Array, p: Array, innovation: Array, slope: Array, noise: Array
) -> tuple[Array, Array, Array]:
    """The linear analysis of every run by itself."""
    r = len(x)
    mean, stack, density = analysis(
        np.ascontiguousarray(x.T), last(p), innovation.T, last(slope), noise, np.arange(r)
    )
    stack = np.ascontiguousarray(np.moveaxis(stack, -1, 0))
    return np.ascontiguousarray(mean.T), stack, density


_NEAR = 1e-9
"""Squared distance of the points, for each component, below which sums lose half their digits."""
_FAR = 1e6
"""Larger options weigh the rounding of the central point by more than 1e12."""


@dataclass(frozen=True, eq=False)
class Points:
    """Weights of the mean and of the covariance, (2 d + 1,), and the points' distance."""

    mean: Array
    cov: Array
    distance: float

    @classmethod
    def of(cls, dim: int, alpha: float, beta: float, kappa: float) -> Points:
        """The scaled points of `dim` components."""
        a = number(alpha, "alpha", above=0, at_most=_FAR)
        b = number(beta, "beta", at_least=0, at_most=_FAR)
        c = number(kappa, "kappa", above=-dim)
        spread = a**2 * (dim + c)
        if spread < _NEAR * dim:
            needs = f"points that rounding leaves apart, alpha^2 (d + kappa) >= {_NEAR * dim:.3g}"
            raise ValueError(f"alpha, kappa: needs {needs}, got {spread:.3g}")
        mean = np.full(2 * dim + 1, 0.5 / spread)
        mean[0] = 1.0 - dim / spread
        cov = mean.copy()
        cov[0] += 1.0 - a**2 + b
        return cls(mean, cov, float(np.sqrt(spread)))

    def around(self, x: Array, p: Array) -> Array:
        """The points of Gaussians, (R, 2 d + 1, d): the mean, then those on either side."""
        offsets = self.distance * np.swapaxes(np.linalg.cholesky(p), -1, -2)
        offsets = np.concatenate([np.zeros_like(x)[..., None, :], offsets, -offsets], axis=-2)
        return np.asarray(x[..., None, :] + offsets)


def unscented_forecast(
    x: Array, p: Array, model: Model, t: float, dt: float, points: Points
) -> tuple[Array, Array]:
    """Means and covariances of the points that the model has moved, and its noise."""
    moved = model._step(points.around(x, p), t, dt)
    mean = points.mean @ moved
    away = moved - mean[..., None, :]
    return mean, _weighted(away, points.cov) + model.noise(t, dt)


def _weighted(away: Array, weights: Array) -> Array:
    """Symmetric second moments (R, d, d) of deviations (R, n, d)."""
    return _symmetrise(np.swapaxes(away * weights[:, None], -1, -2) @ away)


def unscented_analysis(
    x: Array, p: Array, y: Array, sensor: Sensor, points: Points
) -> tuple[Array, Array, Array]:
    """Means, covariances and log densities after readings (R, m), by the points' predictions."""
    cloud = points.around(x, p)
    seen = sensor._predict(cloud)
    # Readings that wrap are unwrapped around the first point's; plain sums are then right.
    first = seen[..., :1, :]
    seen = first + sensor._residual(seen, np.broadcast_to(first, seen.shape))
    middle = points.mean @ seen
    innovation = sensor._residual(y, middle)
    here = ~np.isnan(innovation)
    away = np.where(here[..., None, :], seen - middle[..., None, :], 0.0)
    noise = np.where(here[..., None] & here[..., None, :], sensor.cov, 0.0)
    total = _weighted(away, points.cov) + noise + np.eye(sensor.dim) * ~here[..., None]
    try:
        lower = np.linalg.cholesky(total)
    except np.linalg.LinAlgError:
        raise np.linalg.LinAlgError("the innovation covariance is not positive definite") from None
    apart = cloud - x[..., None, :]
    cross = np.swapaxes(away * points.cov[:, None], -1, -2) @ apart
    gain = np.swapaxes(np.linalg.solve(total, cross), -1, -2)
    innovation = np.where(here, innovation, 0.0)
    # The points' form of Joseph's: what a point keeps of its deviation, and the noise let in.
    kept = apart - away @ np.swapaxes(gain, -1, -2)
    after = _weighted(kept, points.cov) + gain @ noise @ np.swapaxes(gain, -1, -2)
    white = np.linalg.solve(lower, innovation[..., None])[..., 0]
    log_det = 2.0 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=-1)
    size = here.sum(axis=-1)
    density = -0.5 * (size * np.log(2.0 * np.pi) + log_det + (white**2).sum(axis=-1))
    return x + (gain @ innovation[..., None])[..., 0], _symmetrise(after), density


def over_time(
    y: Array, grid: Array, mean: ArrayLike, cov: ArrayLike, dim: int, forecast: Forecast,
    analyse: Analysis, error_dim: int | None = None,
) -> GaussianRun:
    """Forecast and analysis of checked observations (T, ..., m) at times after the first of grid.

    `error_dim` is the covariance's size where it is not the state's.
    """
    size = dim if error_dim is None else error_dim
    x, p = prior(mean, cov, dim, size)
    runs = common_runs(y.shape[1:-1], x, p)
    steps, m = len(y), y.shape[-1]
    y = np.broadcast_to(fill_axes(y, len(runs)), (steps, *runs, m)).reshape(steps, -1, m)
    x = np.broadcast_to(x, (*runs, dim)).reshape(-1, dim)
    p = np.broadcast_to(p, (*runs, size, size)).reshape(-1, size, size)
    means, covs = np.empty((steps, *x.shape)), np.empty((steps, *p.shape))
    density = np.empty((steps, len(x)))
    for k in range(steps):
        t, after = float(grid[k]), float(grid[k + 1])
        try:
            x, p = forecast(x, p, t, after - t)
            x, p, density[k] = analyse(x, p, y[k])
        except np.linalg.LinAlgError as error:
            raise np.linalg.LinAlgError(f"at t = {after:g}: {error}") from None
        _finite(x, after, runs)
        means[k], covs[k] = x, p
    return GaussianRun(
        means.reshape(steps, *runs, dim),
        covs.reshape(steps, *runs, size, size),
        density.reshape(steps, *runs),
    )


def _finite(x: Array, t: float, runs: tuple[int, ...]) -> None:
    wrong = ~np.isfinite(x).all(axis=-1)
    if wrong.any():
        run = tuple(int(k) for k in np.unravel_index(int(np.argmax(wrong)), runs or (1,)))
        raise np.linalg.LinAlgError(f"at t = {t:g}: run {run} is no longer finite")
