"""Integration of ordinary differential equations for many states at once."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, number
from .base import Model

__all__ = ["rk4", "rk4_jacobian"]

_MOST = 10_000_000
"""More integration steps than this are a mistake in `longest`, not a wish."""


def rk4(
    rate: Callable[[Array, float], Array], x: ArrayLike, t: float, dt: float, *,
    longest: float | None = None,
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
    f = callable_(rate, "rate")
    # A copy: a rate that works in place must not change the caller's states.
    state = array(x, "x", (...,)).copy()
    now, length = number(t, "t"), number(dt, "dt", at_least=0)
    return _rk4(f, state, now, length, _steps(length, longest))


def rk4_jacobian(
    rate: Callable[[Array, float], Array], slope: Callable[[Array, float], Array], x: ArrayLike,
    t: float, dt: float, *, longest: float | None = None,
) -> Array:
    r"""Derivative (..., d, d) of :func:`rk4` in the states it starts from, to rounding.

    The rule applied to :math:`\dot{\mathbf x} = \mathbf f`, :math:`\dot{\mathbf J} =
    (\partial\mathbf f/\partial\mathbf x)\,\mathbf J` together gives exactly the derivative of the
    rule applied to the first alone.

    Parameters
    ----------
    rate, x, t, dt, longest
        As for :func:`rk4`, with x (..., d).
    slope : callable
        ``slope(x, t)``, the derivative of `rate` in x, (..., d, d).

    Examples
    --------
    >>> rk4_jacobian(lambda x, t: -x**2, lambda x, t: -2 * x[..., None], [1.0], 0.0, 1.0,
    ...              longest=0.1).round(6)
    array([[0.250001]])
    """
    f, g = callable_(rate, "rate"), callable_(slope, "slope")
    state = array(x, "x", (..., "d"))
    d = state.shape[-1]
    _rated(f(state.copy(), number(t, "t")), state)
    now, length = number(t, "t"), number(dt, "dt", at_least=0)

    def both(joint: Array, s: float) -> Array:
        place = np.ascontiguousarray(joint[..., 0])
        a = np.asarray(g(place, s))
        if a.shape != (*place.shape, d):
            raise ValueError(f"slope: needs to return shape {(*place.shape, d)}, got {a.shape}")
        return np.concatenate([np.asarray(f(place, s))[..., None], a @ joint[..., 1:]], axis=-1)

    first = np.broadcast_to(np.eye(d), (*state.shape, d))
    start = np.concatenate([state[..., None], first], axis=-1)
    return _rk4(both, start, now, length, _steps(length, longest))[..., 1:]


def _integrated(
    rate: Callable[[Array, float], Array], slope: Callable[[Array, float], Array], density: Array,
    *, step: float, names: tuple[str, ...], units: tuple[str, ...],
) -> Model:
    """The model that :func:`rk4` makes of a rate, with white noise of a spectral density (d, d)."""
    longest = number(step, "step", above=0)
    return Model(
        len(density),
        lambda x, t, dt: rk4(rate, x, t, dt, longest=longest),
        lambda t, dt: density * dt,
        derivative=lambda x, t, dt: rk4_jacobian(rate, slope, x, t, dt, longest=longest),
        names=names,
        units=units,
    )


def _steps(dt: float, longest: float | None) -> int:
    """The fewest equal steps of `dt` that are not longer than `longest`."""
    if longest is None:
        return 1
    # A step that divides dt up to rounding is not cut once more.
    needed = dt / number(longest, "longest", above=0) - 1e-9
    if not needed <= _MOST:
        raise ValueError(
            f"longest: needs at least {dt / _MOST:g} for steps over {dt:g} s, got {longest:g}"
        )
    return max(1, math.ceil(needed))


def _rated(value: object, state: Array) -> Array:
    """What a rate returned, if it fits the states."""
    first = np.asarray(value)
    if first.shape != state.shape or first.dtype.kind not in "fiu":
        raise ValueError(
            f"rate: needs to return numbers of shape {state.shape}, "
            f"got {first.dtype} of shape {first.shape}"
        )
    return first


def _rk4(
    f: Callable[[Array, float], Array], state: Array, t: float, dt: float, steps: int
) -> Array:
    """`rk4` of checked arguments in a given number of equal steps."""
    h = dt / steps
    first = _rated(f(state, t), state)
    for k in range(steps):
        s = t + k * h
        k1 = first if k == 0 else f(state, s)
        k2 = f(state + 0.5 * h * k1, s + 0.5 * h)
        k3 = f(state + 0.5 * h * k2, s + 0.5 * h)
        k4 = f(state + h * k3, s + h)
        # In place where nobody else holds the array: members are many, and memory is slow.
        total = np.multiply(k2, 2.0, out=np.empty_like(state))
        total += k1
        total += 2 * k3
        total += k4
        total *= h / 6
        total += state
        state = total
    return np.asarray(state)
