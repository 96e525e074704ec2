"""Lorenz's convection model of 1963, the smallest chaotic flow."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, number
from .base import Model
from .integrators import rk4

__all__ = ["lorenz63", "lorenz63_rate"]


def lorenz63_rate(
    x: ArrayLike, *, sigma: float = 10.0, rho: float = 28.0, beta: float = 8 / 3
) -> Array:
    r"""Right-hand side of Lorenz's equations.

    .. math:: \dot x = \sigma(y-x),\quad \dot y = x(\rho-z)-y,\quad \dot z = xy-\beta z

    Parameters
    ----------
    x : array_like, (..., 3)
        States.
    sigma, rho, beta : float
        Prandtl number, scaled Rayleigh number and geometry.

    Returns
    -------
    ndarray, (..., 3)

    Notes
    -----
    E. N. Lorenz, Journal of the Atmospheric Sciences 20 (1963) 130-141.

    Examples
    --------
    >>> lorenz63_rate([1.0, 2.0, 3.0]).round(6)
    array([10., 23., -6.])
    """
    state = array(x, "x", (..., 3))
    s, r, b = number(sigma, "sigma"), number(rho, "rho"), number(beta, "beta")
    return _rate(state, s, r, b)


def _rate(state: Array, sigma: float, rho: float, beta: float) -> Array:
    x, y, z = state[..., 0], state[..., 1], state[..., 2]
    return np.stack([sigma * (y - x), x * (rho - z) - y, x * y - beta * z], axis=-1)


def lorenz63(
    *,
    sigma: float = 10.0,
    rho: float = 28.0,
    beta: float = 8 / 3,
    noise: float = 0.0,
    step: float = 0.01,
) -> Model:
    """Lorenz's model of 1963, integrated by Runge-Kutta of order 4 with a fixed step.

    Parameters
    ----------
    sigma, rho, beta : float
        As for :func:`lorenz63_rate`.
    noise : float
        Strength of independent white noise on each component: it gathers a standard deviation of
        ``noise * sqrt(dt)`` in a step; none by default.
    step : float
        Longest integration step, positive, in units of time.

    Returns
    -------
    Model
        With three components.

    Examples
    --------
    >>> lorenz63().step([1.0, 1.0, 20.0], 0.0, 0.1).shape
    (3,)
    """
    s, r, b = number(sigma, "sigma"), number(rho, "rho"), number(beta, "beta")
    density = number(noise, "noise", at_least=0) ** 2 * np.eye(3)
    longest = number(step, "step", above=0)

    def flow(x: Array, t: float, dt: float) -> Array:
        # A step that divides dt up to rounding is not cut once more.
        n = max(1, math.ceil(dt / longest - 1e-9))
        return rk4(lambda state, _: _rate(state, s, r, b), x, t, dt, substeps=n)

    return Model(3, flow, lambda t, dt: density * dt, names=("x", "y", "z"), units=("1",) * 3)
