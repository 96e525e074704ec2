r"""A pendulum in Cartesian coordinates, whose length is a constraint, and in its chart.

The Cartesian state is :math:`(x, y, \dot x, \dot y)` with x to the right and y **downwards**, so
that the pendulum hangs at :math:`(0, L)`. In the chart it is the angle from the vertical and its
rate.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated, Literal

import numpy as np

from ..periods import PeriodsArgument
from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    NonNegativeFloat,
    PositiveFloat,
    validated,
)
from .base import Model
from .motion import integrate

__all__ = [
    "pendulum",
    "pendulum_angle",
    "pendulum_chart",
    "pendulum_rate",
    "pendulum_states",
]

Length = Annotated[float, Bounds(at_least=1e-100, at_most=1e100)]
"""A length whose square neither underflows nor overflows."""
Form = Literal["printed", "multiplier"]
States = Annotated[ArrayInput, "... 4"]


@validated
def pendulum_rate(
    states: States,
    *,
    length: Length = 1.0,
    gravity: NonNegativeFloat = 9.8,
    form: Form = "printed",
) -> Array:
    r"""Right-hand side (..., 4) of the pendulum's equations, (14)-(15) of Das and Bhattacharya.

    .. math:: \ddot x=\frac{-gxy-x|\mathbf v|^2}{L^2},\qquad
        \ddot y=\frac{gx^2-y|\mathbf v|^2}{L^2}

    On the circle :math:`x^2+y^2=L^2` these are
    :math:`\ddot{\mathbf q}=\mathbf g+\lambda\mathbf q` with the multiplier
    :math:`\lambda=-(|\mathbf v|^2+gy)/L^2`. Off the circle the two differ: with the printed form an
    error of the length grows, with the multiplier it does not.

    Parameters
    ----------
    states : array_like, (..., 4)
        Positions in m and velocities in m/s.
    length : float
        L, in m, positive.
    gravity : float
        g, in m/s², at least 0.
    form : {"printed", "multiplier"}
        The equations as the paper prints them, or with the multiplier written out.

    Examples
    --------
    >>> pendulum_rate([1.0, 0.0, 0.0, 0.0])
    array([ 0. ,  0. , -0. ,  9.8])
    """
    # The rate does not depend on time.
    return _rate(states, t=0.0, length=length, g=gravity, printed=form == "printed")


def _rate(states: Array, t: float, length: float, g: float, printed: bool) -> Array:
    """Return the time derivatives (..., 4) of states (x, y, u, v), with u and v the velocities.

    `length` is the pendulum's length L and `g` the gravity; `printed` says whether the equations
    are those that the paper prints.
    """
    x = states[..., 0]
    y = states[..., 1]
    u = states[..., 2]
    v = states[..., 3]
    square = length * length
    # λ = -(|v|² + g y)/L²
    multiplier = (u * u + v * v + g * y) / -square
    rate = np.empty_like(states)
    rate[..., 0] = u
    rate[..., 1] = v
    np.multiply(multiplier, x, out=rate[..., 2])
    # The printed g x²/L² is -g y²/L² + g (x² + y²)/L²; the last term is g only on the circle.
    weight = g * (x * x + y * y) / square if printed else g
    rate[..., 3] = multiplier * y + weight
    return rate


@validated
def pendulum(
    *,
    length: Length = 1.0,
    gravity: NonNegativeFloat = 9.8,
    form: Form = "printed",
    sigma: tuple[NonNegativeFloat, NonNegativeFloat] = (0.0, 0.0),
    step: PositiveFloat = 0.01,
) -> Model:
    """The pendulum in Cartesian coordinates x, y, vx, vy, by Runge-Kutta of order 4.

    Parameters
    ----------
    length, gravity, form
        As for :func:`pendulum_rate`.
    sigma : (float, float)
        Strength of independent white noise on the positions, in m/√s, and on the velocities, in
        m/s/√s; none by default. The noise does not respect the constraint.
    step : float
        Longest integration step, in s, positive.

    Examples
    --------
    >>> swing = pendulum().step([np.sin(1.0), np.cos(1.0), 0.0, 0.0], 0.0, 1.0)
    >>> float(np.hypot(*swing[:2]).round(6))
    1.0
    """
    return integrate(
        # The constraint is not enforced: it is kept by the equations only.
        partial(_rate, length=length, g=gravity, printed=form == "printed"),
        np.diag(np.repeat(sigma, 2) ** 2),
        step=step,
        names=("x", "y", "vx", "vy"),
        units=("m", "m", "m/s", "m/s"),
    )


@validated
def pendulum_angle(
    *,
    length: Length = 1.0,
    gravity: NonNegativeFloat = 9.8,
    sigma: tuple[NonNegativeFloat, NonNegativeFloat] = (0.0, 0.0),
    step: PositiveFloat = 0.01,
    periods: PeriodsArgument = (),
) -> Model:
    r"""The pendulum in its chart: the angle θ from the vertical, not wrapped, and its rate.

    .. math:: \ddot\theta = -\frac gL\sin\theta

    Parameters
    ----------
    length, gravity, step
        As for :func:`pendulum`.
    sigma : (float, float)
        Strength of white noise on the angle, in rad/√s, and on the rate, in rad/s/√s.
    periods : sequence of (float or None), or mapping, optional
        As of :class:`Model`: ``{"theta": 2 * np.pi}`` where turns are not counted. Without it θ
        runs on.

    Examples
    --------
    >>> pendulum_angle().step([0.0, 1.0], 0.0, 1.0).round(4)
    array([ 0.01  , -0.9995])
    """
    return integrate(
        partial(_angle_rate, ratio=gravity / length),
        np.diag(np.square(sigma)),
        step=step,
        names=("theta", "omega"),
        units=("rad", "rad/s"),
        periods=periods,
    )


def _angle_rate(chart: Array, t: float, ratio: float) -> Array:
    """Return the time derivatives (..., 2) of states (θ, θ̇); `ratio` is g/L."""
    rate = np.empty_like(chart)
    rate[..., 0] = chart[..., 1]
    # θ̈ = -(g/L) sin θ
    rate[..., 1] = -ratio * np.sin(chart[..., 0])
    return rate


@validated
def pendulum_states(
    chart: Annotated[ArrayInput, "... 2"], *, length: Length = 1.0
) -> Array:
    r"""Cartesian states (..., 4), position and velocity, of chart coordinates.

    Parameters
    ----------
    chart : array_like, (..., 2)
        Angles in rad and rates in rad/s.
    length : float
        L, in m, positive.

    Examples
    --------
    >>> pendulum_states([np.pi / 2, 2.0]).round(12) + 0.0
    array([ 1.,  0.,  0., -2.])
    """
    sine = np.sin(chart[..., 0])
    cosine = np.cos(chart[..., 0])
    rate = chart[..., 1]
    # (x, y) = L (sin θ, cos θ), and its time derivative
    return length * np.stack([sine, cosine, rate * cosine, -rate * sine], axis=-1)


@validated
def pendulum_chart(states: States) -> Array:
    r"""Angle in (-π, π] and rate :math:`(\dot xy-x\dot y)/r^2` of Cartesian states, (..., 2).

    Parameters
    ----------
    states : array_like, (..., 4)
        Not at the pivot.

    Examples
    --------
    >>> pendulum_chart(pendulum_states([2.0, -1.5])).round(12)
    array([ 2. , -1.5])
    """
    x = states[..., 0]
    y = states[..., 1]
    u = states[..., 2]
    v = states[..., 3]
    # The square of the length, which need not be L²
    square = x * x + y * y
    if (square == 0).any():
        raise ValueError(
            "states must have positions away from the pivot, got one at the pivot"
        )
    # The angle is measured from the y axis, hence arctan2(x, y).
    angle = np.arctan2(x, y)
    rate = (u * y - x * v) / square
    return np.stack([angle, rate], axis=-1)
