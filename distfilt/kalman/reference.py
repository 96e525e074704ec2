"""The Kalman, extended and unscented filters of filterpy 2.0, with the library's interface.

They are slow (one run and one step at a time) and independently written: a reference for the
batched filters. Nothing else in the library imports filterpy.

Three pitfalls of filterpy are avoided here. States are vectors (d,), since a column state and a
flat observation silently give a matrix. Missing components are removed before the update, since
filterpy accepts NaN without an error. Every update follows a forecast, since a second update on
the same sigma points can give a negative variance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Protocol

import numpy as np

from ..linalg import deviations
from ..models import Model
from ..sensors import Sensor, stack
from ..validation import (
    Array,
    ArrayInput,
    Mask,
    PositiveDefinite,
    PositiveSemidefinite,
    Times,
    format_number,
    import_optional,
    validated,
)
from .linear import (
    FilterResult,
    MeanVector,
    ObservationMatrix,
    ObservationNoise,
    ObservationSeries,
    SquareMatrix,
    flatten_runs,
    prepend_prior_time,
    repeat_per_step,
    unflatten_runs,
)

__all__ = ["filterpy_ekf", "filterpy_kf", "filterpy_ukf"]

StateMean = Annotated[ArrayInput, "... model.dim"]
StateCov = Annotated[PositiveDefinite, "... model.dim model.dim"]


class _SigmaPoints(Protocol):
    """The part of filterpy's unscented filter that computes its points."""

    def sigma_points(self, x: Array, P: Array) -> Array: ...


class _Filterpy(Protocol):
    """The attributes and methods of filterpy's filters that are used here.

    `sigmas_f`, `Wm` (points after the forecast, and their weights) and `points_fn` belong to the
    unscented filter only.
    """

    x: Array
    P: Array
    F: Array
    Q: Array
    sigmas_f: Array
    Wm: Array
    points_fn: _SigmaPoints
    log_likelihood: float
    predict: Callable[..., None]
    update: Callable[..., None]


Step = Callable[[_Filterpy, int, Array, Mask], None]
"""``step(kf, k, observation, present)``: forecast a filter of filterpy to time k and update it.

The observation is (m,), and `present` marks those of its components that are not missing."""


@validated
def filterpy_kf(
    mean: MeanVector,
    cov: PositiveDefinite,
    observations: ObservationSeries,
    *,
    F: SquareMatrix,
    H: ObservationMatrix,
    Q: PositiveSemidefinite,
    R: ObservationNoise,
) -> FilterResult:
    """Run filterpy's Kalman filter, with arguments and result of :func:`kalman_filter`.

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
    f, h, q, r = repeat_per_step(len(observations), F=F, H=H, Q=Q, R=R)
    m, d = h.shape[1:]

    def step(kf: _Filterpy, k: int, z: Array, present: Mask) -> None:
        """Forecast to time k, and update by the components of z that are present."""
        kf.predict(F=f[k], Q=q[k])
        if present.any():
            # Rows of missing components are deleted from H and R.
            noise_cov = r[k][np.ix_(present, present)]
            kf.update(z[present], H=h[k][present], R=noise_cov)

    filterpy = import_optional("filterpy.kalman", "reference")
    make = partial(filterpy.KalmanFilter, dim_x=d, dim_z=m)
    return _run_filterpy(mean, cov, observations, make, step)


@validated
def filterpy_ekf(
    mean: StateMean,
    cov: StateCov,
    observations: ObservationSeries,
    *,
    model: Model,
    sensors: Sequence[Sensor],
    times: Times,
) -> FilterResult:
    r"""Run filterpy's extended Kalman filter: the model and the sensors are linearised.

    Parameters
    ----------
    mean, cov, observations, model, sensors, times
        As for :func:`~distfilt.kalman.mekf`, with the covariance of the state. Sensors of
        increments are not supported.

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
    sensor, clock = _stack_sensors(sensors, times, observations)

    def step(kf: _Filterpy, k: int, z: Array, present: Mask) -> None:
        """Forecast to time k, and update by the components of z that are present."""
        # The clock begins with the prior's time, so that `times` k is its entry k + 1.
        t = float(clock[k])
        dt = float(clock[k + 1] - clock[k])
        # The linearisation is about the last analysis mean.
        kf.F = model.jacobian(kf.x, t, dt, std=deviations(kf.P))
        kf.Q = model.noise_at(kf.x, t, dt)
        forecast = model.step(kf.x, t, dt)
        kf.predict()
        # filterpy predicts the mean by F; the nonlinear model is more accurate.
        kf.x = forecast
        if present.any():
            # filterpy subtracts the prediction from the observation. Angles have to be wrapped, so
            # it gets the sensor's residual for an observation, and zero for its prediction.
            predicted = sensor.predict(forecast)
            _check_seen(predicted[present], t + dt)
            residual = sensor.residual(z, predicted)[present]
            h = sensor.jacobian(forecast, std=deviations(kf.P))[present]
            noise_cov = sensor.noise_cov[np.ix_(present, present)]
            kf.update(residual, lambda x: h, lambda x: 0 * residual, noise_cov)

    filterpy = import_optional("filterpy.kalman", "reference")
    make = partial(filterpy.ExtendedKalmanFilter, dim_x=model.dim, dim_z=sensor.dim)
    return _run_filterpy(mean, cov, observations, make, step)


