"""What an agent in orbit sees of a target: directions, as the paper prints them or as angles."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

import numpy as np

from ..doors import Array, Index, door, unchecked
from .base import Sensor
from .kinds import Deviation, diagonal, direct

__all__ = ["ephemeris", "line_of_sight"]


@door
def line_of_sight(
    *, std: Deviation, form: Literal["arctan2", "printed"] = "arctan2", target: Index = 0,
    observer: Index = 6, hidden: Callable[[Array, Array], Array] | None = None
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
    here, there = slice(target, target + 3), slice(observer, observer + 3)
    return Sensor.unchecked(
        2, partial(_sight, form=form, here=here, there=there, hidden=hidden),
        diagonal(std, std), difference=partial(_shorter_ways, turns=form == "arctan2")
    )


def _sight(
    x: Array, form: str, here: slice, there: slice, hidden: Callable[[Array, Array], Array] | None
) -> Array:
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


def _shorter_ways(observed: Array, predicted: Array, turns: bool) -> Array:
    gap = np.asarray(observed - predicted)
    if turns:
        gap[..., 0] = (gap[..., 0] + np.pi) % (2 * np.pi) - np.pi
    return gap


@door
def ephemeris(*, position_std: Deviation, velocity_std: Deviation, start: Index = 0) -> Sensor:
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
    read = unchecked(direct)(tuple(range(start, start + 6)), std=1.0)
    cov = diagonal(*[position_std] * 3, *[velocity_std] * 3)
    return read.changed(cov=cov)
