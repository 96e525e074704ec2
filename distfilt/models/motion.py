r"""Motion of whatever moves: straight on, or in a turn, in a plane or in space.

States are positions first, then velocities, in m and m/s. The noise is white noise on the
acceleration: Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications to Tracking
and Navigation, Wiley 2001, sections 6.2.2 and 11.7.
"""

from __future__ import annotations

from functools import lru_cache
from typing import overload

import numpy as np
from scipy.special import spherical_jn

from ..checks import Array, count, number
from ..linalg import van_loan
from .base import LinearModel, Model

__all__ = ["constant_velocity", "coordinated_turn"]

_AXES = ("x", "y", "z")
_QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])
"""A quarter turn to the left."""


def constant_velocity(*, sigma: float, axes: int = 2) -> LinearModel:
    r"""Straight motion whose velocity wanders: positions, then velocities, along `axes` axes.

    .. math:: \ddot{\mathbf p} = \sigma\,\dot{\mathbf w},\qquad
        \mathbf Q = \sigma^2\begin{pmatrix} dt^3/3 & dt^2/2\\ dt^2/2 & dt\end{pmatrix}
        \otimes\mathbf I

    Parameters
    ----------
    sigma : float
        Strength of the acceleration's noise, at least 0: a velocity gathers a standard deviation
        of :math:`\sigma\sqrt{dt}` m/s.
    axes : int
        1, 2 or 3 axes.

    Examples
    --------
    >>> model = constant_velocity(sigma=0.1)
    >>> model.step([1.0, 2.0, 0.5, -0.5], 0.0, 2.0)
    array([ 2. ,  1. ,  0.5, -0.5])
    """
    density = number(sigma, "sigma", at_least=0, at_most=1e150) ** 2
    n = count(axes, "axes")
    if n > 3:
        raise ValueError(f"axes: needs 1, 2 or 3 axes, got {axes}")

    def transition(dt: float) -> Array:
        return np.asarray(np.kron([[1.0, dt], [0.0, 1.0]], np.eye(n)), dtype=np.float64)

    def noise(t: float, dt: float) -> Array:
        block = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        return np.asarray(np.kron(density * block, np.eye(n)), dtype=np.float64)

    names = (*_AXES[:n], *(f"v{axis}" for axis in _AXES[:n]))
    units = ("m",) * n + ("m/s",) * n
    return LinearModel.from_transition(2 * n, transition, noise, names=names, units=units)


@overload
def coordinated_turn(*, sigma: float, rate: float) -> LinearModel: ...


@overload
def coordinated_turn(*, sigma: float, turn_sigma: float) -> Model: ...


def coordinated_turn(
    *, sigma: float, rate: float | None = None, turn_sigma: float | None = None
) -> Model:
    r"""A turn at constant speed in the plane, at a known rate or at one that is estimated.

    With the turn rate ω and :math:`\tau = \omega\,dt`, the velocity turns by τ and the position
    moves by

    .. math:: dt\,\begin{pmatrix}\frac{\sin\tau}\tau & -\frac{1-\cos\tau}\tau\\
        \frac{1-\cos\tau}\tau & \frac{\sin\tau}\tau\end{pmatrix}\mathbf v,

    which is straight motion at ω = 0, without a special case.

    Parameters
    ----------
    sigma : float
        Strength of the acceleration's noise, at least 0.
    rate : float, optional
        The known turn rate in rad/s, positive to the left. The model then is linear, with the
        state (x, y, vx, vy) and exact noise.
    turn_sigma : float, optional
        In place of `rate`: the turn rate is the fifth component and wanders with this strength,
        at least 0, in rad/s per root second. Its noise and the one on the position and velocity
        are those of straight motion, as usual.

    Examples
    --------
    A quarter of a circle of radius 1:

    >>> model = coordinated_turn(sigma=0.0, rate=1.0)
    >>> model.step([1.0, 0.0, 0.0, 1.0], 0.0, np.pi / 2).round(12) + 0.0
    array([ 0.,  1., -1.,  0.])
    """
    if (rate is None) == (turn_sigma is None):
        raise ValueError("rate: needs either a known rate or turn_sigma, got both or none")
    if turn_sigma is not None:
        return _estimated_turn(sigma, number(turn_sigma, "turn_sigma", at_least=0))
    omega = number(rate, "rate")
    drift = np.zeros((4, 4))
    drift[:2, 2:], drift[2:, 2:] = np.eye(2), omega * _QUARTER
    density = number(sigma, "sigma", at_least=0, at_most=1e150) ** 2 * np.diag([0.0, 0.0, 1.0, 1.0])

    @lru_cache(maxsize=64)
    def noise(dt: float) -> Array:
        cov = van_loan(drift, density, dt)[1]
        cov.setflags(write=False)
        return cov

    straight = constant_velocity(sigma=sigma)
    return LinearModel.from_transition(
        4, lambda dt: _turn(np.asarray(omega), dt), lambda t, dt: noise(dt), names=straight.names,
        units=straight.units,
    )


