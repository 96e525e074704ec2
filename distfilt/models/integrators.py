"""Integration of ordinary differential equations for many states at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, count, number

__all__ = ["rk4"]


def rk4(
    rate: Callable[[Array, float], Array],
    x: ArrayLike,
    t: float,
    dt: float,
    *,
    substeps: int = 1,
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
    substeps : int
        Equal steps into which `dt` is cut. The error falls with their fourth power.

    Returns
    -------
    ndarray, (..., d)
        States at `t` + `dt`.

    Raises
    ------
    ValueError
        If an argument is wrong or `rate` returns another shape.

    Notes
    -----
    W. Kutta, Zeitschrift für Mathematik und Physik 46 (1901) 435-453.

    Examples
    --------
    >>> rk4(lambda x, t: -x, [1.0], 0.0, 1.0, substeps=10).round(6)
    array([0.36788])
    """
    f = callable_(rate, "rate")
    state = array(x, "x", (...,))
    now, length = number(t, "t"), number(dt, "dt", at_least=0)
    n = count(substeps, "substeps")
    h = length / n
    first = np.asarray(f(state, now))
    if first.shape != state.shape:
        raise ValueError(f"rate: needs to return shape {state.shape}, got {first.shape}")
    for k in range(n):
        s = now + k * h
        k1 = first if k == 0 else f(state, s)
        k2 = f(state + 0.5 * h * k1, s + 0.5 * h)
        k3 = f(state + 0.5 * h * k2, s + 0.5 * h)
        k4 = f(state + h * k3, s + h)
        state = state + (h / 6) * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.asarray(state)
