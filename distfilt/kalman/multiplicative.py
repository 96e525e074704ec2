r"""The multiplicative extended Kalman filter, for states with a unit quaternion.

The mean stays on the manifold of states. Its error is a tangent vector: three components for the
error of an attitude, and no uncertainty of the quaternion's length.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, NamedTuple

import numpy as np

from ..derivatives import central_difference
from ..linalg import deviations
from ..models import Model
from ..models.quaternions import left_directions, rotate, rotation_vector_between
from ..sensors import Sensor, stack
from ..validation import (
    Array,
    ArrayInput,
    FrozenModel,
    NonNegativeInt,
    PositiveDefinite,
    PositiveInt,
    Times,
    format_number,
    validated,
)
from .linear import (
    FilterResult,
    ObservationSeries,
    assimilate,
    flatten_runs,
    prepend_prior_time,
    unflatten_runs,
)

__all__ = ["QuaternionChart", "mekf"]


@dataclass(frozen=True, eq=False)
class QuaternionChart(FrozenModel):
    """Chart of states with a unit quaternion among their components.

    The components of the error are the state's, with the rotation vector of
    :func:`distfilt.models.quaternions.rotate` in place of the quaternion: k = d - 1 components.

    Parameters
    ----------
    dim : int
        Size d of the state.
    first : int
        Index of the quaternion's first component, its scalar part.

    Examples
    --------
    >>> chart = QuaternionChart(5, 1)
    >>> state = np.array([2.0, 1.0, 0.0, 0.0, 0.0])
    >>> error = np.array([0.5, np.pi, 0.0, 0.0])
    >>> chart.retract(state, error).round(3) + 0.0
    array([2.5, 0. , 1. , 0. , 0. ])
    >>> chart.project(state, np.eye(5)).diagonal()
    array([1., 4., 4., 4.])
    """

    dim: PositiveInt
    first: NonNegativeInt

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.first + 4 > self.dim:
            raise ValueError(
                f"first must be at most {self.dim - 4}, so that four components follow, "
                f"got {self.first}"
            )

    @property
    def error_dim(self) -> int:
        """Size k of the error."""
        return self.dim - 1

    def retract(self, x: Array, e: Array) -> Array:
        """Move states x (..., d) by errors e (..., k): by addition, and the quaternion by rotation.

        The rotation vector of the error has the place of the quaternion.
        """
        i = self.first
        # Components before and after the quaternion are plain vectors.
        before = x[..., :i] + e[..., :i]
        quaternion = rotate(x[..., i : i + 4], e[..., i : i + 3])
        after = x[..., i + 4 :] + e[..., i + 3 :]
        return np.concatenate([before, quaternion, after], axis=-1)

    def local(self, x: Array, other: Array) -> Array:
        """Error (..., k) that moves x to `other`, both (..., d): the inverse of `retract`."""
        i = self.first
        difference = other - x
        before = difference[..., :i]
        # The difference of the quaternions is not used: the rotation vector takes its place.
        rotation = rotation_vector_between(x[..., i : i + 4], other[..., i : i + 4])
        after = difference[..., i + 4 :]
        return np.concatenate([before, rotation, after], axis=-1)

    def tangent_basis(self, x: Array) -> Array:
        """Derivative B of `retract` with respect to the error, at zero, (..., d, k)."""
        i = self.first
        # The identity, but for the quaternion q: its derivative in the rotation vector, (4, 3).
        basis = np.zeros((*x.shape, self.error_dim))
        basis[..., :i, :i] = np.eye(i)
        basis[..., i : i + 4, i : i + 3] = left_directions(x[..., i : i + 4])
        basis[..., i + 4 :, i + 3 :] = np.eye(self.dim - i - 4)
        return basis

    @validated
    def project(
        self,
        x: Annotated[ArrayInput, "... self.dim"],
        cov: Annotated[ArrayInput, "... self.dim self.dim"],
    ) -> Array:
        """Project covariances (..., d, d) of states to those of their errors, (..., k, k)."""
        projection = self.tangent_projection(x)
        return np.asarray(projection @ cov @ projection.mT)

    def tangent_projection(self, x: Array) -> Array:
        """Pseudo-inverse of the tangent basis, B⁺ = (Bᵀ B)⁻¹ Bᵀ, (..., k, d)."""
        basis = self.tangent_basis(x)
        return np.asarray(np.linalg.solve(basis.mT @ basis, basis.mT))


@validated
def mekf(
    mean: Annotated[ArrayInput, "... model.dim"],
    cov: Annotated[PositiveDefinite, "... chart.error_dim chart.error_dim"],
    observations: ObservationSeries,
    *,
    chart: QuaternionChart,
    model: Model,
    sensors: Sequence[Sensor],
    times: Times,
) -> FilterResult:
    r"""Multiplicative extended Kalman filter: an extended filter on the errors of a chart.

    A step leads from x to the forecast x'. With the model's Jacobian J and noise covariance Q, the
    sensor's Jacobian H, the tangent basis B of the chart and its pseudo-inverse, the transition of
    the errors is :math:`\mathbf B(\mathbf x')^+\,\mathbf J\,\mathbf B(\mathbf x)`, their noise
    covariance :math:`\mathbf B(\mathbf x')^+\mathbf Q\,\mathbf B(\mathbf x')^{+\top}`, and the
    observation matrix :math:`\mathbf H\,\mathbf B(\mathbf x')`. An analysis moves the mean by
    `retract`. The covariances (T, ..., k, k) are those of the errors ``chart.local(means, truth)``.

    Parameters
    ----------
    mean : array_like, (d,) or (..., d)
        Prior mean at time 0.
    cov : array_like, (k, k) or (..., k, k)
        Prior covariance of the error; :meth:`QuaternionChart.project` computes it from the
        state's.
    observations : array_like, (T, ..., m)
        The observations of all sensors, concatenated; the middle axes are the runs. NaN marks a
        missing component.
    chart : QuaternionChart
        It says which components are the quaternion.
    model : Model
        Linearised about each analysis mean.
    sensors : sequence of Sensor
        Linearised about each forecast mean. Sensors of increments are supported: each compares
        with the state at its own last observation that is not missing (NaN), whose errors are
        appended to those of the present one.
    times : array_like, (T,)
        Observation times after 0, in s.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the mean of a run is no longer finite or its covariance no longer positive definite; the
        message names the time.

    Notes
    -----
    E. J. Lefferts, F. L. Markley and M. D. Shuster, Journal of Guidance 5 (1982) 417-429. In an
    analysis the tangent basis rotates with the mean; this effect is of second order and neglected.

    Examples
    --------
    >>> from distfilt.models import satellite_pose
    >>> from distfilt.sensors import component
    >>> x = np.r_[np.zeros(6), [0.3, 0.2, 0.1], [1.0, 0.0, 0.0, 0.0]]
    >>> run = mekf(
    ...     x,
    ...     0.01 * np.eye(12),
    ...     np.zeros((1, 3)),
    ...     chart=QuaternionChart(13, 9),
    ...     model=satellite_pose(rate=0.1, sigma=0.2, step=0.1),
    ...     sensors=[component([10, 11, 12], std=0.1)],
    ...     times=[0.1],
    ... )
    >>> float((run.means[0, 9:] ** 2).sum().round(9)), run.covariances.shape
    (1.0, (1, 12, 12))
    """
    # One sensor of all components, in the order of the observations.
    sensor = stack(sensors)
    if chart.dim != model.dim:
        raise ValueError(
            f"chart must have {model.dim} components, like the model, got {chart.dim}"
        )
    # The first step begins at 0. All R runs in one axis: y (T, R, m), x (R, d) and p (R, k, k).
    clock = prepend_prior_time(times, observations, sensor)
    runs, y, x, p = flatten_runs(mean, cov, observations)
    k = chart.error_dim
    means = np.empty((len(y), *x.shape))
    covs = np.empty((len(y), *p.shape))
    log_likelihood = np.empty(y.shape[:2])
    # A part is a sensor with its columns of y. One of increments compares the present state with
    # that of its last observation, at first the prior. The errors of those earlier states are
    # estimated too, behind the present ones; at the start they are equal, so are all blocks of P.
    parts = _list_parts(sensors, y)
    increments = [part for part in parts if part.sensor.uses_previous]
    previous = [x] * len(increments)
    n_blocks = 1 + len(increments)
    p = np.tile(p, (1, n_blocks, n_blocks))
    has_unseen = False
    for n, t in enumerate(times):
        dt = t - clock[n]
        try:
            # Means, the covariance of all errors, y - h(x) (NaN if not observed or not predicted)
            forecast, joint = _predict(x, p, chart, model, clock[n], dt)
            innovation = _find_innovation(forecast, previous, y[n], parts, sensor)
            has_unseen |= bool((np.isnan(innovation) & ~np.isnan(y[n])).any())
            slope = _error_jacobian(forecast, joint, previous, parts, chart)
            analysis = _assimilate(
                forecast, joint, previous, innovation, slope, chart, sensor
            )
        except np.linalg.LinAlgError as error:
            raise np.linalg.LinAlgError(f"at t = {format_number(t)}: {error}") from None
        x = analysis.means
        means[n] = x
        covs[n] = analysis.joint_covs[:, :k, :k]
        log_likelihood[n] = analysis.log_densities
        previous, p = _replace_previous(
            x, analysis.previous, analysis.joint_covs, y[n], increments
        )
    if has_unseen:
        warnings.warn(
            "observations must be predicted to be used, but a sensor cannot see from a mean "
            "(its prediction is NaN): these components are left out",
            RuntimeWarning,
            stacklevel=3,  # at the call of mekf(), above its validation
        )
    return unflatten_runs(means, covs, log_likelihood, runs)


class _Part(NamedTuple):
    """A sensor, or some of its components: `rows` of its own, `columns` of all observations (m)."""

    sensor: Sensor
    rows: slice
    columns: slice


def _list_parts(sensors: Sequence[Sensor], y: Array) -> list[_Part]:
    """Return the sensors with their columns of the observations; those of a stack one by one.

    A sensor of increments whose components are not all missing together is several parts, which
    compare with states of different times. The observations `y` (T, R, m) are those of T times and
    R runs, with NaN where missing.
    """
    parts: list[_Part] = []
    waiting = list(sensors)
    start = 0
    while waiting:
        sensor = waiting.pop(0)
        # The sensors of a stack are an option of its function, fixed by `partial`.
        if sensor.kind == "stack" and isinstance(sensor.h, partial):
            waiting = [*sensor.h.keywords["sensors"], *waiting]
            continue
        n = sensor.dim
        # Whether components of this sensor are missing at different times
        present = ~np.isnan(y[..., start : start + n])
        differs_within = (present != present[..., :1]).any()
        # Then each component is a part by itself.
        size = 1 if differs_within and sensor.uses_previous else n
        for row in range(0, n, size):
            rows = slice(row, row + size)
            columns = slice(start + row, start + row + size)
            parts.append(_Part(sensor, rows, columns))
        start += n
    return parts


def _predict(
    x: Array, p: Array, chart: QuaternionChart, model: Model, t: float, dt: float
) -> tuple[Array, Array]:
    """Forecast means (R, d) and the covariances (R, K, K) of their errors and of earlier ones.

    Behind the k present errors stand those of the states with which sensors of increments compare,
    k for each: these states do not change. `t` and `dt` are start and length of the step. The chart
    says which components of the state are a quaternion.
    """
    k = chart.error_dim
    forecast = model.step(x, t, dt)
    _check_finite(forecast)
    projection = chart.tangent_projection(forecast)
    # Transition of the errors: A = B(x')⁺ J B(x)
    basis = chart.tangent_basis(x)
    present = p[:, :k, :k]
    # Standard deviations of the state, from those of its error; they bound the steps of
    # differences where the model has no derivative.
    std = deviations(basis @ present @ basis.mT)
    transition = projection @ model.jacobian(x, t, dt, std=std) @ basis
    # P⁻ = A P Aᵀ + B(x')⁺ Q B(x')⁺ᵀ
    noise_cov = projection @ model.noise_at(x, t, dt) @ projection.mT
    cov = transition @ present @ transition.mT + noise_cov
    if p.shape[-1] == k:
        return forecast, cov
    # Earlier errors stay, so that their covariance with the present ones is multiplied by A.
    cross = transition @ p[:, :k, k:]
    return forecast, np.block([[cov, cross], [cross.mT, p[:, k:, k:]]])


def _find_innovation(
    forecast: Array,
    previous: list[Array],
    y: Array,
    parts: list[_Part],
    sensor: Sensor,
) -> Array:
    """Return the observations (R, m) minus their predictions, wrapped as `sensor` wraps them.

    `previous` has the states (R, d) with which the parts of increments compare, in their order.
    `forecast` has the present states (R, d).
    """
    # Each part of increments takes the next earlier state.
    next_previous = iter(previous)
    predicted = []
    for part in parts:
        earlier_state = next(next_previous) if part.sensor.uses_previous else None
        values = part.sensor.predict(forecast, earlier_state)
        predicted.append(values[..., part.rows])
    return sensor.residual(y, np.concatenate(predicted, axis=-1))


class _JointAnalysis(NamedTuple):
    """Analysis of the present and of the earlier states, in R runs.

    Means (R, d), those of the earlier states with which sensors of increments compare, covariances
    (R, K, K) of the errors of all these, and logarithms of the innovations' densities, (R,).
    """

    means: Array
    previous: list[Array]
    joint_covs: Array
    log_densities: Array


def _assimilate(
    forecast: Array,
    cov: Array,
    previous: list[Array],
    innovation: Array,
    slope: Array,
    chart: QuaternionChart,
    sensor: Sensor,
) -> _JointAnalysis:
    """Update the present and the earlier states by an observation.

    `innovation` (R, m) is NaN where a component is missing; `slope` (R, m, K) is its derivative in
    the present and the earlier errors, of which `cov` (R, K, K) is the covariance.
    """
    missing = np.isnan(innovation)
    # Missing components have no innovation and no row in H.
    innovation = np.where(missing, 0.0, innovation)
    h = np.where(missing[..., None], 0.0, slope)
    # The mean errors, (R, K, 1), their covariance, and the innovations' densities, (R, 1)
    changes, cov, log_densities = assimilate(
        cov, innovation[..., None], h, sensor.noise_cov, missing
    )
    # Every run has a covariance of its own, so that there is one column.
    error = changes[..., 0]
    k = chart.error_dim
    x = chart.retract(forecast, error[:, :k])
    _check_finite(x)
    smoothed = []
    for j, mean in enumerate(previous, start=1):
        # The observation tells of the earlier states too: their errors are block j.
        smoothed.append(chart.retract(mean, error[:, j * k : (j + 1) * k]))
    return _JointAnalysis(x, smoothed, cov, log_densities[:, 0])


def _replace_previous(
    x: Array, previous: list[Array], p: Array, y: Array, increments: list[_Part]
) -> tuple[list[Array], Array]:
    """Let sensors of increments that have observed compare with the present state from now on.

    Returns the states (R, d) with which each compares, and the covariance (R, K, K) of the present
    and those states' errors: where a state is replaced, its rows and columns become the present's.
    The arguments are the present states x (R, d), the earlier ones, the covariance p, and the
    observations y (R, m), which are NaN where missing.
    """
    if not increments:
        return previous, p
    k = p.shape[-1] // (1 + len(increments))
    n_runs = len(x)
    # For each run, the row of P that each row of the new P is a copy of.
    source = np.tile(np.arange(p.shape[-1]), (n_runs, 1))
    replaced = []
    for j, part in enumerate(increments, start=1):
        # The components of a part are all present or all missing, so the first one tells.
        is_observed = ~np.isnan(y[:, part.columns][:, 0])
        source[is_observed, j * k : (j + 1) * k] = np.arange(k)
        replaced.append(np.where(is_observed[:, None], x, previous[j - 1]))
    # Rows and columns of each run's P
    run = np.arange(n_runs)[:, None, None]
    return replaced, p[run, source[:, :, None], source[:, None, :]]


def _check_finite(x: Array) -> None:
    """Raise an error that names the first run whose state (R, d) is not finite."""
    infinite = ~np.isfinite(x).all(axis=-1)
    if infinite.any():
        raise np.linalg.LinAlgError(f"run {infinite.argmax()} is no longer finite")


def _error_jacobian(
    x: Array,
    cov: Array,
    previous: list[Array],
    parts: list[_Part],
    chart: QuaternionChart,
) -> Array:
    """Derivative of the observations in the present and the earlier errors, (R, m, K).

    By the chain rule it is the sensor's Jacobian times the tangent basis, H B(x). Present states x
    are (R, d), `previous` are those with which the parts of increments compare, and the covariance
    of all errors is (R, K, K), k for each state. A part has the `rows` of its sensor's observation,
    which are the `columns` of all observations.
    """
    basis = chart.tangent_basis(x)
    # The present errors come first in the joint covariance.
    k = chart.error_dim
    # Of the states, (R, d): where a sensor has no derivative, differences reach about as far.
    std = deviations(basis @ cov[..., :k, :k] @ basis.mT)
    # The parts stand side by side, so that the last one ends behind all observations.
    n_observed = parts[-1].columns.stop
    slope = np.zeros((len(x), n_observed, cov.shape[-1]))
    # Number of parts of increments so far; the errors of their earlier states are blocks 1, 2, ...
    j = 0
    for sensor, rows, columns in parts:
        earlier_state = previous[j] if sensor.uses_previous else None
        # By the present errors, and below by those of the earlier state
        present = sensor.jacobian(x, earlier_state, std=std) @ basis
        slope[:, columns, :k] = present[:, rows]
        if earlier_state is None:
            continue
        j += 1
        block = slice(j * k, (j + 1) * k)
        earlier = _earlier_jacobian(sensor, x, earlier_state, chart)
        slope[:, columns, block] = earlier[:, rows]
    return slope


def _earlier_jacobian(
    sensor: Sensor, x: Array, previous: Array, chart: QuaternionChart
) -> Array:
    """Derivative of a sensor of increments in the errors of the earlier states, (R, m, k).

    A sensor gives only the derivative in the present state, so that differences are taken.
    """

    def predict(varied: Array) -> Array:
        # Differences are taken at varied earlier states (R, n, d), with the same present state.
        return sensor.predict(np.broadcast_to(x[:, None], varied.shape), varied)

    slope = central_difference(predict, previous, difference=sensor.residual)
    return np.asarray(slope @ chart.tangent_basis(previous))