def _estimated_turn(sigma: float, turn_sigma: float) -> Model:
    """The model with the turn rate as its fifth component."""
    straight = constant_velocity(sigma=sigma)

    def flow(x: Array, t: float, dt: float) -> Array:
        moved = (_turn(x[..., 4], dt) @ x[..., :4, None])[..., 0]
        return np.concatenate([moved, x[..., 4:]], axis=-1)

    def derivative(x: Array, t: float, dt: float) -> Array:
        out = np.zeros((*x.shape, 5))
        out[..., :4, :4] = _turn(x[..., 4], dt)
        out[..., :4, 4] = (_turn_slope(x[..., 4], dt) @ x[..., 2:4, None])[..., 0]
        out[..., 4, 4] = 1.0
        return out

    def noise(t: float, dt: float) -> Array:
        cov = np.zeros((5, 5))
        cov[:4, :4] = straight.noise_cov(t, dt)
        cov[4, 4] = turn_sigma**2 * dt
        return cov

    return Model(
        5, flow, noise, derivative=derivative, names=(*straight.names, "turn rate"),
        units=(*straight.units, "rad/s"),
    )


def _turn(omega: Array, dt: float) -> Array:
    """Transition of (position, velocity) in a turn, (..., 4, 4)."""
    tau = omega * dt
    out = np.zeros((*np.shape(omega), 4, 4))
    out[..., :2, :2] = np.eye(2)
    # (1 - cos)/tau, written so that nothing cancels and zero needs no case of its own.
    along, aside = np.sinc(tau / np.pi), 0.5 * tau * np.sinc(0.5 * tau / np.pi) ** 2
    out[..., :2, 2:] = dt * _spiral(along, aside)
    out[..., 2:, 2:] = _spiral(np.cos(tau), np.sin(tau))
    return out


def _turn_slope(omega: Array, dt: float) -> Array:
    """Derivative of the transition's velocity columns in the turn rate, (..., 4, 2)."""
    tau = omega * dt
    half = 0.5 * tau
    j0 = np.sinc(half / np.pi)
    along, aside = -_bessel(tau), 0.5 * j0**2 - half * j0 * _bessel(half)
    moved = dt**2 * _spiral(along, aside)
    turned = dt * _spiral(-np.sin(tau), np.cos(tau))
    return np.concatenate([moved, turned], axis=-2)


def _bessel(x: Array) -> Array:
    """The spherical Bessel function j1, minus the derivative of sin(x)/x, without cancellation."""
    small = np.abs(x) < 1e-3
    series = x / 3 * (1 - x**2 / 10)
    return np.where(small, series, np.sign(x) * spherical_jn(1, np.abs(np.where(small, 1.0, x))))


def _spiral(along: Array, aside: Array) -> Array:
    """The matrix that stretches by `along` and adds `aside` times a quarter turn."""
    return np.asarray(
        np.asarray(along)[..., None, None] * np.eye(2)
        + np.asarray(aside)[..., None, None] * _QUARTER
    )