@validated
def filterpy_ukf(
    mean: StateMean,
    cov: StateCov,
    observations: ObservationSeries,
    *,
    model: Model,
    sensors: Sequence[Sensor],
    times: Times,
) -> FilterResult:
    r"""Run filterpy's unscented Kalman filter: 2d + 1 sigma points instead of derivatives.

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
    sensor, clock = _stack_sensors(sensors, times, observations)
    filterpy = import_optional("filterpy.kalman", "reference")

    def make() -> _Filterpy:
        # α = 1, β = 0, κ = 1: the weights of all points are positive. The step's length, model and
        # sensor (dt, fx, hx) are given with each call below.
        points = filterpy.MerweScaledSigmaPoints(
            model.dim, alpha=1.0, beta=0.0, kappa=1.0
        )
        kf: _Filterpy = filterpy.UnscentedKalmanFilter(
            model.dim, sensor.dim, dt=0.0, hx=None, fx=None, points=points
        )
        return kf

    def step(kf: _Filterpy, k: int, z: Array, present: Mask) -> None:
        """Forecast to time k, and update by the components of z that are present."""
        # The clock begins with the prior's time, so that `times` k is its entry k + 1.
        t = float(clock[k])
        dt = float(clock[k + 1] - clock[k])
        kf.Q = model.noise_at(kf.x, t, dt)
        # filterpy calls fx, the model, and hx, the sensor, for one sigma point after the other:
        # both are computed here for all points in one call, and handed out in that order.
        points = kf.points_fn.sigma_points(kf.x, kf.P)
        forecasts = iter(model.step(points, t, dt))
        kf.predict(dt, fx=lambda x, dt: next(forecasts))
        if present.any():
            # filterpy averages and subtracts plainly: angles are put on one branch for it. Its
            # sigmas_f are the points of the forecast, and Wm their weights.
            predicted, observed = _unwrap(sensor, kf.sigmas_f, kf.Wm, z)
            _check_seen(predicted[:, present], t + dt)
            rows = iter(predicted[:, present])
            noise_cov = sensor.noise_cov[np.ix_(present, present)]
            kf.update(observed[present], R=noise_cov, hx=lambda x: next(rows))

    return _run_filterpy(mean, cov, observations, make, step)


def _check_seen(predicted: Array, t: float) -> None:
    """Refuse predictions that do not exist, which filterpy cannot leave out."""
    if np.isnan(predicted).any():
        raise ValueError(
            "observations must be predicted to be used by filterpy, but a sensor cannot see at "
            f"t = {format_number(t)} s: mark them as missing (NaN), or use a GaussianFilter"
        )


def _unwrap(
    sensor: Sensor, points: Array, weights: Array, observed: Array
) -> tuple[Array, Array]:
    """Predictions at sigma points, and the observation, such that plain differences are right.

    Values that wrap are unwrapped: the predictions about that of the central point, and the
    observation about the mean prediction. Points are (2d + 1, d), weights (2d + 1,), observations
    (m,); the predictions are (2d + 1, m).
    """
    predicted = sensor.predict(points)
    centre = np.broadcast_to(predicted[0], predicted.shape)
    predicted = predicted[0] + sensor.residual(predicted, centre)
    # The mean of unwrapped predictions
    mean = weights @ predicted
    return predicted, mean + sensor.residual(observed, mean)


def _stack_sensors(
    sensors: Sequence[Sensor], times: Array, observations: Array
) -> tuple[Sensor, Array]:
    """Stack sensors of the present state; the T + 1 times of the prior and the observations.

    The times are (T,), the observations (T, ..., m) those of all sensors side by side.
    """
    sensor = stack(sensors)
    if sensor.uses_previous:
        raise ValueError(
            "sensors must not be of increments: this filter keeps no previous state"
        )
    return sensor, prepend_prior_time(times, observations, sensor)


def _run_filterpy(
    mean: Array,
    cov: Array,
    observations: Array,
    make: Callable[[], _Filterpy],
    step: Step,
) -> FilterResult:
    """Filter every run by a filter of filterpy of its own, step after step.

    `make` returns a new filter, and `step` moves it by one observation time. Mean (..., d),
    covariance (..., d, d) and observations (T, ..., m) are those of all runs.
    """
    # Runs one after the other: filterpy has no batches.
    flat = flatten_runs(mean, cov, observations)
    y = flat.observations
    x = flat.means
    p = flat.covs
    means = np.empty((len(y), *x.shape))
    covs = np.empty((len(y), *p.shape))
    log_likelihood = np.zeros(y.shape[:2])
    for run in range(len(x)):
        # A new filter for each run: filterpy's filters have a state.
        kf = make()
        # filterpy changes its arrays in place.
        kf.x = x[run].copy()
        kf.P = p[run].copy()
        for k, z in enumerate(y[:, run]):
            # Forecast to time k, and update by the components that are not missing.
            present = ~np.isnan(z)
            step(kf, k, z, present)
            means[k, run] = kf.x
            covs[k, run] = kf.P
            if present.any():
                log_likelihood[k, run] = kf.log_likelihood
    if not np.isfinite(means).all():
        raise np.linalg.LinAlgError("filterpy's filter: a mean is no longer finite")
    return unflatten_runs(means, covs, log_likelihood, flat.runs)
