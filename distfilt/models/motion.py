r"""Straight motion, motion by rates of change (Runge-Kutta), and Lorenz's chaotic convection.

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

from ..periods import PeriodsArgument
from ..validation import (
    Array,
    Bounds,
    NonNegativeFloat,
    PositiveFloat,
    call_user,
    check_array,
    validated,
)
from .base import LinearModel, Model, NoiseStrength

__all__ = ["constant_velocity", "integrate", "lorenz63", "rk4"]

Rate = Callable[[Array, float], Array]
_MAX_STEPS = 10_000_000
"""More integration steps than this are taken for a mistake in `longest`."""
_AXES = ("x", "y", "z")
# Zero-dimensional arrays: a Python number makes the product with a small array half as slow again.
_PRANDTL = np.array(10.0)
_RAYLEIGH = np.array(28.0)
_SHAPE = np.array(8 / 3)


@validated
def constant_velocity(
    *, sigma: NoiseStrength, axes: Annotated[int, Bounds(at_least=1, at_most=3)] = 2
) -> LinearModel:
    r"""Straight motion whose velocity wanders: positions, then velocities, along `axes` axes.

    .. math:: \ddot{\mathbf p} = \sigma\,\dot{\mathbf w},\qquad
        \mathbf Q = \sigma^2\begin{pmatrix} dt^3/3 & dt^2/2\\ dt^2/2 & dt\end{pmatrix}
        \otimes\mathbf I

    Parameters
    ----------
    sigma : float
        Strength of the acceleration's noise, at least 0: within dt, a velocity accumulates a
        standard deviation of :math:`\sigma\sqrt{dt}` m/s.
    axes : int
        1, 2 or 3 axes.

    Examples
    --------
    >>> model = constant_velocity(sigma=0.1)
    >>> model.step([1.0, 2.0, 0.5, -0.5], 0.0, 2.0)
    array([ 2. ,  1. ,  0.5, -0.5])
    """
    # Names of the components, such as x, y, vx, vy
    positions = _AXES[:axes]
    velocities = tuple(f"v{axis}" for axis in positions)
    return LinearModel.from_transition(
        2 * axes,
        partial(_straight_transition, axes=axes),
        partial(_straight_noise, sigma=sigma, axes=axes),
        names=positions + velocities,
        units=("m",) * axes + ("m/s",) * axes,
        time_invariant=True,
    )


def _straight_transition(dt: float, axes: int) -> Array:
    """Return the matrix of straight motion: p + v dt and v, positions before velocities."""
    return _repeat_along_axes(((1.0, dt), (0.0, 1.0)), axes)


def _straight_noise(t: float, dt: float, sigma: float, axes: int) -> Array:
    """Return the covariance of a step with white acceleration, positions before velocities."""
    q = sigma**2
    # σ² (dt³/3, dt²/2; dt²/2, dt), the integral of white acceleration
    position = q * (dt**3 / 3)
    cross = q * (dt**2 / 2)
    velocity = q * dt
    return _repeat_along_axes(((position, cross), (cross, velocity)), axes)


@lru_cache(maxsize=64)
def _repeat_along_axes(block: tuple[tuple[float, float], ...], axes: int) -> Array:
    """Kronecker product of a block with I, read-only and cached: few recur in every step.

    The block is 2 x 2, and I has the size of the number of axes.
    """
    # All positions, then all velocities: block ⊗ I. Its four quarters are diagonal. In the
    # matrix's numbers, row after row, a step along a diagonal is one of n + 1 numbers.
    (upper_left, upper_right), (lower_left, lower_right) = block
    n = 2 * axes
    half = n * axes
    numbers = np.zeros(n * n)
    numbers[: half : n + 1] = upper_left
    numbers[axes : half : n + 1] = upper_right
    numbers[half :: n + 1] = lower_left
    numbers[half + axes :: n + 1] = lower_right
    matrix = numbers.reshape(n, n)
    # All callers share the cached array.
    matrix.setflags(write=False)
    return matrix


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
        Length of the integration interval, in s, at least 0.
    longest : float, optional
        Longest integration step, in s, positive: `dt` is divided into the smallest number of equal
        steps that are not longer, ten million at most. One step by default. The error falls with
        the fourth power of the step.

    Notes
    -----
    W. Kutta, Zeitschrift für Mathematik und Physik 46 (1901) 435-453.

    Examples
    --------
    >>> rk4(lambda x, t: -x, [1.0], 0.0, 1.0, longest=0.1).round(6)
    array([0.36788])
    """
    return runge_kutta(partial(call_user, rate), x, t, dt, longest)


