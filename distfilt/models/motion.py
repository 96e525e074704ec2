r"""Motion straight on, by rates of change, and Lorenz's convection, the smallest chaotic flow.

The states of straight motion are positions first, then velocities, in m and m/s. The noise is white
noise on the acceleration: Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications
to Tracking and Navigation, Wiley 2001, section 6.2.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Annotated

import numpy as np

from ..validation import (
    Array,
    Bounds,
    NonNegativeFloat,
    PositiveFloat,
    check_array,
    validated,
)
from .base import LinearModel, Model, Strength

__all__ = ["constant_velocity", "integrate", "lorenz63", "rk4"]

Rate = Callable[[Array, float], Array]
_MOST = 10_000_000
"""More integration steps than this are a mistake in `longest`, not a wish."""
_AXES = ("x", "y", "z")
# Arrays without axes: an array of few states is multiplied by a number in half again the time.
_PRANDTL = np.array(10.0)
_RAYLEIGH = np.array(28.0)
_SHAPE = np.array(8 / 3)


@validated
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
        2 * axes,
        partial(_straight, axes=axes),
        partial(_straight_noise, sigma=sigma, axes=axes),
        names=(*_AXES[:axes], *(f"v{axis}" for axis in _AXES[:axes])),
        units=("m",) * axes + ("m/s",) * axes,
    )


def _straight(dt: float, axes: int) -> Array:
    return _along_axes(((1.0, dt), (0.0, 1.0)), axes)


def _straight_noise(t: float, dt: float, sigma: float, axes: int) -> Array:
    both = dt**2 / 2
    q = sigma**2
    return _along_axes(((q * (dt**3 / 3), q * both), (q * both, q * dt)), axes)


@lru_cache(maxsize=64)
def _along_axes(block: tuple[tuple[float, float], ...], axes: int) -> Array:
    """A block for each axis, read-only, since the same few are asked for in every step."""
    out = np.asarray(np.kron(block, np.eye(axes)), dtype=np.float64)
    out.setflags(write=False)
    return out


@validated
def rk4(
    rate: Rate,
    x: Array,
    t: float,
    dt: NonNegativeFloat,
    *,
    longest: PositiveFloat | None = None,
) -> Array:
    r"""Advance :math:`\dot{\mathbf x} = \mathbf f(\mathbf x, t)` by the classical Runge-Kutta rule.

    Parameters
    ----------
    rate : callable
        ``rate(x, t) -> dx/dt`` on arrays of the shape of `x`, which it may change and return.
    x : array_like, (..., d)
        States at `t`.
    t : float
        The time, in s.
    dt : float
        How far, in s, at least 0.
    longest : float, optional
        Longest integration step, in s, positive: `dt` is cut into the fewest equal steps that are
        not longer, ten million at most. One step by default. The error falls with its fourth power.

    Notes
    -----
    W. Kutta, Zeitschrift für Mathematik und Physik 46 (1901) 435-453.

    Examples
    --------
    >>> rk4(lambda x, t: -x, [1.0], 0.0, 1.0, longest=0.1).round(6)
    array([0.36788])
    """
    h = dt / (steps := equal_steps(dt, longest))
    state = x
    for k in range(steps):
        s = t + k * h
        # The rate may work in place: it gets arrays of its own, and what it returns is used before
        # it is called again.
        slope = check_array(rate(state.copy("K"), s), "rate", x.shape, finite=False)
        total = 0.5 * slope
        slope = rate(state + 0.5 * h * slope, s + 0.5 * h)
        total += slope
        slope = rate(state + 0.5 * h * slope, s + 0.5 * h)
        total += slope
        total += 0.5 * rate(state + h * slope, s + h)
        total *= h / 3
        total += state
        state = total
    return np.asarray(state)


def equal_steps(dt: float, longest: float | None) -> int:
    """The fewest equal steps of `dt` that are not longer than `longest`."""
    if longest is None:
        return 1
    # A step that divides dt up to rounding is not cut once more.
    needed = dt / longest - 1e-9
    if not needed <= _MOST:
        raise ValueError(
            f"longest must have at least {dt / _MOST:g} for steps over {dt:g} s, got {longest:g}"
        )
    return max(1, math.ceil(needed))


def integrate(
    rate: Rate,
    density: Array,
    *,
    step: float,
    names: tuple[str, ...],
    units: tuple[str, ...],
) -> Model:
    """The model that :func:`rk4` makes of a rate, with white noise of a spectral density (d, d)."""
    return Model(
        len(density),
        partial(_flow, rate=rate, longest=step),
        partial(_white, density),
        names=names,
        units=units,
    )


def _flow(x: Array, t: float, dt: float, rate: Rate, longest: float) -> Array:
    # Each component of all states side by side in memory: twice as fast, and the same numbers.
    return np.ascontiguousarray(rk4(rate, x.copy("F"), t, dt, longest=longest))


def _white(density: Array, t: float, dt: float) -> Array:
    return density * dt


@validated
def lorenz63(*, sigma: Strength = 0.0, step: PositiveFloat = 0.01) -> Model:
    r"""Lorenz's model of 1963, integrated by Runge-Kutta of order 4 with a fixed step.

    .. math:: \dot x = 10\,(y-x),\quad \dot y = x(28-z)-y,\quad \dot z = xy-\tfrac83z

    Parameters
    ----------
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
    return integrate(
        _rate, sigma**2 * np.eye(3), step=step, names=_AXES, units=("1",) * 3
    )


def _rate(state: Array, t: float) -> Array:
    x = state[..., 0]
    y = state[..., 1]
    z = state[..., 2]
    out = np.empty_like(state)
    np.multiply(_PRANDTL, y - x, out[..., 0])
    np.subtract(x * (_RAYLEIGH - z), y, out[..., 1])
    np.subtract(x * y, _SHAPE * z, out[..., 2])
    return out
