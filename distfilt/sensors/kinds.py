"""The built-in sensors: components, increments, distances, angles, and stacks of sensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Annotated, Literal, TypedDict, cast

import numpy as np
from scipy.linalg import block_diag

from ..periods import Periods, PeriodsArgument, read_periods
from ..validation import (
    Array,
    ArrayInput,
    Bounds,
    DistinctIndices,
    NonNegativeInt,
    call_user,
    validated,
)
from ..validation.checks import check_distinct
from .base import Sensor, wrap_angles
from .likelihood import LikelihoodSensor

__all__ = [
    "angles_only",
    "bearing",
    "component",
    "distance",
    "ephemeris",
    "from_name",
    "increment",
    "line_angle",
    "range_bearing",
    "stack",
]

Deviation = Annotated[float, Bounds(at_least=1e-150, at_most=1e150)]
"""A standard deviation whose square is neither zero nor infinite."""

AngleDeviation = Annotated[float, Bounds(at_least=1e-150, at_most=np.pi)]
"""A standard deviation of an angle, in rad; a wider Gaussian, wrapped, is nearly uniform."""

Pair = Annotated[tuple[NonNegativeInt, NonNegativeInt], check_distinct]
"""Two different components."""

Point = Annotated[ArrayInput, "2"]
"""A place in the plane."""


# Components and their increments.


@validated
def component(
    indices: DistinctIndices, *, std: Deviation, periods: PeriodsArgument = ()
) -> Sensor:
    """Measure components of the state, ``h(x) = x[indices]``, with standard deviation `std` each.

    `periods` are those of the observation, as of :class:`Sensor`: a compass has one.

    Examples
    --------
    >>> component([0, 2], std=0.1).predict([1.0, 2.0, 3.0])
    array([1., 3.])
    >>> compass = component([2], std=0.1, periods=(2 * np.pi,))
    >>> compass.residual([3.0], [-3.0]).round(4)
    array([-0.2832])
    """
    return Sensor.construct(
        dim=len(indices),
        h=partial(_select, indices=indices),
        noise_cov=_diagonal_cov([std] * len(indices)),
        kind="component",
        linear=partial(_selection_matrix, indices=indices),
        periods=read_periods(periods, len(indices)),
    )


@validated
def increment(
    indices: DistinctIndices, *, std: Deviation, periods: PeriodsArgument = ()
) -> Sensor:
    """Measure the change of components since this sensor's last observation, to `std` each.

    Other sensors may observe in between, at any rate, and a message may be lost on its way to a
    neighbour. Where an observation is missing (NaN, or no event), the next one has the change
    since the last that came. Ensembles, particles, transport and
    :func:`distfilt.kalman.mekf` can use it; the other filters refuse it.

    The increment of an angle has its period: `periods`, as of :class:`Sensor`.

    Examples
    --------
    >>> increment([1], std=0.1).predict([1.0, 5.0], previous=[0.0, 3.0])
    array([2.])
    """
    return Sensor.construct(
        dim=len(indices),
        h=partial(_increment, indices=indices),
        noise_cov=_diagonal_cov([std] * len(indices)),
        uses_previous=True,
        kind="increment",
        # Not `linear`: H belongs to sensors of the present state alone.
        derivative=partial(_increment_jacobian, indices=indices),
        periods=read_periods(periods, len(indices)),
    )


@validated
def ephemeris(*, position_std: Deviation, velocity_std: Deviation) -> Sensor:
    """Measure the first body's position and velocity, in km and m/s.

    Parameters
    ----------
    position_std, velocity_std : float
        Standard deviations, above 0, in km and m/s.

    Examples
    --------
    >>> ephemeris(position_std=1e-3, velocity_std=1e-5).dim
    6
    """
    # The first six components of the state, with a noise of two scales.
    stds = [position_std] * 3 + [velocity_std] * 3
    sensor = component(tuple(range(6)), std=1.0)
    return sensor.replace(noise_cov=_diagonal_cov(stds))


def _diagonal_cov(stds: Sequence[float]) -> Array:
    """Return the covariance of independent components, read-only."""
    cov: Array = np.diag(np.square(np.asarray(stds)))
    # Read-only, as all arrays of a sensor are.
    cov.setflags(write=False)
    return cov


def _select(x: Array, indices: Sequence[int]) -> Array:
    """Return components of states (..., d), as a copy (..., n)."""
    # A list of indices copies; a tuple would index one axis for each entry.
    return x[..., list(indices)]


def _selection_matrix(dim: int, indices: Sequence[int]) -> Array:
    """Return the matrix (n, `dim`) that selects components of a state: rows of the identity."""
    # Only here is the dimension of the state known, and so which indices are too large.
    Bounds(below=dim)(max(indices), "indices")
    return _select(np.eye(dim), indices).T


def _increment(x: Array, previous: Array, indices: Sequence[int]) -> Array:
    """Return changes (..., n) of components from the previous states to the present ones."""
    return np.asarray(_select(x, indices) - _select(previous, indices))


def _increment_jacobian(x: Array, previous: Array, indices: Sequence[int]) -> Array:
    """Return the derivative (n, d) of changes by the present states."""
    # The previous state does not depend on the present one.
    return _selection_matrix(x.shape[-1], indices)


# Distances and angles in some components.


@validated
def distance(
    indices: DistinctIndices,
    *,
    std: Deviation,
    origin: Annotated[ArrayInput, "n"] | None = None,
    observer: DistinctIndices | None = None,
) -> Sensor:
    """Measure the distance of some components from a place, ``h(x) = |x[indices] - origin|``.

    Parameters
    ----------
    indices : sequence of int
        The components, counted from 0.
    std : float
        Standard deviation of the distance, in the components' unit, positive.
    origin : array_like, (n,), optional
        The place of the sensor, one coordinate for each of the n indices; zero by
        default.
    observer : sequence of n int, optional
        The components that hold the sensor's place, if the sensor is on a body of the
        state: ``h(x) = |x[indices] - x[observer]|``.

    Notes
    -----
    The distance has no derivative at the origin itself; zero is used there.

    Examples
    --------
    >>> distance([0, 1], std=0.1).predict([3.0, 4.0, 9.0])
    array([5.])
    >>> distance([0, 1], std=0.1, observer=[2, 3]).predict([3.0, 4.0, 3.0, 6.0])
    array([2.])
    """
    if origin is not None and len(origin) != len(indices):
        raise ValueError(
            f"origin must have shape ({len(indices)},), got {origin.shape}"
        )
    # The arguments `indices`, `origin` and `observer` of the prediction and of its derivative
    geometry = _geometry(indices, origin, observer)
    return Sensor.construct(
        dim=1,
        h=partial(_distance, **geometry),
        noise_cov=_diagonal_cov([std]),
        kind="distance",
        derivative=partial(_distance_jacobian, **geometry),
    )


@validated
def bearing(
    indices: Pair,
    *,
    std: AngleDeviation,
    origin: Point | None = None,
    observer: DistinctIndices | None = None,
) -> Sensor:
    """Measure the direction of two components (a, b), ``arctan2(b, a)``, with period 2π.

    Parameters
    ----------
    indices : sequence of two int
        The components a and b.
    std : float
        Standard deviation, in rad, positive and at most π.
    origin : array_like, (2,), optional
        The place of the sensor; zero by default.
    observer : sequence of two or three int, optional
        As of :func:`range_bearing`.

    Notes
    -----
    At the origin itself the angle does not exist: the prediction and its derivative are
    NaN, and a filter leaves the observation out.

    See Also
    --------
    line_angle : An angle that cannot tell a direction from the opposite one.

    Examples
    --------
    >>> sensor = bearing([0, 1], std=0.2)
    >>> sensor.predict([-1.0, -1.0]).round(4)
    array([-2.3562])
    >>> sensor.residual([3.0], [-3.0]).round(4)
    array([-0.2832])
    """
    return _angle_sensor("bearing", indices, std, origin, observer, period=2 * np.pi)


@validated
def line_angle(
    indices: Pair, *, std: AngleDeviation, origin: Point | None = None
) -> Sensor:
    """Measure the angle of the line through two components (a, b), ``arctan(b/a)``, period π.

    This is the angle of Grange et al., Table I. It is the same for a direction and the
    opposite one; :func:`bearing` tells them apart.

    Parameters
    ----------
    indices : sequence of two int
        The components a and b.
    std : float
        Standard deviation, in rad, positive and at most π.
    origin : array_like, (2,), optional
        The place of the sensor; zero by default.

    Notes
    -----
    At the origin itself the angle does not exist: the prediction and its derivative are
    NaN, and a filter leaves the observation out.

    Examples
    --------
    >>> sensor = line_angle([0, 1], std=0.2)
    >>> sensor.predict([-1.0, -1.0]).round(4)
    array([0.7854])
    >>> sensor.residual([1.5], [-1.5]).round(4)
    array([-0.1416])
    """
    return _angle_sensor(
        "line_angle", indices, std, origin, observer=None, period=np.pi
    )


def _angle_sensor(
    kind: str,
    indices: Sequence[int],
    std: float,
    origin: Array | None,
    observer: Sequence[int] | None,
    period: float,
) -> Sensor:
    """Return the sensor of a direction or of the angle of a line, by its period.

    Its kind is a name, its `std` in rad. The sensor stands at `origin`, or where the components
    `observer` of the state say.
    """
    # The arguments `indices`, `origin` and `observer` of the prediction and of its derivative
    geometry = _geometry(indices, origin, observer, has_heading=True)
    return Sensor.construct(
        dim=1,
        h=partial(_angle, period=period, **geometry),
        noise_cov=_diagonal_cov([std]),
        kind=kind,
        derivative=partial(_angle_jacobian, **geometry),
        periods=(period,),
    )


@validated
def range_bearing(
    indices: Pair,
    *,
    std: tuple[Deviation, AngleDeviation],
    origin: Point | None = None,
    heading: float = 0.0,
    observer: DistinctIndices | None = None,
) -> Sensor:
    """Measure the distance and the bearing of two components, as a radar or a robot does.

    Parameters
    ----------
    indices : sequence of two int
        The components a and b.
    std : (float, float)
        Standard deviations of the distance, in the components' unit, and of the angle,
        in rad.
    origin : array_like, (2,), optional
        The place of the sensor; zero by default.
    heading : float
        The sensor's heading, in rad from the first axis to the second: the bearing is
        measured from there, with period 2π.
    observer : sequence of two or three int, optional
        The components that hold the sensor's place, or its place and heading, if the
        sensor is on a body of the state, such as a robot that estimates its own pose.

    Notes
    -----
    At the origin itself there is no angle: it and its derivative are NaN. A robot that
    moves needs a new sensor at each observation; within
    :func:`distfilt.validation.skip_validation` making one takes about 10 µs.

    Examples
    --------
    >>> radar = range_bearing([0, 1], std=[0.5, 0.01], origin=[1.0, 0.0])
    >>> radar.predict([1.0, 2.0]).round(4)
    array([2.    , 1.5708])

    A robot at (1, 0) that heads north sees a landmark of the state, two metres ahead:

    >>> camera = range_bearing([3, 4], std=[0.1, 0.02], observer=[0, 1, 2])
    >>> camera.predict([1.0, 0.0, np.pi / 2, 1.0, 2.0]).round(4)
    array([2., 0.])
    """
    if observer is not None and heading:
        raise ValueError(
            f"heading must be 0 for a sensor on a body of the state, got {heading:g}"
        )
    # The arguments `indices`, `origin` and `observer` of the prediction and of its derivative
    geometry = _geometry(indices, origin, observer, has_heading=True)
    return Sensor.construct(
        dim=2,
        h=partial(_range_bearing, heading=heading, **geometry),
        noise_cov=_diagonal_cov(std),
        # Of (distance, bearing) only the second wraps.
        periods=(None, 2 * np.pi),
        kind="range_bearing",
        derivative=partial(_range_bearing_jacobian, **geometry),
    )


class _Geometry(TypedDict):
    """The arguments that the functions below share."""

    indices: tuple[int, ...]
    origin: Array
    observer: tuple[int, ...]


def _geometry(
    indices: Sequence[int],
    origin: Array | None,
    observer: Sequence[int] | None = None,
    *,
    has_heading: bool = False,
) -> _Geometry:
    """Return the components that form a place, and the place of the sensor as an own copy.

    An observer has as many components as a place, and a heading behind them if `has_heading` allows
    it. An origin is (n,) for n indices, and zero by default.
    """
    # A copy: the caller's array may be that of a robot that moves on.
    place = np.array(0.0 if origin is None else origin)
    if observer is None:
        return {"indices": tuple(indices), "origin": place, "observer": ()}
    if origin is not None:
        raise ValueError("origin must be None for a sensor on a body of the state")
    # As many components as the place has, and perhaps one more: has_heading counts as 0 or 1.
    n = len(indices)
    if len(observer) not in (n, n + has_heading):
        expected = f"{n} or {n + 1}" if has_heading else str(n)
        raise ValueError(
            f"observer must have {expected} components, got {len(observer)}"
        )
    if set(observer) & set(indices):
        raise ValueError(
            f"observer must have other components than indices, got {list(observer)}"
        )
    return {
        "indices": tuple(indices),
        "origin": place,
        "observer": tuple(observer),
    }


def _offset(
    x: Array, indices: tuple[int, ...], origin: Array, observer: tuple[int, ...]
) -> Array:
    """Return the vector (..., n) from the sensor to the place that n components form.

    The sensor is at `origin`, or, on a body of the state, where its components `observer` say.
    """
    place = origin
    if observer:
        place = x[..., _columns(observer[: len(indices)], x.shape[-1])]
    return np.asarray(x[..., _columns(indices, x.shape[-1])] - place)


@lru_cache(maxsize=256)
def _columns(indices: tuple[int, ...], dim: int) -> slice | list[int]:
    """Return an index of components: a slice, which copies nothing, if they are neighbours.

    >>> _columns((2, 3), 4), _columns((3, 2), 4), _columns((3, 4), 4)
    (slice(2, 4, None), [3, 2], [3, 4])
    """
    columns = list(indices)
    stop = columns[0] + len(columns)
    # A slice beyond the last component would lose some without an error.
    if stop <= dim and columns == list(range(columns[0], stop)):
        return slice(columns[0], stop)
    return columns


def _own_heading(
    x: Array, indices: tuple[int, ...], observer: tuple[int, ...]
) -> Array | float:
    """Return the heading of a sensor on a body of the state, zero without one."""
    if len(observer) <= len(indices):
        return 0.0
    return np.asarray(x[..., observer[len(indices)]])


def _lengths(vectors: Array) -> Array:
    """Return the lengths of vectors (..., n), as (..., 1)."""
    squares = vectors * vectors
    return np.asarray(np.sqrt(np.add.reduce(squares, axis=-1, keepdims=True)))


def _insert_columns(
    slope: Array, indices: tuple[int, ...], observer: tuple[int, ...], dim: int
) -> Array:
    """Return the Jacobian (..., m, `dim`) of a function of the offset from the sensor to a place.

    `slope` (..., m, n) is its derivative by the offset, p - s: by the components of the place p it
    is the same, by those of the sensor's own place s its negative, and by all others zero.
    """
    jacobian = np.zeros((*slope.shape[:-1], dim))
    jacobian[..., _columns(indices, dim)] = slope
    if observer:
        jacobian[..., _columns(observer[: len(indices)], dim)] = -slope
    return jacobian


def _distance(
    x: Array, indices: tuple[int, ...], origin: Array, observer: tuple[int, ...]
) -> Array:
    """Return distances (..., 1) of states (..., d) from the sensor."""
    return _lengths(_offset(x, indices, origin, observer))


def _distance_jacobian(
    x: Array, indices: tuple[int, ...], origin: Array, observer: tuple[int, ...]
) -> Array:
    """Return the derivatives (..., 1, d) of distances."""
    # The vector from the sensor to the place, and the derivative (..., n) of its length
    offset = _offset(x, indices, origin, observer)
    slope = _distance_slope(offset, _lengths(offset))
    return _insert_columns(slope[..., None, :], indices, observer, x.shape[-1])


def _distance_slope(offset: Array, length: Array) -> Array:
    """Return the derivative of vectors' lengths, and zero at the vector zero.

    Vectors are (..., n), and their lengths (..., 1).
    """
    # ∂|v|/∂v = vᵀ / |v|
    return np.asarray(offset / _replace_zeros(length, value=1.0))


def _replace_zeros(length: Array, value: float) -> Array:
    """Return lengths with a value in place of those that are not positive."""
    is_positive = length > 0
    # The usual case
    if np.count_nonzero(is_positive) == is_positive.size:
        return length
    return np.where(is_positive, length, value)


def _angle(
    x: Array,
    period: float,
    indices: tuple[int, ...],
    origin: Array,
    observer: tuple[int, ...],
) -> Array:
    """Return directions (..., 1) of states (..., d) from the sensor."""
    offset = _offset(x, indices, origin, observer)
    return _direction(offset, period, _own_heading(x, indices, observer))


def _direction(offset: Array, period: float, heading: float | Array) -> Array:
    """Return the angles (..., 1) of vectors (..., 2) from a heading, NaN for the vector zero.

    They are wrapped to one `period` around zero.
    """
    angle = np.arctan2(offset[..., 1], offset[..., 0])
    # arctan2(0, 0) is 0, but the sensor's own place has no direction.
    if np.count_nonzero(offset) < offset.size:
        angle = np.where(offset.any(axis=-1), angle, np.nan)
    return wrap_angles(angle - heading, period)[..., None]


def _angle_jacobian(
    x: Array, indices: tuple[int, ...], origin: Array, observer: tuple[int, ...]
) -> Array:
    """Return the derivatives (..., 1, d) of directions, NaN at the sensor's own place.

    The bearing is that of the components `indices` from `origin`, or from the components
    `observer`, behind which a heading may stand.
    """
    # The vector from the sensor to the place, and the derivative (..., 2) of its angle; by the
    # components of the state it has zeros elsewhere.
    offset = _offset(x, indices, origin, observer)
    slope = _angle_slope(offset, _lengths(offset))
    jacobian = _insert_columns(slope[..., None, :], indices, observer, x.shape[-1])
    if len(observer) > len(indices):
        # The bearing decreases as the sensor turns. Adding 0 · NaN gives NaN where there is none.
        jacobian[..., 0, observer[len(indices)]] = -1.0 + 0.0 * slope[..., 0]
    return jacobian


def _angle_slope(offset: Array, length: Array) -> Array:
    """Return the derivative of vectors' angles, and NaN at the vector zero.

    Vectors are (..., 2), and their lengths (..., 1).
    """
    # ∂ arctan2(b, a) / ∂(a, b) = (-b, a) / (a² + b²), by unit vectors to avoid overflow.
    length = _replace_zeros(length, np.nan)
    unit = offset / length
    slope = np.empty(unit.shape)
    slope[..., 0] = -unit[..., 1]
    slope[..., 1] = unit[..., 0]
    slope /= length
    return slope


def _range_bearing(
    x: Array,
    heading: float,
    indices: tuple[int, ...],
    origin: Array,
    observer: tuple[int, ...],
) -> Array:
    """Return distances and bearings (..., 2) of states (..., d) from the sensor.

    The place is that of the components `indices`, seen from `origin` with a heading, or from the
    components `observer`, behind which a heading may stand.
    """
    # The vector from the sensor to the place, and the sensor's heading, from which bearings are
    # measured and wrapped to one turn, 2π.
    offset = _offset(x, indices, origin, observer)
    total_heading = heading + _own_heading(x, indices, observer)
    result = np.empty((*offset.shape[:-1], 2))
    result[..., :1] = _lengths(offset)
    result[..., 1:] = _direction(offset, 2 * np.pi, total_heading)
    return result


def _range_bearing_jacobian(
    x: Array, indices: tuple[int, ...], origin: Array, observer: tuple[int, ...]
) -> Array:
    """Return the derivatives (..., 2, d) of distances and bearings.

    The place is that of the components `indices`, seen from `origin`, or from the components
    `observer`, behind which a heading may stand.
    """
    # The vector from the sensor to the place. A constant heading only shifts the bearing, so that
    # it does not enter.
    offset = _offset(x, indices, origin, observer)
    length = _lengths(offset)
    # At the sensor's own place there is no bearing: its derivative is NaN.
    positive = _replace_zeros(length, np.nan)
    unit = offset / positive
    slopes = np.empty((*offset.shape[:-1], 2, 2))
    # The distance |v| has the derivative vᵀ / |v|.
    slopes[..., 0, :] = unit
    if positive is not length:
        # Some length is zero, where the distance's derivative is zero too, and not NaN.
        slopes[..., 0, :] = _distance_slope(offset, length)
    # The bearing arctan2(b, a) has the derivative (-b, a) / |v|²: by |v| twice, without overflow.
    slopes[..., 1, 0] = -unit[..., 1]
    slopes[..., 1, 1] = unit[..., 0]
    slopes[..., 1, :] /= positive
    jacobian = _insert_columns(slopes, indices, observer, x.shape[-1])
    if len(observer) > len(indices):
        # Behind its position the sensor's body has a heading: as it turns, the bearing decreases.
        turn = observer[len(indices)]
        # Adding 0 · NaN gives NaN where there is no bearing.
        jacobian[..., 1, turn] = -1.0 + 0.0 * slopes[..., 1, 0]
    return jacobian


# The direction to a body in space.


@validated
def angles_only(
    *,
    std: AngleDeviation,
    form: Literal["arctan2", "printed"] = "arctan2",
    observer: NonNegativeInt = 6,
    hidden: Callable[[Array, Array], Array] | None = None,
) -> Sensor:
    r"""Measure the direction from an observer to a target, the state's first body: two angles.

    Parameters
    ----------
    std : float
        Standard deviation of each angle, in rad, at most π.
    form : {"arctan2", "printed"}
        Right ascension and declination, or (49) of Semeraro et al. as printed, which
        has the arcsine of the unit vector's y component in place of the right
        ascension.
    observer : int
        Index at which the observer's position begins in the state.
    hidden : callable, optional
        ``hidden(target, observer) -> bool (...)`` of positions (..., 3), such as
        :func:`distfilt.models.occulted`; a hidden direction is NaN.

    Examples
    --------
    >>> telescope = angles_only(std=1e-4)
    >>> x = np.zeros(12)
    >>> x[:3] = -1.0, -1.0, 0.0
    >>> telescope.predict(x).round(4) + 0.0
    array([-2.3562,  0.    ])
    """
    return Sensor.construct(
        dim=2,
        h=partial(_angles_only, form=form, observer=observer, hidden=hidden),
        noise_cov=_diagonal_cov([std, std]),
        # The first angle is a direction in the plane and repeats after 2π. The second, a
        # declination, lies between -π/2 and π/2. (So does the first in the printed
        # form, an arcsine.)
        periods=(2 * np.pi, None),
        kind="angles_only",
    )


def _angles_only(
    x: Array, form: str, observer: int, hidden: Callable[[Array, Array], Array] | None
) -> Array:
    """Return both angles (..., 2) of the line of sight in states (..., d); NaN if it is hidden."""
    target = x[..., :3]
    place = x[..., observer : observer + 3]
    # The line of sight, observer to target.
    sight = target - place
    # Rounding can bring a component of the unit vector above one, where arcsin is NaN.
    unit = np.clip(sight / np.linalg.norm(sight, axis=-1, keepdims=True), -1, 1)
    # The declination is arcsin(z), the second angle of both forms; the printed first is arcsin(y).
    angles: Array = np.arcsin(unit[..., 1:])
    if form == "arctan2":
        angles[..., 0] = np.arctan2(unit[..., 1], unit[..., 0])
    # A direction that is hidden, as by the Earth, is missing.
    if hidden is not None:
        angles[np.asarray(call_user(hidden, target, place))] = np.nan
    return angles


# Sensors by name, and several as one.


@validated
def from_name(
    kind: Literal["component", "increment", "distance", "line_angle", "bearing"],
    indices: DistinctIndices,
    *,
    std: Deviation,
) -> Sensor:
    """Return the built-in sensor of a name, as a table of a scenario gives it.

    Parameters
    ----------
    kind : {"component", "increment", "distance", "line_angle", "bearing"}
        The function of this module that makes the sensor. The first four are the types
        of Grange et al., Table I, there called direct, differential, range and angle.
    indices, std
        The components, counted from 0; the standard deviation of each, positive. Angles
        take two components and at most π.

    Examples
    --------
    >>> from_name("distance", [0, 1], std=0.1).kind
    'distance'
    """
    makers: dict[str, Callable[..., Sensor]] = {
        "component": component,
        "increment": increment,
        "distance": distance,
        "line_angle": line_angle,
        "bearing": bearing,
    }
    # Limits that hold for angles only, which the shared annotations cannot state.
    if kind in ("line_angle", "bearing"):
        Bounds(at_most=np.pi)(std, "std")
        if len(indices) != 2:
            raise ValueError(
                f"indices must have 2 entries for kind {kind!r}, got {len(indices)}"
            )
    return makers[kind](indices, std=std)


@validated
def stack(sensors: Sequence[Sensor]) -> Sensor:
    """Combine sensors into one, whose observation is theirs one after the other.

    It wraps the components that the given sensors wrap, is linear if all of them are,
    and needs the previous state if one of them does.

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
    if any(isinstance(sensor, LikelihoodSensor) for sensor in sensors):
        raise ValueError(
            "sensors must have Gaussian noise to be stacked, got a LikelihoodSensor: give an agent "
            "a list of its sensors"
        )
    # Independent noise: R is block diagonal.
    cov = block_diag(*[sensor.noise_cov for sensor in sensors])
    cov.setflags(write=False)
    # Only if a part wraps, residuals are taken part by part; otherwise they are differences.
    residual_function = None
    periods: Periods = ()
    if any(sensor.residual_function is not None for sensor in sensors):
        residual_function = partial(_stack_residuals, sensors=sensors)
    elif any(sensor.periods for sensor in sensors):
        for sensor in sensors:
            # A sensor keeps its periods in this form.
            periods += cast(Periods, sensor.periods) or (None,) * sensor.dim
    # A stack of matrices, if every part has one; otherwise Jacobians are stacked.
    linear = None
    if all(sensor.linear is not None for sensor in sensors):
        linear = partial(_stack_matrices, sensors=sensors)
    return Sensor.construct(
        dim=len(cov),
        h=partial(_stack_predictions, sensors=sensors),
        noise_cov=cov,
        kind="stack",
        residual_function=residual_function,
        periods=periods,
        uses_previous=any(sensor.uses_previous for sensor in sensors),
        linear=linear,
        derivative=partial(_stack_jacobians, sensors=sensors),
    )


