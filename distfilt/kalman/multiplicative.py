r"""An extended Kalman filter for states that do not fill their space, such as a unit quaternion.

The mean stays where states can be; its error lives in the tangent directions. For a quaternion
that is the multiplicative extended Kalman filter: three numbers for the error of an attitude, and
no spread along its length.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, count, instance
from ..differences import _central
from ..models import Model
from ..models.rotations import left_directions, turn_between, turned
from ..sensors import Sensor, stack
from ._inputs import series
from ._steps import analysed, linearised, moved_cov, over_time
from .linear import GaussianRun

__all__ = ["Chart", "multiplicative_filter", "quaternion_chart"]


@dataclass(frozen=True)
class Chart:
    """How errors with k components move a state with d.

    Parameters
    ----------
    dim, error_dim : int
        Sizes d of the state and k of the error, k ≤ d.
    retract : callable
        ``retract(x, e) -> x`` moves states (..., d) by errors (..., k).
    local : callable
        ``local(x, other) -> e``, its inverse: the error that takes x to `other`.
    directions : callable
        ``directions(x)``, the derivative of `retract` at no error, (..., d, k), of full rank.

    Examples
    --------
    >>> plain = Chart(2, 2, np.add, lambda x, other: other - x, lambda x: np.eye(2))
    >>> plain.project([1.0, 2.0], np.eye(2))
    array([[1., 0.],
           [0., 1.]])
    """

    dim: int
    error_dim: int
    retract: Callable[[Array, Array], Array]
    local: Callable[[Array, Array], Array]
    directions: Callable[[Array], Array]

    def __post_init__(self) -> None:
        if count(self.error_dim, "error_dim") > count(self.dim, "dim"):
            raise ValueError(f"error_dim: needs at most {self.dim}, got {self.error_dim}")
        for name in ("retract", "local", "directions"):
            callable_(getattr(self, name), name)

    def project(self, x: ArrayLike, cov: ArrayLike) -> Array:
        """Covariance of the errors, (..., k, k), of states with covariance `cov`, (..., d, d)."""
        state = array(x, "x", (..., self.dim))
        p = array(cov, "cov", (..., self.dim, self.dim))
        inwards = self._inwards(state)
        return np.asarray(inwards @ p @ np.swapaxes(inwards, -1, -2))

    def _inwards(self, x: Array) -> Array:
        """The errors (..., k, d) of small moves of the state: the directions' pseudo-inverse."""
        b = self.directions(x)
        across = np.swapaxes(b, -1, -2)
        return np.asarray(np.linalg.solve(across @ b, across))


def quaternion_chart(dim: int, first: int) -> Chart:
    """States with a quaternion among their components, and the rest as it is.

    The error's components are the state's, with the rotation vector of
    :func:`distfilt.models.turned` in the quaternion's place: one fewer.

    Parameters
    ----------
    dim : int
        Size d of the state.
    first : int
        Where the quaternion begins; its scalar part is first.

    Examples
    --------
    >>> chart = quaternion_chart(5, 1)
    >>> chart.retract(np.array([2.0, 1, 0, 0, 0]), np.array([0.5, np.pi, 0, 0])).round(3) + 0.0
    array([2.5, 0. , 1. , 0. , 0. ])
    """
    d, at = count(dim, "dim"), count(first, "first", at_least=0)
    if at + 4 > d:
        raise ValueError(f"first: needs four components from there on, got {first} of {dim}")

    def retract(x: Array, e: Array) -> Array:
        turn = turned(x[..., at : at + 4], e[..., at : at + 3])
        before, behind = x[..., :at] + e[..., :at], x[..., at + 4 :] + e[..., at + 3 :]
        return np.concatenate([before, turn, behind], axis=-1)

    def local(x: Array, other: Array) -> Array:
        turn = turn_between(x[..., at : at + 4], other[..., at : at + 4])
        gap = other - x
        return np.concatenate([gap[..., :at], turn, gap[..., at + 4 :]], axis=-1)

    def directions(x: Array) -> Array:
        out = np.zeros((*x.shape, d - 1))
        out[..., :at, :at] = np.eye(at)
        out[..., at : at + 4, at : at + 3] = left_directions(x[..., at : at + 4])
        out[..., at + 4 :, at + 3 :] = np.eye(d - at - 4)
        return out

    return Chart(d, d - 1, retract, local, directions)