def runge_kutta(
    rate: Rate, x: Array, t: float, dt: float, longest: float | None = None
) -> Array:
    """Integrate like :func:`rk4`, without validation; `dt` may be negative.

    States are (..., d), and steps are not longer than `longest`; one step by default.
    """
    steps = count_steps(abs(dt), longest)
    # Equal steps: the last one ends at t + dt, up to rounding.
    h = dt / steps
    for k in range(steps):
        s = t + k * h
        # x + h/6 (k1 + 2 k2 + 2 k3 + k4) with four slopes: k1 here, k2 and k3 halfway, k4 at the
        # end. It is computed as x + h/3 (k1/2 + k2 + k3 + k4/2).
        # The rate may work in place: it gets arrays of its own (a copy in the same order of memory,
        # "K"), and its result is used before it is called again.
        slope = check_array(rate(x.copy("K"), s), "rate", x.shape, finite=False)
        total = 0.5 * slope
        slope = rate(x + 0.5 * h * slope, s + 0.5 * h)
        total += slope
        slope = rate(x + 0.5 * h * slope, s + 0.5 * h)
        total += slope
        total += 0.5 * rate(x + h * slope, s + h)
        total *= h / 3
        total += x
        x = total
    return np.asarray(x)


def count_steps(dt: float, longest: float | None) -> int:
    """Smallest number of equal steps over `dt` that are not longer than `longest`."""
    if longest is None:
        return 1
    # A step that divides dt up to rounding is not divided once more.
    ratio = dt / longest - 1e-9
    if not ratio <= _MAX_STEPS:
        raise ValueError(
            f"longest must be at least {dt / _MAX_STEPS:g} for an interval of {dt:g} s, "
            f"got {longest:g}"
        )
    return max(1, math.ceil(ratio))


def integrate(
    rate: Rate,
    density: Array,
    *,
    step: float,
    names: tuple[str, ...],
    units: tuple[str, ...],
    periods: PeriodsArgument = (),
) -> Model:
    """Build a model from a rate by :func:`rk4`, with white noise of spectral density (d, d).

    `step` is the longest step of the integration; names, units and periods are those of the
    components.
    """
    return Model(
        len(density),
        partial(_rk4_transition, rate=rate, longest=step),
        partial(_white_noise, density),
        names=names,
        units=units,
        periods=periods,
    )


def _rk4_transition(x: Array, t: float, dt: float, rate: Rate, longest: float) -> Array:
    """Move states (..., d) from `t` to `t` + `dt` by Runge-Kutta steps of `longest` at most."""
    # Fortran order: each component of all states is contiguous in memory, which is twice as fast.
    states = x.copy("F")
    return np.ascontiguousarray(runge_kutta(rate, states, t, dt, longest))


def _white_noise(density: Array, t: float, dt: float) -> Array:
    """Return the covariance that white noise of a spectral density (d, d) accumulates in `dt`."""
    return density * dt


@validated
def lorenz63(*, sigma: NoiseStrength = 0.0, step: PositiveFloat = 0.01) -> Model:
    r"""Lorenz's model of 1963, integrated by Runge-Kutta of order 4 with a fixed step.

    .. math:: \dot x = 10\,(y-x),\quad \dot y = x(28-z)-y,\quad \dot z = xy-\tfrac83z

    Parameters
    ----------
    sigma : float
        Strength of independent white noise on each component, which adds a standard deviation of
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
    # Independent noise on each component
    density = sigma**2 * np.eye(3)
    return integrate(_lorenz_rate, density, step=step, names=_AXES, units=("1",) * 3)


def _lorenz_rate(state: Array, t: float) -> Array:
    """Return the time derivatives (..., 3) of states of the Lorenz-63 equations."""
    x = state[..., 0]
    y = state[..., 1]
    z = state[..., 2]
    rate = np.empty_like(state)
    # 10 (y - x), x (28 - z) - y and x y - 8/3 z, written into the rate without temporary arrays:
    # this is the inner loop of every study.
    x_rate = np.subtract(y, x, rate[..., 0])
    x_rate *= _PRANDTL
    y_rate = np.subtract(_RAYLEIGH, z, rate[..., 1])
    y_rate *= x
    y_rate -= y
    z_rate = np.multiply(x, y, rate[..., 2])
    z_rate -= _SHAPE * z
    return rate
