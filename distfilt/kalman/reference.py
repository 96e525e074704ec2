"""The Kalman, extended and unscented filters of filterpy 2.0 behind the library's shapes.

They are slow (one run and one step at a time) and independently written: the reference that the
batched filters are compared with. Nothing else in the library imports filterpy.

Three habits of filterpy are guarded against here: states are vectors (d,), since a column state and
a flat observation silently give a matrix; missing components are taken out before filterpy sees
them, since NaN passes through without an error; and every update follows a forecast, since a second
update on the same sigma points can give a negative variance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, instance, needed
from ..models import Model
from ..sensors import Sensor
from ._inputs import common_runs, fill_axes, instantaneous, prior, series
from ._steps import Points
from .linear import GaussianRun, _noise_per_step, _per_step

_Mask = NDArray[np.bool_]

__all__ = ["filterpy_ekf", "filterpy_kf", "filterpy_ukf"]


def filterpy_kf(
    mean: ArrayLike, cov: ArrayLike, observations: ArrayLike, *, F: ArrayLike, H: ArrayLike,
    Q: ArrayLike, R: ArrayLike, likelihood: bool = True,
) -> GaussianRun:
    """Filterpy's Kalman filter over a series: arguments and result of :func:`kalman_filter`.

    Parameters
    ----------
    mean, cov, observations, F, H, Q, R : array_like
        As for :func:`distfilt.kalman.kalman_filter`.
    likelihood : bool
        Whether to ask filterpy for the log density of each observation, which takes longer than
        the filter. Without it `log_likelihood` is zero.

    Examples
    --------
    >>> run = filterpy_kf([0.0], [[1.0]], [[2.0]], F=[[1.0]], H=[[1.0]], Q=[[0.0]], R=[[1.0]])
    >>> run.means, run.covariances
    (array([[1.]]), array([[[0.5]]]))
    """
    filterpy = needed("filterpy.kalman", "reference")

    y = array(observations, "observations", None, finite=False)
    if y.ndim < 2 or np.isinf(y).any():
        raise ValueError(f"observations: needs (T, ..., m), finite or NaN, got shape {y.shape}")
    steps, m = y.shape[0], y.shape[-1]
    d = prior(mean, cov)[0].shape[-1]
    f, q = _per_step(F, "F", steps, (d, d)), _noise_per_step(Q, "Q", steps, d, semidefinite=True)
    h, r = _per_step(H, "H", steps, (m, d)), _noise_per_step(R, "R", steps, m)

    def start(x: Array, p: Array) -> Any:
        kf = filterpy.KalmanFilter(dim_x=d, dim_z=m)
        kf.x, kf.P = x.copy(), p.copy()
        return kf

    def step(kf: Any, k: int, z: Array, seen: _Mask) -> None:
        kf.predict(F=f[k], Q=q[k])
        if seen.all():
            kf.update(z, H=h[k], R=r[k])
        elif seen.any():
            kf.update(z[seen], H=h[k][seen], R=r[k][np.ix_(seen, seen)])

    return _over_runs(mean, cov, y, start, step, likelihood)


def filterpy_ekf(
    mean: ArrayLike, cov: ArrayLike, observations: ArrayLike, *, model: Model,
    sensors: Sequence[Sensor], times: ArrayLike, t0: float = 0.0, likelihood: bool = False,
) -> GaussianRun:
    r"""Filterpy's extended Kalman filter over a series: linearise the model and the sensors.

    Parameters
    ----------
    mean, cov, observations, model, sensors, times, t0
        As for :func:`~distfilt.kalman.extended_filter`.
    likelihood : bool
        As for :func:`filterpy_kf`.

    Examples
    --------
    >>> from distfilt.sensors import direct
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> run = filterpy_ekf([0.0], [[1.0]], [[3.0]], model=walk,
    ...                    sensors=[direct([0], std=1.0)], times=[1.0])
    >>> run.means.round(6)
    array([[2.]])
    """
    filterpy = needed("filterpy.kalman", "reference")

    instance(model, "model", Model)
    sensor = instantaneous(sensors)
    y, grid = series(observations, times, t0, sensor.dim)

    def start(x: Array, p: Array) -> Any:
        kf = filterpy.ExtendedKalmanFilter(dim_x=model.dim, dim_z=sensor.dim)
        kf.x, kf.P = x.copy(), p.copy()
        return kf

    def step(kf: Any, k: int, z: Array, seen: _Mask) -> None:
        t, dt = float(grid[k]), float(grid[k + 1] - grid[k])
        kf.F, kf.Q = model.jacobian(kf.x, t, dt), model.noise(t, dt)
        moved = model.step(kf.x, t, dt)
        kf.predict()
        kf.x = moved  # filterpy moves the mean with F; the model itself is the better step
        if seen.any():
            kf.update(
                z[seen],
                HJacobian=lambda x: sensor.jacobian(x)[seen],
                Hx=lambda x: sensor.predict(x)[seen],
                R=sensor.cov[np.ix_(seen, seen)],
                residual=_residual_of(sensor, seen),
            )

    return _over_runs(mean, cov, y, start, step, likelihood, model.dim)


def filterpy_ukf(
    mean: ArrayLike, cov: ArrayLike, observations: ArrayLike, *, model: Model,
    sensors: Sequence[Sensor], times: ArrayLike, t0: float = 0.0, alpha: float = 1.0,
    beta: float = 0.0, kappa: float = 1.0, likelihood: bool = False,
) -> GaussianRun:
    r"""Filterpy's unscented Kalman filter over a series: 2d + 1 points instead of derivatives.

    Parameters
    ----------
    mean, cov, observations, model, sensors, times, t0, likelihood
        As for :func:`filterpy_ekf`.
    alpha, beta, kappa : float
        As for :func:`~distfilt.kalman.unscented_predict`.

    Examples
    --------
    >>> from distfilt.sensors import direct
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> run = filterpy_ukf([0.0], [[1.0]], [[3.0]], model=walk,
    ...                    sensors=[direct([0], std=1.0)], times=[1.0])
    >>> run.means.round(6)
    array([[2.]])
    """
    instance(model, "model", Model)
    sensor = instantaneous(sensors)
    y, grid = series(observations, times, t0, sensor.dim)
    Points.of(model.dim, alpha, beta, kappa)  # refuses what it refuses of our own filter
    start = _unscented(model, sensor.dim, alpha, beta, kappa)

    def step(kf: Any, k: int, z: Array, seen: _Mask) -> None:
        t, dt = float(grid[k]), float(grid[k + 1] - grid[k])
        kf.Q = model.noise(t, dt)
        kf.predict(dt=dt, t=t)
        if seen.any():
            h = sensor.predict(kf.sigmas_f)
            # Readings that wrap are unwrapped: the points around the central one, the observation
            # around the points' mean. Plain differences are then right.
            h = h[0] + sensor.residual(h, np.broadcast_to(h[0], h.shape))
            middle = kf.Wm @ h
            near = middle + sensor.residual(z, middle)
            rows: Iterator[Array] = iter(h[:, seen])
            # filterpy calls hx once for each sigma point, in their order.
            kf.update(near[seen], R=sensor.cov[np.ix_(seen, seen)], hx=lambda s: next(rows))

    return _over_runs(mean, cov, y, start, step, likelihood, model.dim)


def _unscented(
    model: Model, observed: int, alpha: float, beta: float, kappa: float
) -> Callable[[Array, Array], Any]:
    """What starts filterpy's filter at a mean and a covariance."""
    filterpy = needed("filterpy.kalman", "reference")

    class Batched(filterpy.UnscentedKalmanFilter):  # type: ignore[misc, name-defined]
        """Moves all sigma points in one call of the model."""

        def compute_process_sigmas(self, dt: float, fx: Any = None, **fx_args: Any) -> None:
            points = self.points_fn.sigma_points(self.x, self.P)
            self.sigmas_f = model.step(points, fx_args["t"], dt)

    def start(x: Array, p: Array) -> Any:
        points = filterpy.MerweScaledSigmaPoints(model.dim, alpha, beta, kappa)
        kf = Batched(model.dim, observed, 0.0, None, None, points)
        kf.x, kf.P = x.copy(), p.copy()
        return kf

    return start