def multiplicative_filter(
    mean: ArrayLike, cov: ArrayLike, observations: ArrayLike, *, chart: Chart, model: Model,
    sensors: Sequence[Sensor], times: ArrayLike, t0: float = 0.0,
) -> GaussianRun:
    r"""The extended Kalman filter on a chart's errors, over series of observations.

    With the directions B of the chart and their pseudo-inverse, the errors' transition is
    :math:`\mathbf B(\mathbf x')^+\,\mathbf J\,\mathbf B(\mathbf x)`, their noise
    :math:`\mathbf B(\mathbf x')^+\mathbf Q\,\mathbf B(\mathbf x')^{+\top}`, and a sensor's matrix
    :math:`\mathbf H\,\mathbf B(\mathbf x)`; an analysis moves the mean by `retract`. The
    covariances (T, ..., k, k) are those of the errors ``chart.local(means, truth)``.

    Parameters
    ----------
    mean : array_like, (d,) or (..., d)
        Prior mean at `t0`.
    cov : array_like, (k, k) or (..., k, k)
        Prior covariance of the error; :meth:`Chart.project` makes it of the state's.
    observations : array_like, (T, ..., m)
        As for :func:`extended_filter`.
    chart : Chart
        Such as :func:`quaternion_chart`.
    model, sensors, times, t0
        As for :func:`extended_filter`; sensors of changes are welcome too: the errors of the
        previous state are kept beside those of the present one until the reading is used.

    Notes
    -----
    E. J. Lefferts, F. L. Markley and M. D. Shuster, Journal of Guidance 5 (1982) 417-429. That the
    directions turn with the mean in an analysis is of second order and left out.

    Examples
    --------
    >>> from distfilt.models import satellite_pose
    >>> from distfilt.sensors import direct
    >>> x = np.r_[np.zeros(6), [0.3, 0.2, 0.1], [1.0, 0.0, 0.0, 0.0]]
    >>> run = multiplicative_filter(
    ...     x, 0.01 * np.eye(12), np.zeros((1, 3)), chart=quaternion_chart(13, 9),
    ...     model=satellite_pose(rate=0.1, sigma=0.2, step=0.1),
    ...     sensors=[direct([10, 11, 12], std=0.1)], times=[0.1])
    >>> float((run.means[0, 9:] ** 2).sum().round(9)), run.covariances.shape
    (1.0, (1, 12, 12))
    """
    sensor = stack(sensors)
    instance(model, "model", Model)
    instance(chart, "chart", Chart)
    if chart.dim != model.dim:
        raise ValueError(f"chart: needs {model.dim} components like the model, got {chart.dim}")

    def forecast(x: Array, p: Array, t: float, dt: float) -> tuple[Array, Array]:
        moved = model._step(x, t, dt)
        inwards = chart._inwards(moved)
        slope = inwards @ model._jacobian(x, t, dt) @ chart.directions(x)
        after = moved_cov(p, slope, inwards @ model.noise(t, dt) @ inwards.swapaxes(-1, -2))
        if not sensor.uses_previous:
            return moved, after
        across = slope @ p
        joint = np.block([[after, across], [across.swapaxes(-1, -2), p]])
        return np.concatenate([moved, x], axis=-1), joint

    def analyse(x: Array, p: Array, y: Array) -> tuple[Array, Array, Array]:
        innovation, slope = _errors_seen(x, y, sensor, chart)
        error, p, density = analysed(np.zeros(p.shape[:-1]), p, innovation, slope, sensor.cov)
        k = chart.error_dim
        return chart.retract(x[:, : chart.dim], error[:, :k]), p[:, :k, :k], density

    checked = series(observations, times, t0, sensor.dim)
    return over_time(*checked, mean, cov, model.dim, forecast, analyse, chart.error_dim)


def _errors_seen(x: Array, y: Array, sensor: Sensor, chart: Chart) -> tuple[Array, Array]:
    """Innovations, and how a sensor sees the errors, of the previous state too if it uses it."""
    if not sensor.uses_previous:
        innovation, slope = linearised(x, y, sensor)
        return innovation, np.asarray(slope @ chart.directions(x))
    now, before = x[:, : chart.dim], x[:, chart.dim :]
    innovation, slope = linearised(now, y, sensor, before)

    def of_before(v: Array) -> Array:
        return sensor._predict(np.broadcast_to(now[:, None], v.shape), v)

    back = _central(of_before, before, sensor._residual)
    back = np.where(np.isnan(innovation)[..., None], 0.0, back)
    both = [slope @ chart.directions(now), back @ chart.directions(before)]
    return innovation, np.concatenate(both, axis=-1)
