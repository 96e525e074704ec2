r"""Motion straight on, whatever moves, and Lorenz's convection, the smallest chaotic flow.

The states of straight motion are positions first, then velocities, in m and m/s. The noise is white
noise on the acceleration: Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications
to Tracking and Navigation, Wiley 2001, section 6.2.2.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any

import numpy as np

from ..doors import Array, Bounds, Positive, door
from .base import LinearModel, Model, Strength
from .integrators import integrated

__all__ = ["constant_velocity", "lorenz63"]

_AXES = ("x", "y", "z")


@door
def constant_velocity(
    *, sigma: Strength, axes: Annotated[int, Bounds(at_least=1, at_most=3)] = 2
) -> LinearModel:
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
    return LinearModel.from_transition(
        2 * axes, partial(_straight, axes=axes), partial(_straight_noise, sigma=sigma, axes=axes),
        names=(*_AXES[:axes], *(f"v{axis}" for axis in _AXES[:axes])),
        units=("m",) * axes + ("m/s",) * axes,
    )


def _straight(dt: float, axes: int) -> Array:
    return np.asarray(np.kron([[1.0, dt], [0.0, 1.0]], np.eye(axes)), dtype=np.float64)


def _straight_noise(t: float, dt: float, sigma: float, axes: int) -> Array:
    block = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    return np.asarray(np.kron(sigma**2 * block, np.eye(axes)), dtype=np.float64)


@door
def lorenz63(
    *, prandtl: float = 10.0, rho: float = 28.0, beta: float = 8 / 3, sigma: Strength = 0.0,
    step: Positive = 0.01,
) -> Model:
    r"""Lorenz's model of 1963, integrated by Runge-Kutta of order 4 with a fixed step.

    .. math:: \dot x = p(y-x),\quad \dot y = x(\rho-z)-y,\quad \dot z = xy-\beta z

    Parameters
    ----------
    prandtl, rho, beta : float
        Prandtl number, scaled Rayleigh number and geometry.
    sigma : float
        Strength of independent white noise on each component: it gathers a standard deviation of
        ``sigma * sqrt(dt)`` in a step; none by default.
    step : float
        Longest integration step, positive, in units of time.

    Notes
    -----
    E. N. Lorenz, Journal of the Atmospheric Sciences 20 (1963) 130-141.

    Examples
    --------
    >>> lorenz63().step([1.0, 1.0, 20.0], 0.0, 0.1).shape
    (3,)
    """
    given: dict[str, Any] = {"prandtl": prandtl, "rho": rho, "beta": beta}
    return integrated(
        partial(_rate, **given), partial(_slope, **given), sigma**2 * np.eye(3), step=step,
        names=("x", "y", "z"), units=("1",) * 3,
    )


def _rate(state: Array, t: float, prandtl: float, rho: float, beta: float) -> Array:
    x, y, z = state[..., 0], state[..., 1], state[..., 2]
    out = np.empty_like(state)
    np.multiply(prandtl, y - x, out=out[..., 0])
    np.subtract(x * (rho - z), y, out=out[..., 1])
    np.subtract(x * y, beta * z, out=out[..., 2])
    return out


def _slope(state: Array, t: float, prandtl: float, rho: float, beta: float) -> Array:
    """Derivative of the right-hand side, (..., 3, 3)."""
    x, y, z = state[..., 0], state[..., 1], state[..., 2]
    out = np.zeros((*state.shape, 3))
    out[..., 0, 0], out[..., 0, 1] = -prandtl, prandtl
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = rho - z, -1.0, -x
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = y, x, -beta
    return out
