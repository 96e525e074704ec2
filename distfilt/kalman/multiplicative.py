r"""The multiplicative extended Kalman filter, for states with a unit quaternion.

The mean stays where states can be; its error lives in the tangent directions: three numbers for the
error of an attitude, and no spread along its length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ..linalg import central
from ..models import Model
from ..models.quaternions import left_directions, rotate, rotation_vector_between
from ..sensors import Sensor, stack
from ..validation import (
    Array,
    FrozenModel,
    NonNegativeInt,
    PositiveDefinite,
    PositiveInt,
    Times,
    validated,
)
from .linear import FilterResult, Series, assimilate, flatten_runs, grid, unflatten_runs

__all__ = ["QuaternionChart", "mekf"]


@dataclass(frozen=True, eq=False)
class QuaternionChart(FrozenModel):
    """How errors move a state with a quaternion among its components, and the rest as it is.

    The error's components are the state's, with the rotation vector of
    :func:`distfilt.models.quaternions.rotate` in the quaternion's place: one fewer.

    Parameters
    ----------
    dim : int
        Size d of the state.
    first : int
        Where the quaternion begins; its scalar part is first.

    Examples
    --------
    >>> chart = QuaternionChart(5, 1)
    >>> (
    ...     chart.retract(
    ...         np.array([2.0, 1, 0, 0, 0]), np.array([0.5, np.pi, 0, 0])
    ...     ).round(3)
    ...     + 0.0
    ... )
    array([2.5, 0. , 1. , 0. , 0. ])
    >>> chart.project([2.0, 1, 0, 0, 0], np.eye(5)).diagonal()
    array([1., 4., 4., 4.])
    """

    dim: PositiveInt
    first: NonNegativeInt

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.first + 4 > self.dim:
            needs = f"four components from there on, got {self.first} of {self.dim}"
            raise ValueError(f"first must be {needs}")

    @property
    def error_dim(self) -> int:
        """Size k of the error."""
        return self.dim - 1

    def retract(self, x: Array, e: Array) -> Array:
        """Move states (..., d) by errors (..., k)."""
        at = self.first
        turn = rotate(x[..., at : at + 4], e[..., at : at + 3])
        before = x[..., :at] + e[..., :at]
        behind = x[..., at + 4 :] + e[..., at + 3 :]
        return np.concatenate([before, turn, behind], axis=-1)

    def local(self, x: Array, other: Array) -> Array:
        """The error that takes x to `other`, the inverse of `retract`."""
        at = self.first
        gap = other - x
        turn = rotation_vector_between(x[..., at : at + 4], other[..., at : at + 4])
        return np.concatenate([gap[..., :at], turn, gap[..., at + 4 :]], axis=-1)

    def tangent_basis(self, x: Array) -> Array:
        """The derivative of `retract` at no error, (..., d, k)."""
        at = self.first
        out = np.zeros((*x.shape, self.error_dim))
        out[..., :at, :at] = np.eye(at)
        out[..., at : at + 4, at : at + 3] = left_directions(x[..., at : at + 4])
        out[..., at + 4 :, at + 3 :] = np.eye(self.dim - at - 4)
        return out

    @validated
    def project(
        self,
        x: Annotated[Array, "... self.dim"],
        cov: Annotated[Array, "... self.dim self.dim"],
    ) -> Array:
        """Covariance of the errors, (..., k, k), of states with covariance `cov`, (..., d, d)."""
        inwards = self.tangent_projection(x)
        return inwards @ cov @ inwards.mT

    def tangent_projection(self, x: Array) -> Array:
        """The errors (..., k, d) of small moves of the state: the directions' pseudo-inverse."""
        b = self.tangent_basis(x)
        return np.asarray(np.linalg.solve(b.mT @ b, b.mT))


