"""What the filters of this folder ask of sensors and of a series of observations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, covariance, increasing, instance, number
from ..linalg import _leading
from ..sensors import Sensor, stack

__all__: list[str] = []


def instantaneous(sensors: Sequence[Sensor]) -> Sensor:
    """The stacked sensor, if none of the sensors needs the previous state."""
    out = stack(sensors)
    if out.uses_previous:
        raise ValueError("sensors: needs sensors of the present state, got a differential sensor")
    return out


def series(observations: ArrayLike, times: ArrayLike, t0: float, dim: int) -> tuple[Array, Array]:
    """Observations (T, ..., m), and the T + 1 times of the prior and of the observations."""
    grid = increasing(times, "times")
    start = number(t0, "t0")
    if not grid.size:
        raise ValueError("times: needs at least one observation time, got none")
    if grid[0] <= start:
        raise ValueError(f"times: needs times after t0 = {start:g}, got {grid[0]:g}")
    y = array(observations, "observations", None, finite=False)
    if y.ndim < 2 or y.shape[0] != grid.size or y.shape[-1] != dim:
        raise ValueError(f"observations: needs shape ({grid.size}, ..., {dim}), got {y.shape}")
    if np.isinf(y).any():
        raise ValueError("observations: needs finite numbers or NaN (missing), got infinity")
    return y, np.concatenate([[start], grid])


def prior(
    mean: ArrayLike, cov: ArrayLike, dim: int | None = None, error_dim: int | None = None
) -> tuple[Array, Array]:
    """A mean (..., d) and a covariance (..., d, d), or of another size for errors."""
    x = array(mean, "mean", (..., "d" if dim is None else dim))
    return x, covariance(cov, "cov", x.shape[-1] if error_dim is None else error_dim)


def common_runs(runs: tuple[int, ...], mean: Array, cov: Array) -> tuple[int, ...]:
    """The run axes that observations, prior means and prior covariances have in common."""
    for name, axes in (("mean", mean.shape[:-1]), ("cov", cov.shape[:-2])):
        runs = _leading(runs, axes, name)
    return runs


def fill_axes(y: Array, count: int) -> Array:
    """Insert run axes of length one after time, as broadcasting would in front."""
    missing = count - (y.ndim - 2)
    return y.reshape(y.shape[:1] + (1,) * missing + y.shape[1:])


def flat(
    mean: ArrayLike, cov: ArrayLike, runs: tuple[int, ...], dim: int | None = None
) -> tuple[Array, Array, tuple[int, ...]]:
    """Means (R, d) and covariances (R, d, d) with one run axis, and the axes it stands for."""
    x, p = prior(mean, cov, dim)
    d = x.shape[-1]
    runs = common_runs(runs, x, p)
    x, p = np.broadcast_to(x, (*runs, d)), np.broadcast_to(p, (*runs, d, d))
    return x.reshape(-1, d), p.reshape(-1, d, d), runs


def in_front(runs: tuple[int, ...], x: Array, p: Array) -> tuple[Array, Array]:
    """Means and covariances with their own run axes again."""
    return x.reshape(*runs, x.shape[-1]), p.reshape(*runs, *p.shape[-2:])


def reading(observed: ArrayLike, sensor: Sensor) -> Array:
    """An observation (..., m) of a sensor of the present state."""
    instance(sensor, "sensor", Sensor)
    instantaneous([sensor])
    y = array(observed, "observed", (..., sensor.dim), finite=False)
    if np.isinf(y).any():
        raise ValueError("observed: needs finite numbers or NaN (missing), got infinity")
    return y
