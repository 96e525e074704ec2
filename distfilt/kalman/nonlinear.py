r"""Extended and unscented Kalman filters for many runs at once.

Both replace what is not linear about the present mean: the extended filter by derivatives, the
unscented one by 2 d + 1 points. A NaN in a reading, or in what the sensor predicts, is a missing
component of that run; readings that wrap are compared by the sensor's residual.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, instance, number
from ..models import Model
from ..sensors import Sensor
from ._inputs import flat, in_front, instantaneous, reading, series
from ._steps import (
    Points,
    extended_analysis,
    extended_forecast,
    over_time,
    unscented_analysis,
    unscented_forecast,
)
from .linear import GaussianRun

__all__ = [  # fmt: skip
    "extended_filter", "extended_predict", "extended_update", "unscented_filter",
    "unscented_predict", "unscented_update",
]

def extended_predict(
    mean: ArrayLike, cov: ArrayLike, model: Model, t: float, dt: float
) -> tuple[Array, Array]:
    r"""Forecast Gaussians by a model that is linearised about each mean: means, covariances.

    The mean takes the model's own step; the covariance becomes
    :math:`\mathbf J\mathbf P\mathbf J^\top+\mathbf Q` with the step's Jacobian J.

    Parameters
    ----------
    mean, cov : array_like, (..., d) and (..., d, d)
        The covariance positive definite.
    model : Model
        Its `jacobian` is used.
    t, dt : float
        The time of the Gaussians and how far to go, in s.

    Examples
    --------
    >>> bent = Model(1, lambda x, t, dt: x**2, lambda t, dt: np.array([[0.5]]))
    >>> x, p = extended_predict([3.0], [[0.1]], bent, 0.0, 1.0)
    >>> x, p.round(6)
    (array([9.]), array([[4.1]]))
    """
    instance(model, "model", Model)
    x, p, runs = flat(mean, cov, (), model.dim)
    now, length = number(t, "t"), number(dt, "dt", at_least=0)
    return in_front(runs, *extended_forecast(x, p, model, now, length))


def extended_update(
    mean: ArrayLike, cov: ArrayLike, observed: ArrayLike, sensor: Sensor
) -> tuple[Array, Array, Array]:
    r"""Condition Gaussians on readings of a sensor that is linearised about each mean.

    Parameters
    ----------
    mean, cov : array_like, (..., d) and (..., d, d)
        The covariance positive definite.
    observed : array_like, (..., m)
        NaN marks a missing component.
    sensor : Sensor
        Of the present state; its `jacobian` is used.

    Returns
    -------
    mean : ndarray, (..., d)
    cov : ndarray, (..., d, d)
        In Joseph's form.
    log_likelihood : ndarray, (...)
        Log density of the innovations, those of the linearised problem.

    Examples
    --------
    >>> from distfilt.sensors import distance
    >>> x, p, _ = extended_update([3.0, 4.0], np.eye(2), [6.0], distance([0, 1], std=1.0))
    >>> x.round(6), p.round(6).tolist()
    (array([3.3, 4.4]), [[0.82, -0.24], [-0.24, 0.68]])
    """
    y = reading(observed, sensor)
    x, p, runs = flat(mean, cov, y.shape[:-1])
    y = np.broadcast_to(y, (*runs, sensor.dim)).reshape(-1, sensor.dim)
    x, p, density = extended_analysis(x, p, y, sensor)
    return (*in_front(runs, x, p), density.reshape(runs))


def extended_filter(
    mean: ArrayLike, cov: ArrayLike, observations: ArrayLike, *, model: Model,
    sensors: Sequence[Sensor], times: ArrayLike, t0: float = 0.0,
) -> GaussianRun:
    r"""The extended Kalman filter over series of observations, all runs at once.

    Parameters
    ----------
    mean : array_like, (d,) or (..., d)
        Prior mean at `t0`.
    cov : array_like, (d, d) or (..., d, d)
        Prior covariance, positive definite.
    observations : array_like, (T, ..., m)
        The observations of all sensors, one after the other; the middle axes are the runs. NaN
        marks a missing component.
    model : Model
        Linearised about each analysis mean.
    sensors : sequence of Sensor
        Linearised about each forecast mean.
    times : array_like, (T,)
        Observation times, in s.
    t0 : float
        The time of the prior, in s.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a run leaves the finite numbers or its covariance is no longer positive definite; the
        message has the time.

    Examples
    --------
    >>> from distfilt.sensors import direct
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> run = extended_filter([0.0], [[1.0]], [[3.0]], model=walk,
    ...                       sensors=[direct([0], std=1.0)], times=[1.0])
    >>> run.means.round(6)
    array([[2.]])
    """
    sensor = instantaneous(sensors)
    instance(model, "model", Model)
    return over_time(
        *series(observations, times, t0, sensor.dim), mean, cov, model.dim,
        lambda x, p, t, dt: extended_forecast(x, p, model, t, dt),
        lambda x, p, y: extended_analysis(x, p, y, sensor),
    )


def unscented_predict(
    mean: ArrayLike, cov: ArrayLike, model: Model, t: float, dt: float, *, alpha: float = 1.0,
    beta: float = 0.0, kappa: float = 1.0,
) -> tuple[Array, Array]:
    r"""Forecast Gaussians by 2 d + 1 points that the model moves: means and covariances.

    Parameters
    ----------
    mean, cov, model, t, dt
        As for :func:`extended_predict`; no derivative is needed.
    alpha, beta, kappa : float
        Of the scaled points, which lie :math:`\alpha\sqrt{d+\kappa}` standard deviations from the
        mean. The defaults keep every weight positive, and with it the covariance.

    Notes
    -----
    S. J. Julier and J. K. Uhlmann, Proceedings of the IEEE 92 (2004) 401-422; the scaling of R. van
    der Merwe's thesis, Oregon Health and Science University, 2004.

    Examples
    --------
    The mean of a square is known to the points, not to a tangent:

    >>> bent = Model(1, lambda x, t, dt: x**2, lambda t, dt: np.array([[0.5]]))
    >>> unscented_predict([3.0], [[0.1]], bent, 0.0, 1.0)[0].round(6)
    array([9.1])
    """
    instance(model, "model", Model)
    x, p, runs = flat(mean, cov, (), model.dim)
    now, length = number(t, "t"), number(dt, "dt", at_least=0)
    points = Points.of(model.dim, alpha, beta, kappa)
    return in_front(runs, *unscented_forecast(x, p, model, now, length, points))


def unscented_update(
    mean: ArrayLike, cov: ArrayLike, observed: ArrayLike, sensor: Sensor, *, alpha: float = 1.0,
    beta: float = 0.0, kappa: float = 1.0,
) -> tuple[Array, Array, Array]:
    r"""Condition Gaussians on readings, by what the sensor makes of 2 d + 1 points.

    Readings that wrap are unwrapped around that of the mean.

    Parameters
    ----------
    mean, cov, observed, sensor
        As for :func:`extended_update`; no derivative is needed.
    alpha, beta, kappa : float
        As for :func:`unscented_predict`.

    Returns
    -------
    mean : ndarray, (..., d)
    cov : ndarray, (..., d, d)
        Positive definite by construction, where the weights are positive: the points' own form of
        Joseph's sum of squares.
    log_likelihood : ndarray, (...)

    Examples
    --------
    >>> from distfilt.sensors import direct
    >>> x, p, _ = unscented_update([0.0], [[1.0]], [2.0], direct([0], std=1.0))
    >>> x.round(6), p.round(6)
    (array([1.]), array([[0.5]]))
    """
    y = reading(observed, sensor)
    x, p, runs = flat(mean, cov, y.shape[:-1])
    points = Points.of(x.shape[-1], alpha, beta, kappa)
    y = np.broadcast_to(y, (*runs, sensor.dim)).reshape(-1, sensor.dim)
    x, p, density = unscented_analysis(x, p, y, sensor, points)
    return (*in_front(runs, x, p), density.reshape(runs))


def unscented_filter(
    mean: ArrayLike, cov: ArrayLike, observations: ArrayLike, *, model: Model,
    sensors: Sequence[Sensor], times: ArrayLike, t0: float = 0.0, alpha: float = 1.0,
    beta: float = 0.0, kappa: float = 1.0,
) -> GaussianRun:
    r"""The unscented Kalman filter over series of observations, all runs at once.

    Parameters
    ----------
    mean, cov, observations, model, sensors, times, t0
        As for :func:`extended_filter`.
    alpha, beta, kappa : float
        As for :func:`unscented_predict`.

    Examples
    --------
    >>> from distfilt.sensors import direct
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> run = unscented_filter([0.0], [[1.0]], [[3.0]], model=walk,
    ...                        sensors=[direct([0], std=1.0)], times=[1.0])
    >>> run.means.round(6)
    array([[2.]])
    """
    sensor = instantaneous(sensors)
    instance(model, "model", Model)
    points = Points.of(model.dim, alpha, beta, kappa)
    return over_time(
        *series(observations, times, t0, sensor.dim), mean, cov, model.dim,
        lambda x, p, t, dt: unscented_forecast(x, p, model, t, dt, points),
        lambda x, p, y: unscented_analysis(x, p, y, sensor, points),
    )
