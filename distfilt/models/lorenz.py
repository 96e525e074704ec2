"""Lorenz's convection model of 1963, the smallest chaotic flow."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, number
from .base import Model
from .integrators import _integrated

__all__ = ["lorenz63", "lorenz63_rate"]


def lorenz63_rate(
    x: ArrayLike, *, prandtl: float = 10.0, rho: float = 28.0, beta: float = 8 / 3
) -> Array:
    r"""Right-hand side of Lorenz's equations, (..., 3).

    .. math:: \dot x = p(y-x),\quad \dot y = x(\rho-z)-y,\quad \dot z = xy-\beta z

    Parameters
    ----------
    x : array_like, (..., 3)
        States.
    prandtl, rho, beta : float
        Prandtl number, scaled Rayleigh number and geometry.

    Notes
    -----
    E. N. Lorenz, Journal of the Atmospheric Sciences 20 (1963) 130-141.

    Examples
    --------
    >>> lorenz63_rate([1.0, 2.0, 3.0]).round(6)
    array([10., 23., -6.])
    """
    state = array(x, "x", (..., 3))
    s, r, b = number(prandtl, "prandtl"), number(rho, "rho"), number(beta, "beta")
    return _rate(state, s, r, b)


def _rate(state: Array, prandtl: float, rho: float, beta: float) -> Array:
    x, y, z = state[..., 0], state[..., 1], state[..., 2]
    return np.stack([prandtl * (y - x), x * (rho - z) - y, x * y - beta * z], axis=-1)


def _slope(state: Array, prandtl: float, rho: float, beta: float) -> Array:
    """Derivative of the right-hand side, (..., 3, 3)."""
    x, y, z = state[..., 0], state[..., 1], state[..., 2]
    out = np.zeros((*state.shape, 3))
    out[..., 0, 0], out[..., 0, 1] = -prandtl, prandtl
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = rho - z, -1.0, -x
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = y, x, -beta
    return out


def lorenz63(
    *, prandtl: float = 10.0, rho: float = 28.0, beta: float = 8 / 3, sigma: float = 0.0,
    step: float = 0.01,
) -> Model:
    """Lorenz's model of 1963, integrated by Runge-Kutta of order 4 with a fixed step.

    Parameters
    ----------
    prandtl, rho, beta : float
        As for :func:`lorenz63_rate`.
    sigma : float
        Strength of independent white noise on each component: it gathers a standard deviation of
        ``sigma * sqrt(dt)`` in a step; none by default.
    step : float
        Longest integration step, positive, in units of time.

    Examples
    --------
    >>> lorenz63().step([1.0, 1.0, 20.0], 0.0, 0.1).shape
    (3,)
    """
    s, r, b = number(prandtl, "prandtl"), number(rho, "rho"), number(beta, "beta")
    density = number(sigma, "sigma", at_least=0, at_most=1e150) ** 2 * np.eye(3)
    return _integrated(
        lambda x, _: _rate(x, s, r, b), lambda x, _: _slope(x, s, r, b), density, step=step,
        names=("x", "y", "z"), units=("1",) * 3,
    )