def _over_runs(
    mean: ArrayLike, cov: ArrayLike, y: Array, start: Callable[[Array, Array], Any],
    step: Callable[[Any, int, Array, _Mask], None], likelihood: bool, dim: int | None = None,
) -> GaussianRun:
    """Run one of filterpy's objects over every run and every step."""
    instance(likelihood, "likelihood", bool)
    x0, p0 = prior(mean, cov)
    d = x0.shape[-1]
    if dim is not None and d != dim:
        raise ValueError(f"mean: needs {dim} components like the model, got {d}")
    runs = common_runs(y.shape[1:-1], x0, p0)
    y = np.broadcast_to(fill_axes(y, len(runs)), (len(y), *runs, y.shape[-1]))
    x0, p0 = np.broadcast_to(x0, (*runs, d)), np.broadcast_to(p0, (*runs, d, d))
    means, covs = np.empty((len(y), *runs, d)), np.empty((len(y), *runs, d, d))
    density = np.zeros((len(y), *runs))
    for run in np.ndindex(runs):
        kf = start(x0[run], p0[run])
        for k in range(len(y)):
            z = y[(k, *run)]
            seen = ~np.isnan(z)
            step(kf, k, z, seen)
            means[(k, *run)], covs[(k, *run)] = kf.x, kf.P
            if likelihood and seen.any():
                density[(k, *run)] = kf.log_likelihood
    if not np.isfinite(means).all():
        raise np.linalg.LinAlgError("filterpy's filter ended in NaN")
    return GaussianRun(means, covs, density)


def _residual_of(sensor: Sensor, seen: _Mask) -> Callable[[Array, Array], Array]:
    """The sensor's residual on the observed components only."""

    def residual(a: Array, b: Array) -> Array:
        whole_a, whole_b = np.zeros(sensor.dim), np.zeros(sensor.dim)
        whole_a[seen], whole_b[seen] = a, b
        return np.asarray(sensor.residual(whole_a, whole_b)[seen])

    return residual
