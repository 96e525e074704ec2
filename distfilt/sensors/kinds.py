"""The sensors that a table names: components, changes, distances, angles, and stacks of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, choice, number, places
from .base import Sensor, _wrapped

__all__ = [  # fmt: skip
    "angle", "differential", "direct", "distance", "distance_and_angle", "of_kind", "stack",
]


def _indices(indices: Sequence[int], needed: int | None = None) -> tuple[int, ...]:
    picked = places(indices, "indices")
    if needed is not None and len(picked) != needed:
        raise ValueError(f"indices: needs {needed} components, got {len(picked)}")
    return picked


def _pick(x: Array, indices: tuple[int, ...]) -> Array:
    if max(indices) >= x.shape[-1]:
        raise ValueError(
            f"x: needs more than {max(indices)} components for this sensor, got {x.shape[-1]}"
        )
    return x[..., list(indices)]


def _spread(slope: Array, indices: tuple[int, ...], dim: int) -> Array:
    """Derivatives (..., m, n) in the picked components, as ones in all `dim` of them."""
    out = np.zeros((*slope.shape[:-1], dim))
    out[..., list(indices)] = slope
    return out


def _place(origin: ArrayLike | None, size: int) -> Array:
    return np.zeros(size) if origin is None else array(origin, "origin", (size,)).copy()


def _variance(std: float, size: int) -> Array:
    # Its square is a variance that is neither zero nor infinite.
    return number(std, "std", at_least=1e-150, at_most=1e150) ** 2 * np.eye(size)


def direct(indices: Sequence[int], *, std: float) -> Sensor:
    """See some components as they are, ``h(x) = x[indices]``, with a standard deviation `std` each.

    Examples
    --------
    >>> direct([0, 2], std=0.1).predict([1.0, 2.0, 3.0])
    array([1., 3.])
    """
    picked = _indices(indices)

    def matrix(dim: int) -> Array:
        return _pick(np.eye(dim), picked).T

    return Sensor(
        len(picked), lambda x: _pick(x, picked), _variance(std, len(picked)), kind="direct",
        linear=matrix,
    )


def differential(indices: Sequence[int], *, std: float) -> Sensor:
    """See how much some components changed since the previous observation time, to `std` each.

    Examples
    --------
    >>> differential([1], std=0.1).predict([1.0, 5.0], previous=[0.0, 3.0])
    array([2.])
    """
    picked = _indices(indices)
    return Sensor(
        len(picked), lambda x, previous: _pick(x, picked) - _pick(previous, picked),
        _variance(std, len(picked)), uses_previous=True, kind="differential",
        derivative=lambda x, previous: _pick(np.eye(x.shape[-1]), picked).T,
    )


def distance(indices: Sequence[int], *, std: float, origin: ArrayLike | None = None) -> Sensor:
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
    picked = _indices(indices)
    place = _place(origin, len(picked))

    def derivative(x: Array) -> Array:
        gap = _pick(x, picked) - place
        length = np.linalg.norm(gap, axis=-1, keepdims=True)
        slope = gap / np.where(length > 0, length, 1.0)
        return _spread(slope[..., None, :], picked, x.shape[-1])

    return Sensor(
        1, lambda x: np.linalg.norm(_pick(x, picked) - place, axis=-1, keepdims=True),
        _variance(std, 1), kind="distance", derivative=derivative,
    )


def angle(
    indices: Sequence[int], *, std: float, full: bool = False, origin: ArrayLike | None = None
) -> Sensor:
    """See the angle of two components (a, b), in rad.

    Parameters
    ----------
    indices : sequence of two int
        The components a and b.
    std : float
        Standard deviation, in rad, positive.
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
    >>> sight = angle([0, 1], std=0.2)
    >>> sight.predict([1.0, 1.0]).round(4)
    array([0.7854])
    >>> sight.residual([1.5], [-1.5]).round(4)
    array([-0.1416])
    """
    picked = _indices(indices, 2)
    place = _place(origin, 2)
    if not isinstance(full, bool):
        raise ValueError(f"full: needs True or False, got {full!r}")
    period = 2 * np.pi if full else np.pi

    def function(x: Array) -> Array:
        a, b = np.moveaxis(_pick(x, picked) - place, -1, 0)
        direction = np.where((a == 0) & (b == 0), np.nan, np.arctan2(b, a))
        return _wrapped(direction, period)[..., None]

    def derivative(x: Array) -> Array:
        gap = _pick(x, picked) - place
        length = np.linalg.norm(gap, axis=-1, keepdims=True)
        length = np.where(length > 0, length, np.nan)
        unit = gap / length
        slope = np.stack([-unit[..., 1], unit[..., 0]], axis=-1) / length
        return _spread(slope[..., None, :], picked, x.shape[-1])

    return Sensor(
        1, function, _variance(std, 1), difference=lambda y, p: _wrapped(y - p, period),
        kind="angle", derivative=derivative, units=("rad",),
    )


def distance_and_angle(
    indices: Sequence[int], *, std: Sequence[float], origin: ArrayLike | None = None
) -> Sensor:
    """See the distance from a place in two components and the direction, as a radar does.

    Parameters
    ----------
    indices : sequence of two int
        The components a and b; the angle is ``arctan2(b, a)``, which repeats after 2π.
    std : (float, float)
        Standard deviations of the distance, in the components' unit, and of the angle, in rad.
    origin
        Where the sensor stands, as for :func:`angle`.

    Examples
    --------
    >>> radar = distance_and_angle([0, 1], std=[0.5, 0.01], origin=[1.0, 0.0])
    >>> radar.predict([1.0, 2.0]).round(4)
    array([2.    , 1.5708])
    """
    both = array(std, "std", (2,))
    parts = [
        distance(_indices(indices, 2), std=float(both[0]), origin=origin),
        angle(indices, std=float(both[1]), full=True, origin=origin),
    ]
    return replace(stack(parts), kind="distance and angle")


def of_kind(kind: str, indices: Sequence[int], *, std: float) -> Sensor:
    """The sensor that a table names.

    Parameters
    ----------
    kind : {"direct", "differential", "range", "angle"}
        The types of Grange et al., Table I; ``"range"`` is :func:`distance`, ``"angle"`` is
        ``arctan(b/a)``.
    indices, std
        The components, counted from 0; the standard deviation of each reading, positive.

    Examples
    --------
    >>> of_kind("range", [0, 1], std=0.1).kind
    'distance'
    """
    makers: dict[str, Callable[..., Sensor]] = {
        "direct": direct,
        "differential": differential,
        "range": distance,
        "angle": angle,
    }
    return makers[choice(kind, "kind", makers)](indices, std=std)


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
    >>> both = stack([direct([0], std=0.1), angle([0, 1], std=0.2)])
    >>> both.predict([1.0, 1.0]).round(4), both.cov.diagonal().round(4)
    (array([1.    , 0.7854]), array([0.01, 0.04]))
    """
    parts = tuple(sensors) if isinstance(sensors, Sequence) else ()
    if not parts or not all(isinstance(s, Sensor) for s in parts):
        raise ValueError(f"sensors: needs a sequence of at least one Sensor, got {sensors!r}")
    ends = np.cumsum([s.dim for s in parts])
    cov = np.zeros((ends[-1], ends[-1]))
    for s, end in zip(parts, ends, strict=True):
        cov[end - s.dim : end, end - s.dim : end] = s.cov

    def function(x: Array, previous: Array | None = None) -> Array:
        return np.concatenate([s._predict(x, previous) for s in parts], axis=-1)

    def difference(observed: Array, predicted: Array) -> Array:
        pairs = zip(
            parts,
            np.split(observed, ends[:-1], axis=-1),
            np.split(predicted, ends[:-1], axis=-1),
            strict=True,
        )
        return np.concatenate([s._residual(y, p) for s, y, p in pairs], axis=-1)

    def derivative(x: Array, previous: Array | None = None) -> Array:
        slopes = [s._jacobian(x, previous) for s in parts]
        full = [np.broadcast_to(h, (*x.shape[:-1], *h.shape[-2:])) for h in slopes]
        return np.concatenate(full, axis=-2)

    known = any(s.units for s in parts)
    linear = all(s.linear is not None for s in parts)
    return Sensor(
        int(ends[-1]), function, cov,
        difference=None if all(s.difference is None for s in parts) else difference,
        uses_previous=any(s.uses_previous for s in parts), kind="stacked",
        linear=(lambda d: np.concatenate([s.matrix(d) for s in parts])) if linear else None,
        derivative=derivative,
        units=tuple(u for s in parts for u in s.units or ("",) * s.dim) if known else (),
    )