def _stack_predictions(*states: Array, sensors: Sequence[Sensor]) -> Array:
    """Return the observations (..., M) that stacked sensors predict, one after the other."""
    return np.concatenate([s.predict(*states) for s in sensors], axis=-1)


def _stack_jacobians(*states: Array, sensors: Sequence[Sensor]) -> Array:
    """Return the Jacobians of stacked sensors, one below the other, (..., M, d)."""
    return np.concatenate([s.jacobian(*states) for s in sensors], axis=-2)


def _stack_matrices(dim: int, sensors: Sequence[Sensor]) -> Array:
    """Return the matrices H of stacked linear sensors, one below the other, (M, `dim`)."""
    return np.concatenate([s.H(dim) for s in sensors], axis=0)


def _stack_residuals(
    observed: Array, predicted: Array, sensors: Sequence[Sensor]
) -> Array:
    """Return the residuals (..., M) of stacked sensors, each by the rule of its sensor.

    Observations and predictions are (..., M), those of the sensors side by side.
    """
    # Each sensor takes its own part of the components.
    ends = np.cumsum([sensor.dim for sensor in sensors])[:-1]
    observed_parts = np.split(observed, ends, axis=-1)
    predicted_parts = np.split(predicted, ends, axis=-1)
    parts = zip(sensors, observed_parts, predicted_parts, strict=True)
    residuals = [sensor.residual(y, p) for sensor, y, p in parts]
    return np.concatenate(residuals, axis=-1)
