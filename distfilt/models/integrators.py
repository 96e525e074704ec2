"""Integration of ordinary differential equations for many states at once."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from ..doors import Array, NonNegative, Positive, array, door, unchecked
from .base import Model, white

__all__ = ["integrated", "rk4"]

Rate = Callable[[Array, float], Array]

_MOST = 10_000_000
"""More integration steps than this are a mistake in `longest`, not a wish."""


@door
def rk4(
    rate: Rate, x: Array, t: float, dt: NonNegative, *, longest: Positive | None = None
) -> Array:
    r"""Advance :math:`\dot{\mathbf x} = \mathbf f(\mathbf x, t)` by the classical Runge-Kutta rule.

    Parameters
    ----------
    rate : callable
        ``rate(x, t) -> dx/dt`` on arrays of the shape of `x`.
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
    # A copy: a rate that works in place must not change the caller's states.
    state = x.copy()
    first = array(rate(state, t), "rate", state.shape, finite=False)
    for k in range(steps):
        s = t + k * h
        k1 = first if k == 0 else rate(state, s)
        k2 = rate(state + 0.5 * h * k1, s + 0.5 * h)
        k3 = rate(state + 0.5 * h * k2, s + 0.5 * h)
        k4 = rate(state + h * k3, s + h)
        # In place where nobody else holds the array: members are many, and memory is slow.
        total = np.multiply(k2, 2.0, out=np.empty_like(state))
        total += k1
        total += 2 * k3
        total += k4
        total *= h / 6
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
            f"longest: needs at least {dt / _MOST:g} for steps over {dt:g} s, got {longest:g}"
        )
    return max(1, math.ceil(needed))


def rk4_jacobian(
    rate: Rate, slope: Rate, x: Array, t: float, dt: float, longest: float | None = None
) -> Array:
    r"""Derivative (..., d, d) of :func:`rk4` in the states it starts from, to rounding.

    The rule applied to :math:`\dot{\mathbf x} = \mathbf f`, :math:`\dot{\mathbf J} =
    (\partial\mathbf f/\partial\mathbf x)\,\mathbf J` together gives exactly the derivative of the
    rule applied to the first alone. `slope` is the derivative of `rate` in x, (..., d, d).
    """

    def both(joint: Array, s: float) -> Array:
        place = np.ascontiguousarray(joint[..., 0])
        turned = slope(place, s) @ joint[..., 1:]
        return np.concatenate([np.asarray(rate(place, s))[..., None], turned], axis=-1)

    first = np.broadcast_to(np.eye(x.shape[-1]), (*x.shape, x.shape[-1]))
    start = np.concatenate([x[..., None], first], axis=-1)
    return unchecked(rk4)(both, start, t, dt, longest=longest)[..., 1:]


def integrated(
    rate: Rate, slope: Rate, density: Array, *, step: float, names: tuple[str, ...],
    units: tuple[str, ...],
) -> Model:
    """The model that :func:`rk4` makes of a rate, with white noise of a spectral density (d, d)."""
    return Model(
        len(density), partial(_flow, rate=rate, longest=step), partial(white, density),
        derivative=partial(rk4_jacobian, rate, slope, longest=step), names=names, units=units,
    )


def _flow(x: Array, t: float, dt: float, rate: Rate, longest: float) -> Array:
    return unchecked(rk4)(rate, x, t, dt, longest=longest)