@validated
def mekf(
    mean: Annotated[Array, "... model.dim"],
    cov: Annotated[PositiveDefinite, "... chart.error_dim chart.error_dim"],
    observations: Series,
    *,
    chart: QuaternionChart,
    model: Model,
    sensors: Sequence[Sensor],
    times: Times,
) -> FilterResult:
    r"""The extended Kalman filter on a chart's errors, over series of observations.

    With the directions B of the chart and their pseudo-inverse, the errors' transition is
    :math:`\mathbf B(\mathbf x')^+\,\mathbf J\,\mathbf B(\mathbf x)`, their noise
    :math:`\mathbf B(\mathbf x')^+\mathbf Q\,\mathbf B(\mathbf x')^{+\top}`, and a sensor's matrix
    :math:`\mathbf H\,\mathbf B(\mathbf x)`; an analysis moves the mean by `retract`. The
    covariances (T, ..., k, k) are those of the errors ``chart.local(means, truth)``.

    Parameters
    ----------
    mean : array_like, (d,) or (..., d)
        Prior mean at time 0.
    cov : array_like, (k, k) or (..., k, k)
        Prior covariance of the error; :meth:`QuaternionChart.project` makes it of the state's.
    observations : array_like, (T, ..., m)
        The observations of all sensors, one after the other; the middle axes are the runs. NaN
        marks a missing component.
    chart : QuaternionChart
        Which components are the quaternion.
    model : Model
        Linearised about each analysis mean.
    sensors : sequence of Sensor
        Linearised about each forecast mean. Sensors of changes are welcome too: the errors of the
        previous state are kept beside those of the present one until the reading is used.
    times : array_like, (T,)
        Observation times after 0, in s.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a run leaves the finite numbers or its covariance is no longer positive definite; the
        message has the time.

    Notes
    -----
    E. J. Lefferts, F. L. Markley and M. D. Shuster, Journal of Guidance 5 (1982) 417-429. That the
    directions turn with the mean in an analysis is of second order and left out.

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
    sensor = stack(sensors)
    if chart.dim != model.dim:
        raise ValueError(
            f"chart must be {model.dim} components like the model, got {chart.dim}"
        )
    clock = grid(times, observations, sensor)
    runs, y, x, p = flatten_runs(mean, cov, observations)
    means = np.empty((len(y), *x.shape))
    covs = np.empty((len(y), *p.shape))
    density = np.empty(y.shape[:2])
    for n, t in enumerate(times):
        try:
            x, p, density[n] = _step(
                x, p, y[n], chart, model, sensor, clock[n], t - clock[n]
            )
        except np.linalg.LinAlgError as error:
            raise np.linalg.LinAlgError(f"at t = {t:g}: {error}") from None
        means[n] = x
        covs[n] = p
    return unflatten_runs(means, covs, density, runs)


def _step(
    x: Array,
    p: Array,
    y: Array,
    chart: QuaternionChart,
    model: Model,
    sensor: Sensor,
    t: float,
    dt: float,
) -> tuple[Array, Array, Array]:
    """Means (R, d), covariances (R, k, k) and log densities (R,) one reading later."""
    moved = _finite(model.step(x, t, dt))
    inwards = chart.tangent_projection(moved)
    slope = inwards @ model.jacobian(x, t, dt) @ chart.tangent_basis(x)
    joint = slope @ p @ slope.mT + inwards @ model.Q(t, dt) @ inwards.mT
    previous = None
    if sensor.uses_previous:
        across = slope @ p
        previous = x
        joint = np.block([[joint, across], [across.mT, p]])
    gap = sensor.residual(y, sensor.predict(moved, previous))
    missing = np.isnan(gap)
    h = _errors_seen(moved, previous, sensor, chart)
    h = np.where(missing[..., None], 0.0, h)
    gap = np.where(missing, 0.0, gap)
    error, joint, density = assimilate(
        joint, gap[..., None], h, sensor.noise_cov, missing
    )
    k = chart.error_dim
    return (
        _finite(chart.retract(moved, error[:, :k, 0])),
        joint[:, :k, :k],
        density[:, 0],
    )


def _finite(x: Array) -> Array:
    lost = ~np.isfinite(x).all(axis=-1)
    if lost.any():
        raise np.linalg.LinAlgError(f"run {lost.argmax()} is no longer finite")
    return x


def _errors_seen(
    x: Array, previous: Array | None, sensor: Sensor, chart: QuaternionChart
) -> Array:
    """How a sensor sees the errors (R, m, k), of the previous state too if it uses it."""
    slope = sensor.jacobian(x, previous) @ chart.tangent_basis(x)
    if previous is None:
        return np.asarray(slope)

    def of_previous(v: Array) -> Array:
        return sensor.predict(np.broadcast_to(x[:, None], v.shape), v)

    back = central(of_previous, previous, difference=sensor.residual)
    return np.concatenate([slope, back @ chart.tangent_basis(previous)], axis=-1)
