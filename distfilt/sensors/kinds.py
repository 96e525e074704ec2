"""The built-in sensors: components, changes, distances, angles, directions, and stacks of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from scipy.linalg import block_diag

from ..validation import (
    Array,
    Bounds,
    DistinctIndices,
    NonNegativeInt,
    validated,
)
from ..validation.checks import check_distinct
from .base import Sensor, wrap

__all__ = [
    "line_angle",
    "component",
    "distance",
    "range_bearing",
    "ephemeris",
    "angles_only",
    "from_name",
    "stack",
]

Deviation = Annotated[float, Bounds(at_least=1e-150, at_most=1e150)]
"""A standard deviation whose square is a variance that is neither zero nor infinite."""


Turn = Annotated[float, Bounds(at_least=1e-150, at_most=np.pi)]
"""A standard deviation of an angle, in rad: a wider Gaussian is none once it is wrapped."""
Pair = Annotated[tuple[NonNegativeInt, NonNegativeInt], check_distinct]


def diagonal(*stds: float) -> Array:
    """The covariance of independent readings, read-only."""
    cov: Array = np.diag(np.square(np.asarray(stds)))
    cov.setflags(write=False)
    return cov


def _pick(x: Array, indices: Sequence[int]) -> Array:
    return x[..., list(indices)]


def _spread(slope: Array, indices: Sequence[int], dim: int) -> Array:
    """Derivatives (..., m, n) in the picked components, as ones in all `dim` of them."""
    out = np.zeros((*slope.shape[:-1], dim))
    out[..., list(indices)] = slope
    return out


def _rows(dim: int, indices: Sequence[int]) -> Array:
    """The rows of the identity that pick components."""
    Bounds(below=dim)(max(indices), "indices")
    return _pick(np.eye(dim), indices).T


@validated
def component(indices: DistinctIndices, *, std: Deviation) -> Sensor:
    """See some components as they are, ``h(x) = x[indices]``, with a standard deviation `std` each.

    Examples
    --------
    >>> component([0, 2], std=0.1).predict([1.0, 2.0, 3.0])
    array([1., 3.])
    """
    return Sensor.construct(
        len(indices),
        partial(_pick, indices=indices),
        diagonal(*[std] * len(indices)),
        kind="direct",
        linear=partial(_rows, indices=indices),
    )


@validated
def increment(indices: DistinctIndices, *, std: Deviation) -> Sensor:
    """See how much some components changed since the previous observation time, to `std` each.

    Examples
    --------
    >>> increment([1], std=0.1).predict([1.0, 5.0], previous=[0.0, 3.0])
    array([2.])
    """
    return Sensor.construct(
        len(indices),
        partial(_change, indices=indices),
        diagonal(*[std] * len(indices)),
        uses_previous=True,
        kind="differential",
        derivative=partial(_change_slope, indices=indices),
    )


def _change(x: Array, previous: Array, indices: Sequence[int]) -> Array:
    return np.asarray(_pick(x, indices) - _pick(previous, indices))


def _change_slope(x: Array, previous: Array, indices: Sequence[int]) -> Array:
    return _rows(x.shape[-1], indices)


def _place(indices: Sequence[int], origin: Array | None) -> dict[str, Any]:
    """Of which components a place is made, and where it is seen from: a copy, for it may move."""
    return {"indices": indices, "origin": np.array(0.0 if origin is None else origin)}


def _gap(x: Array, indices: Sequence[int], origin: Array) -> Array:
    """From the origin to the place that some components are."""
    return _pick(x, indices) - origin


@validated
def distance(
    indices: DistinctIndices,
    *,
    std: Deviation,
    origin: Annotated[Array, "n"] | None = None,
) -> Sensor:
    """See the distance from a place in some components, ``h(x) = |x[indices] - origin|``.

    Parameters
    ----------
    indices : sequence of int
        The components, counted from 0.
    std : float
        Standard deviation of the distance, in the components' unit, positive.
    origin : array_like, (n,), optional
        Where it is measured from, one coordinate for each of the n indices; zero by default.

    Notes
    -----
    The distance has no derivative at the origin itself; zero stands in for it.

    Examples
    --------
    >>> distance([0, 1], std=0.1).predict([3.0, 4.0, 9.0])
    array([5.])
    """
    if origin is not None and len(origin) != len(indices):
        raise ValueError(
            f"origin must have shape ({len(indices)},), got {origin.shape}"
        )
    place = _place(indices, origin)
    return Sensor.construct(
        1,
        partial(_distance, **place),
        diagonal(std),
        kind="distance",
        derivative=partial(_distance_slope, **place),
    )


def _distance(x: Array, indices: Sequence[int], origin: Array) -> Array:
    return _length(_gap(x, indices, origin))


def _length(gap: Array) -> Array:
    return np.asarray(np.sqrt((gap * gap).sum(axis=-1, keepdims=True)))


def _distance_slope(x: Array, indices: Sequence[int], origin: Array) -> Array:
    length = _length(gap := _gap(x, indices, origin))
    slope = gap / np.where(length > 0, length, 1.0)
    return _spread(slope[..., None, :], indices, x.shape[-1])


@validated
def line_angle(
    indices: Pair,
    *,
    std: Turn,
    full: bool = False,
    origin: Annotated[Array, "2"] | None = None,
) -> Sensor:
    """See the angle of two components (a, b), in rad.

    Parameters
    ----------
    indices : sequence of two int
        The components a and b.
    std : float
        Standard deviation, in rad, positive and at most π.
    full : bool
        False: ``arctan(b/a)``, the angle of a line, which repeats after π (Grange et al., Table I).
        True: ``arctan2(b, a)``, a direction, which repeats after 2π.
    origin : array_like, (2,), optional
        Where the angle is measured from; zero by default.

    Notes
    -----
    At the origin itself the angle does not exist: the prediction and its derivative are NaN, and a
    filter leaves the reading out.

    Examples
    --------
    >>> sight = line_angle([0, 1], std=0.2)
    >>> sight.predict([1.0, 1.0]).round(4)
    array([0.7854])
    >>> sight.residual([1.5], [-1.5]).round(4)
    array([-0.1416])
    """
    period = (2 if full else 1) * np.pi
    place = _place(indices, origin)
    return Sensor.construct(
        1,
        partial(_angle, period=period, **place),
        diagonal(std),
        kind="angle",
        derivative=partial(_angle_slope, **place),
        residual_function=partial(_turned_at, period=period),
    )


def _angle(x: Array, period: float, **place: Any) -> Array:
    return _direction(_gap(x, **place), period)


def _direction(gap: Array, period: float, heading: float = 0.0) -> Array:
    turned = (
        np.where(gap.any(axis=-1), np.arctan2(gap[..., 1], gap[..., 0]), np.nan)
        - heading
    )
    return wrap(turned, period=period)[..., None]


def _angle_slope(x: Array, indices: Sequence[int], origin: Array) -> Array:
    length = _length(gap := _gap(x, indices, origin))
    length = np.where(length > 0, length, np.nan)
    unit = gap / length
    slope = np.stack([-unit[..., 1], unit[..., 0]], axis=-1) / length
    return _spread(slope[..., None, :], indices, x.shape[-1])


@validated
def range_bearing(
    indices: Pair,
    *,
    std: tuple[Deviation, Turn],
    origin: Annotated[Array, "2"] | None = None,
    heading: float = 0.0,
) -> Sensor:
    """See the distance and the direction of two components, as a radar or a robot does.

    Parameters
    ----------
    indices : sequence of two int
        The components a and b that are seen.
    std : (float, float)
        Standard deviations of the distance, in the components' unit, and of the angle, in rad.
    origin : array_like, (2,), optional
        Where the sensor stands; zero by default.
    heading : float
        Where it looks, in rad from the first axis to the second: the angle is measured from there,
        and repeats after 2π.

    Notes
    -----
    At the origin itself there is no angle: it and its derivative are NaN. A sensor
    with another pose at each reading is best made without checks,
    ``range_bearing(...)``: it takes some 10 µs.

    Examples
    --------
    >>> radar = range_bearing([0, 1], std=[0.5, 0.01], origin=[1.0, 0.0])
    >>> radar.predict([1.0, 2.0]).round(4)
    array([2.    , 1.5708])
    """
    place = _place(indices, origin)
    return Sensor.construct(
        2,
        partial(_sighting, heading=heading, **place),
        diagonal(*std),
        residual_function=partial(_turned_at, k=1),
        kind="distance and angle",
        derivative=partial(_sighting_slope, **place),
    )


def _sighting(x: Array, heading: float, **place: Any) -> Array:
    gap = _gap(x, **place)
    return np.concatenate([_length(gap), _direction(gap, 2 * np.pi, heading)], axis=-1)


def _turned_at(
    observed: Array, predicted: Array, k: int = 0, period: float = 2 * np.pi
) -> Array:
    """Differences, wrapped in one component."""
    gap = np.asarray(observed - predicted)
    gap[..., k] = wrap(gap[..., k], period=period)
    return gap


def _sighting_slope(x: Array, **place: Any) -> Array:
    return np.concatenate(
        [_distance_slope(x, **place), _angle_slope(x, **place)], axis=-2
    )


@validated
def angles_only(
    *,
    std: Turn,
    form: Literal["arctan2", "printed"] = "arctan2",
    observer: NonNegativeInt = 6,
    hidden: Callable[[Array, Array], Array] | None = None,
) -> Sensor:
    r"""The direction to a target, the state's first body, from another: two angles in rad.

    Parameters
    ----------
    std : float
        Standard deviation of each angle, in rad, at most π.
    form : {"arctan2", "printed"}
        Right ascension and declination, or (49) of Semeraro et al., which has arcsin of the unit
        vector's y component where the right ascension is meant.
    observer : int
        Where the other body's position begins in the state.
    hidden : callable, optional
        ``hidden(target, observer) -> bool (...)`` of positions (..., 3), such as
        :func:`distfilt.models.occulted`; a direction that it hides is NaN.

    Examples
    --------
    >>> eye = angles_only(std=1e-4)
    >>> x = np.zeros(12)
    >>> x[:3] = -1.0, -1.0, 0.0
    >>> eye.predict(x).round(4) + 0.0
    array([-2.3562,  0.    ])
    """
    return Sensor.construct(
        2,
        partial(_sight, form=form, observer=observer, hidden=hidden),
        diagonal(std, std),
        residual_function=_turned_at,
    )


def _sight(
    x: Array, form: str, observer: int, hidden: Callable[[Array, Array], Array] | None
) -> Array:
    target = x[..., :3]
    own = x[..., observer : observer + 3]
    way = target - own
    unit = np.clip(way / np.linalg.norm(way, axis=-1, keepdims=True), -1, 1)
    out: Array = np.arcsin(unit[..., 1:])
    if form == "arctan2":
        out[..., 0] = np.arctan2(unit[..., 1], unit[..., 0])
    if hidden is not None:
        out[np.asarray(hidden(target, own))] = np.nan
    return out


@validated
def ephemeris(*, position_std: Deviation, velocity_std: Deviation) -> Sensor:
    """The first body's full state, read directly, in km and m/s.

    Parameters
    ----------
    position_std, velocity_std : float
        Above 0, in km and m/s.

    Examples
    --------
    >>> ephemeris(position_std=1e-3, velocity_std=1e-5).dim
    6
    """
    read = component(tuple(range(6)), std=1.0)
    return read.replace(noise_cov=diagonal(*[position_std] * 3, *[velocity_std] * 3))


@validated
def from_name(
    kind: Literal["direct", "differential", "range", "angle"],
    indices: DistinctIndices,
    *,
    std: Deviation,
) -> Sensor:
    """The sensor that a table names.

    Parameters
    ----------
    kind : {"direct", "differential", "range", "angle"}
        The types of Grange et al., Table I: components as they are; their change since the previous
        observation time; :func:`distance`; :func:`angle`, ``arctan(b/a)``.
    indices, std
        The components, counted from 0; the standard deviation of each reading, positive.

    Examples
    --------
    >>> from_name("range", [0, 1], std=0.1).kind
    'distance'
    """
    makers: dict[str, Callable[..., Sensor]] = {
        "direct": component,
        "differential": increment,
        "range": distance,
        "angle": line_angle,
    }
    return makers[kind](indices, std=std)


@validated
def stack(sensors: Sequence[Sensor]) -> Sensor:
    """One sensor whose observation is the observations of `sensors`, one after the other.

    It wraps the components that the given sensors wrap, is linear if all of them are, and needs
    the previous state if one of them does.

    Parameters
    ----------
    sensors : sequence of Sensor
        At least one. The noise of different sensors is independent.

    Examples
    --------
    >>> both = stack([component([0], std=0.1), line_angle([0, 1], std=0.2)])
    >>> both.predict([1.0, 1.0]).round(4), both.noise_cov.diagonal().round(4)
    (array([1.    , 0.7854]), array([0.01, 0.04]))
    """
    if not sensors:
        raise ValueError("sensors must have at least one Sensor, got none")
    cov = block_diag(*[s.noise_cov for s in sensors])
    cov.setflags(write=False)
    wraps = any(s.residual_function is not None for s in sensors)
    linear = all(s.linear is not None for s in sensors)
    return Sensor.construct(
        len(cov),
        partial(_stacked, parts=sensors),
        cov,
        kind="stacked",
        residual_function=partial(_stacked_differences, parts=sensors)
        if wraps
        else None,
        uses_previous=any(s.uses_previous for s in sensors),
        linear=partial(_stacked, parts=sensors, what="H", axis=0) if linear else None,
        derivative=partial(_stacked, parts=sensors, what="jacobian", axis=-2),
    )


def _stacked(
    *states: Any, parts: Sequence[Sensor], what: str = "predict", axis: int = -1
) -> Array:
    return np.concatenate([getattr(s, what)(*states) for s in parts], axis=axis)


def _stacked_differences(
    observed: Array, predicted: Array, parts: Sequence[Sensor]
) -> Array:
    ends = np.cumsum([s.dim for s in parts])[:-1]
    pairs = [np.split(reading, ends, axis=-1) for reading in (observed, predicted)]
    gaps = [s.residual(y, p) for s, y, p in zip(parts, *pairs, strict=True)]
    return np.concatenate(gaps, axis=-1)
