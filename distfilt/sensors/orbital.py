"""What an agent in orbit sees of a target: directions, as the paper prints them or as angles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..checks import Array, callable_, choice, count, number
from .base import Sensor
from .kinds import _variance, direct

__all__ = ["ephemeris", "line_of_sight"]


def line_of_sight(
    *,
    std: float,
    form: str = "arctan2",
    target: int = 0,
    observer: int = 6,
    hidden: Callable[[Array, Array], Array] | None = None,
) -> Sensor:
    r"""The direction from one body to another, two angles in rad.

    Parameters
    ----------
    std : float
        Standard deviation of each angle, in rad.
    form : {"arctan2", "printed"}
        Right ascension and declination, or (49) of Semeraro et al., which has arcsin of the unit
        vector's y component where the right ascension is meant.
    target, observer : int
        Where the bodies' positions begin in the state.
    hidden : callable, optional
        ``hidden(target, observer) -> bool (...)`` of positions (..., 3), such as
        :func:`distfilt.models.occulted`; a direction that it hides is NaN.

    Examples
    --------
    >>> eye = line_of_sight(std=1e-4)
    >>> x = np.zeros(12)
    >>> x[:3] = -1.0, -1.0, 0.0
    >>> eye.predict(x).round(4) + 0.0
    array([-2.3562,  0.    ])
    """
    noise = _variance(std, 2)
    choice(form, "form", ("arctan2", "printed"))
    places = (count(target, "target", at_least=0), count(observer, "observer", at_least=0))
    here, there = (slice(k, k + 3) for k in places)
    if hidden is not None:
        callable_(hidden, "hidden")

    def function(x: Array) -> Array:
        way = x[..., here] - x[..., there]
        unit = way / np.linalg.norm(way, axis=-1, keepdims=True)
        second = np.arcsin(np.clip(unit[..., 2], -1, 1))
        if form == "printed":
            first = np.arcsin(np.clip(unit[..., 1], -1, 1))
        else:
            first = np.arctan2(unit[..., 1], unit[..., 0])
        out = np.stack([first, second], axis=-1)
        if hidden is not None:
            out[np.asarray(hidden(x[..., here], x[..., there]))] = np.nan
        return out

    def difference(a: Array, b: Array) -> Array:
        gap = a - b
        if form == "arctan2":
            gap[..., 0] = (gap[..., 0] + np.pi) % (2 * np.pi) - np.pi
        return gap

    return Sensor(2, function, noise, difference=difference, units=("rad", "rad"))


def ephemeris(*, position_std: float, velocity_std: float, start: int = 0) -> Sensor:
    """A body's full state, read directly, in km and m/s.

    Parameters
    ----------
    position_std, velocity_std : float
        Above 0, in km and m/s.
    start : int
        Where the body begins in the state.

    Examples
    --------
    >>> ephemeris(position_std=1e-3, velocity_std=1e-5).dim
    6
    """
    stds = [number(position_std, "position_std", at_least=1e-150, at_most=1e150)] * 3
    stds += [number(velocity_std, "velocity_std", at_least=1e-150, at_most=1e150)] * 3
    first = count(start, "start", at_least=0)
    exact = direct(range(first, first + 6), std=1.0)
    return replace(exact, cov=np.diag(np.square(stds)), units=("km",) * 3 + ("m/s",) * 3)
