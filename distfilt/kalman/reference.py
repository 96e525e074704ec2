"""The Kalman, extended and unscented filters of filterpy 2.0 behind the library's shapes.

They are slow (one run and one step at a time) and independently written: the reference that the
batched filters are compared with. Nothing else in the library imports filterpy.

Three habits of filterpy are guarded against here: states are vectors (d,), since a column state and
a flat observation silently give a matrix; missing components are taken out before filterpy sees
them, since NaN passes through without an error; and every update follows a forecast, since a second
update on the same sigma points can give a negative variance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Any

import numpy as np

from ..models import Model
from ..sensors import Sensor, stack
from ..validation import (
    Array,
    Mask,
    PositiveDefinite,
    PositiveSemidefinite,
    Times,
    import_optional,
    validated,
)
from .linear import (
    FilterResult,
    Matrix,
    Mean,
    Noise,
    Seen,
    Series,
    flatten_runs,
    grid,
    per_step,
    unflatten_runs,
)

__all__ = ["filterpy_ekf", "filterpy_kf", "filterpy_ukf"]

State = Annotated[Array, "... model.dim"]
Spread = Annotated[PositiveDefinite, "... model.dim model.dim"]


@validated
def filterpy_kf(
    mean: Mean,
    cov: PositiveDefinite,
    observations: Series,
    *,
    F: Matrix,
    H: Seen,
    Q: PositiveSemidefinite,
    R: Noise,
) -> FilterResult:
    """Filterpy's Kalman filter over a series: arguments and result of :func:`kalman_filter`.

    Parameters
    ----------
    mean, cov, observations, F, H, Q, R : array_like
        As for :func:`distfilt.kalman.kalman_filter`.

    Examples
    --------
    >>> run = filterpy_kf(
    ...     [0.0], [[1.0]], [[2.0]], F=[[1.0]], H=[[1.0]], Q=[[0.0]], R=[[1.0]]
    ... )
    >>> run.means, run.covariances
    (array([[1.]]), array([[[0.5]]]))
    """
    f, h, q, r = per_step(len(observations), F=F, H=H, Q=Q, R=R)
    m, d = h.shape[1:]

    def step(kf: Any, k: int, z: Array, seen: Mask) -> None:
        kf.predict(F=f[k], Q=q[k])
        if seen.any():
            kf.update(z[seen], H=h[k][seen], R=r[k][np.ix_(seen, seen)])

    make = partial(
        import_optional("filterpy.kalman", "reference").KalmanFilter, dim_x=d, dim_z=m
    )
    return _over_runs(mean, cov, observations, make, step)


@validated
def filterpy_ekf(
    mean: State,
    cov: Spread,
    observations: Series,
    *,
    model: Model,
    sensors: Sequence[Sensor],
    times: Times,
) -> FilterResult:
    r"""Filterpy's extended Kalman filter over a series: linearise the model and the sensors.

    Parameters
    ----------
    mean, cov, observations, model, sensors, times
        As for :func:`~distfilt.kalman.mekf`, with the state's covariance, and
        sensors of the present state.

    Examples
    --------
    >>> from distfilt.sensors import component
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> run = filterpy_ekf(
    ...     [0.0],
    ...     [[1.0]],
    ...     [[3.0]],
    ...     model=walk,
    ...     sensors=[component([0], std=1.0)],
    ...     times=[1.0],
    ... )
    >>> run.means.round(6)
    array([[2.]])
    """
    sensor, clock = _present(sensors, times, observations)

    def step(kf: Any, k: int, z: Array, seen: Mask) -> None:
        t = float(clock[k])
        dt = float(clock[k + 1] - clock[k])
        kf.F = model.jacobian(kf.x, t, dt)
        kf.Q = model.Q(t, dt)
        moved = model.step(kf.x, t, dt)
        kf.predict()
        kf.x = (
            moved  # filterpy moves the mean with F; the model itself is the better step
        )
        if seen.any():
            # It gets residuals, which the sensor wraps, in place of readings.
            gap = sensor.residual(z, sensor.predict(moved))[seen]
            h = sensor.jacobian(moved)[seen]
            kf.update(
                gap,
                lambda x: h,
                lambda x: 0 * gap,
                sensor.noise_cov[np.ix_(seen, seen)],
            )

    make = import_optional("filterpy.kalman", "reference").ExtendedKalmanFilter
    make = partial(make, dim_x=model.dim, dim_z=sensor.dim)
    return _over_runs(mean, cov, observations, make, step)


@validated
def filterpy_ukf(
    mean: State,
    cov: Spread,
    observations: Series,
    *,
    model: Model,
    sensors: Sequence[Sensor],
    times: Times,
) -> FilterResult:
    r"""Filterpy's unscented Kalman filter over a series: 2d + 1 points instead of derivatives.

    The points lie :math:`\sqrt{d+1}` standard deviations from the mean.

    Parameters
    ----------
    mean, cov, observations, model, sensors, times
        As for :func:`filterpy_ekf`.

    Examples
    --------
    >>> from distfilt.sensors import component
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> run = filterpy_ukf(
    ...     [0.0],
    ...     [[1.0]],
    ...     [[3.0]],
    ...     model=walk,
    ...     sensors=[component([0], std=1.0)],
    ...     times=[1.0],
    ... )
    >>> run.means.round(6)
    array([[2.]])
    """
    sensor, clock = _present(sensors, times, observations)
    filterpy = import_optional("filterpy.kalman", "reference")

    def make() -> Any:
        points = filterpy.MerweScaledSigmaPoints(model.dim, 1.0, 0.0, 1.0)
        return filterpy.UnscentedKalmanFilter(
            model.dim, sensor.dim, 0.0, None, None, points
        )

    def step(kf: Any, k: int, z: Array, seen: Mask) -> None:
        t = float(clock[k])
        dt = float(clock[k + 1] - clock[k])
        kf.Q = model.Q(t, dt)
        # filterpy asks for one sigma point after the other; all of them are moved in one call.
        moved = iter(model.step(kf.points_fn.sigma_points(kf.x, kf.P), t, dt))
        kf.predict(dt, fx=lambda x, dt: next(moved))
        if seen.any():
            h = sensor.predict(kf.sigmas_f)
            # Readings that wrap are unwrapped: the points around the central one, the observation
            # around the points' mean. Plain differences are then right.
            h = h[0] + sensor.residual(h, np.broadcast_to(h[0], h.shape))
            middle = kf.Wm @ h
            near = middle + sensor.residual(z, middle)
            rows = iter(h[:, seen])
            kf.update(
                near[seen],
                R=sensor.noise_cov[np.ix_(seen, seen)],
                hx=lambda x: next(rows),
            )

    return _over_runs(mean, cov, observations, make, step)


def _present(
    sensors: Sequence[Sensor], times: Array, observations: Array
) -> tuple[Sensor, Array]:
    """The stacked sensor, if none of the sensors needs the previous state, and the clock."""
    sensor = stack(sensors)
    if sensor.uses_previous:
        raise ValueError(
            "sensors must be sensors of the present state, got a differential sensor"
        )
    return sensor, grid(times, observations, sensor)


def _over_runs(
    mean: Array,
    cov: Array,
    observations: Array,
    make: Callable[[], Any],
    step: Callable[[Any, int, Array, Mask], None],
) -> FilterResult:
    """Run one of filterpy's objects over every run and every step."""
    runs, y, x, p = flatten_runs(mean, cov, observations)
    means = np.empty((len(y), *x.shape))
    covs = np.empty((len(y), *p.shape))
    density = np.zeros(y.shape[:2])
    for run in range(len(x)):
        kf = make()
        kf.x = x[run].copy()
        kf.P = p[run].copy()
        for k, z in enumerate(y[:, run]):
            seen = ~np.isnan(z)
            step(kf, k, z, seen)
            means[k, run] = kf.x
            covs[k, run] = kf.P
            if seen.any():
                density[k, run] = kf.log_likelihood
    if not np.isfinite(means).all():
        raise np.linalg.LinAlgError("filterpy's filter ended in NaN")
    return unflatten_runs(means, covs, density, runs)
