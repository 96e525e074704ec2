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
from typing import Annotated, Any

import numpy as np

from ..doors import MISSING, Array, Cov, Mask, Semidefinite, Times, door, needed
from ..models import Model
from ..sensors import Sensor, stack
from .linear import GaussianRun, flattened, grid, per_step, unflattened

__all__ = ["filterpy_ekf", "filterpy_kf", "filterpy_ukf"]


@door
def filterpy_kf(
    mean: Annotated[Array, "... d"],
    cov: Cov,
    observations: Annotated[Array, "... N m", MISSING],
    *,
    F: Annotated[Array, "... d d"],
    H: Annotated[Array, "... m d"],
    Q: Semidefinite,
    R: Annotated[Cov, "... m m"],
) -> GaussianRun:
    """Filterpy's Kalman filter over a series: arguments and result of :func:`kalman_filter`.

    Parameters
    ----------
    mean, cov, observations, F, H, Q, R : array_like
        As for :func:`distfilt.kalman.kalman_filter`.

    Examples
    --------
    >>> run = filterpy_kf([0.0], [[1.0]], [[2.0]], F=[[1.0]], H=[[1.0]], Q=[[0.0]], R=[[1.0]])
    >>> run.means, run.covariances
    (array([[1.]]), array([[[0.5]]]))
    """
    filterpy = needed("filterpy.kalman", "reference")

    f, h, q, r = per_step(len(observations), F=F, H=H, Q=Q, R=R)
    m, d = h.shape[1:]

    def start(x: Array, p: Array) -> Any:
        kf = filterpy.KalmanFilter(dim_x=d, dim_z=m)
        kf.x, kf.P = x.copy(), p.copy()
        return kf

    def step(kf: Any, k: int, z: Array, seen: Mask) -> None:
        kf.predict(F=f[k], Q=q[k])
        if seen.all():
            kf.update(z, H=h[k], R=r[k])
        elif seen.any():
            kf.update(z[seen], H=h[k][seen], R=r[k][np.ix_(seen, seen)])

    return _over_runs(mean, cov, observations, start, step)


@door
def filterpy_ekf(
    mean: Annotated[Array, "... model.dim"],
    cov: Annotated[Cov, "... model.dim model.dim"],
    observations: Annotated[Array, "... N m", MISSING],
    *,
    model: Model,
    sensors: Sequence[Sensor],
    times: Times,
) -> GaussianRun:
    r"""Filterpy's extended Kalman filter over a series: linearise the model and the sensors.

    Parameters
    ----------
    mean, cov, observations, model, sensors, times
        As for :func:`~distfilt.kalman.multiplicative_filter`, with the state's covariance, and
        sensors of the present state.

    Examples
    --------
    >>> from distfilt.sensors import direct
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> run = filterpy_ekf([0.0], [[1.0]], [[3.0]], model=walk,
    ...                    sensors=[direct([0], std=1.0)], times=[1.0])
    >>> run.means.round(6)
    array([[2.]])
    """
    filterpy, sensor = needed("filterpy.kalman", "reference"), _present(sensors)
    clock = grid(times, observations, sensor)

    def start(x: Array, p: Array) -> Any:
        kf = filterpy.ExtendedKalmanFilter(dim_x=model.dim, dim_z=sensor.dim)
        kf.x, kf.P = x.copy(), p.copy()
        return kf

    def step(kf: Any, k: int, z: Array, seen: Mask) -> None:
        t, dt = float(clock[k]), float(clock[k + 1] - clock[k])
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

    return _over_runs(mean, cov, observations, start, step)


@door
def filterpy_ukf(
    mean: Annotated[Array, "... model.dim"],
    cov: Annotated[Cov, "... model.dim model.dim"],
    observations: Annotated[Array, "... N m", MISSING],
    *,
    model: Model,
    sensors: Sequence[Sensor],
    times: Times,
    kappa: float = 1.0,
) -> GaussianRun:
    r"""Filterpy's unscented Kalman filter over a series: 2d + 1 points instead of derivatives.

    Parameters
    ----------
    mean, cov, observations, model, sensors, times
        As for :func:`filterpy_ekf`.
    kappa : float
        The points lie :math:`\sqrt{d+\kappa}` standard deviations from the mean.

    Examples
    --------
    >>> from distfilt.sensors import direct
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> run = filterpy_ukf([0.0], [[1.0]], [[3.0]], model=walk,
    ...                    sensors=[direct([0], std=1.0)], times=[1.0])
    >>> run.means.round(6)
    array([[2.]])
    """
    sensor = _present(sensors)
    clock = grid(times, observations, sensor)
    if kappa <= -model.dim:
        raise ValueError(f"kappa: needs more than -{model.dim}, got {kappa:g}")
    start = _unscented(model, sensor.dim, kappa)

    def step(kf: Any, k: int, z: Array, seen: Mask) -> None:
        t, dt = float(clock[k]), float(clock[k + 1] - clock[k])
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

    return _over_runs(mean, cov, observations, start, step)


def _present(sensors: Sequence[Sensor]) -> Sensor:
    """The stacked sensor, if none of the sensors needs the previous state."""
    sensor = stack(sensors)
    if sensor.uses_previous:
        raise ValueError("sensors: needs sensors of the present state, got a differential sensor")
    return sensor


def _unscented(model: Model, observed: int, kappa: float) -> Callable[[Array, Array], Any]:
    """What starts filterpy's filter at a mean and a covariance."""
    filterpy = needed("filterpy.kalman", "reference")

    class Batched(filterpy.UnscentedKalmanFilter):  # type: ignore[misc, name-defined]
        """Moves all sigma points in one call of the model."""

        def compute_process_sigmas(self, dt: float, fx: Any = None, **fx_args: Any) -> None:
            points = self.points_fn.sigma_points(self.x, self.P)
            self.sigmas_f = model.step(points, fx_args["t"], dt)

    def start(x: Array, p: Array) -> Any:
        points = filterpy.MerweScaledSigmaPoints(model.dim, 1.0, 0.0, kappa)
        kf = Batched(model.dim, observed, 0.0, None, None, points)
        kf.x, kf.P = x.copy(), p.copy()
        return kf

    return start


def _over_runs(
    mean: Array, cov: Array, observations: Array, start: Callable[[Array, Array], Any],
    step: Callable[[Any, int, Array, Mask], None],
) -> GaussianRun:
    """Run one of filterpy's objects over every run and every step."""
    runs, y, x, p = flattened(mean, cov, observations)
    means, covs = np.empty((len(y), *x.shape)), np.empty((len(y), *p.shape))
    density = np.zeros(y.shape[:2])
    for run in range(len(x)):
        kf = start(x[run], p[run])
        for k, z in enumerate(y[:, run]):
            seen = ~np.isnan(z)
            step(kf, k, z, seen)
            means[k, run], covs[k, run] = kf.x, kf.P
            if seen.any():
                density[k, run] = kf.log_likelihood
    if not np.isfinite(means).all():
        raise np.linalg.LinAlgError("filterpy's filter ended in NaN")
    return unflattened(means, covs, density, runs)


def _residual_of(sensor: Sensor, seen: Mask) -> Callable[[Array, Array], Array]:
    """The sensor's residual on the observed components only."""

    def residual(a: Array, b: Array) -> Array:
        whole_a, whole_b = np.zeros(sensor.dim), np.zeros(sensor.dim)
        whole_a[seen], whole_b[seen] = a, b
        return np.asarray(sensor.residual(whole_a, whole_b)[seen])

    return residual
