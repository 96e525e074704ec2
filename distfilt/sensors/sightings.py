"""What one range and bearing say about a place: the inverse of a sighting.

It begins a landmark that nobody has seen before: place and covariance go to ``reset`` of a filter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np

from ..validation import (
    Array,
    ArrayInput,
    DistinctIndices,
    PositiveSemidefinite,
    validated,
)

__all__ = ["locate_sighting", "sighting_cov"]

Point = Annotated[ArrayInput, "2"]


@validated
def locate_sighting(
    x: Annotated[ArrayInput, "... d"], value: Point, *, observer: DistinctIndices
) -> Array:
    """Return where a body stands that is seen at a range and bearing, (..., 2).

    Parameters
    ----------
    x : array_like, (..., d)
        States that hold the observer's pose.
    value : (float, float)
        Range, in the unit of the place, and bearing, in rad counterclockwise from straight ahead.
    observer : sequence of three int
        The components x, y and heading of the observer.

    Examples
    --------
    A robot at (1, 0) that heads north sees something two metres ahead:

    >>> from distfilt.sensors import locate_sighting
    >>> locate_sighting([1.0, 0.0, np.pi / 2], [2.0, 0.0], observer=[0, 1, 2]).round(4)
    array([1., 2.])
    """
    distance, bearing = value
    # The angle of the ray in the frame of the map
    pose = _read_pose(x, observer)
    angle = pose.heading + bearing
    place = [
        pose.east + distance * np.cos(angle),
        pose.north + distance * np.sin(angle),
    ]
    return np.stack(place, axis=-1)


@validated
def sighting_cov(
    x: Annotated[ArrayInput, "... d"],
    value: Point,
    cov: Annotated[PositiveSemidefinite, "2 2"],
    *,
    observer: DistinctIndices,
) -> Array:
    r"""Return the covariance that a sighting's noise gives the place, (..., 2, 2).

    It is :math:`\mathbf V\mathbf R\mathbf V^\top` with the derivative :math:`\mathbf V` of
    `locate_sighting` by the range and the bearing; the observer's own error is not in it.

    Parameters
    ----------
    x : array_like, (..., d)
    value : (float, float)
        Range and bearing.
    cov : array_like, (2, 2)
        Covariance of range and bearing.
    observer : sequence of three int

    Examples
    --------
    Ten metres ahead, an error of the bearing moves the place sideways by ten times as much:

    >>> from distfilt.sensors import sighting_cov
    >>> R = np.diag([0.1**2, 0.02**2])
    >>> sighting_cov([0.0, 0.0, 0.0], [10.0, 0.0], R, observer=[0, 1, 2]).round(4)
    array([[0.01, 0.  ],
           [0.  , 0.04]])
    """
    distance, bearing = value
    angle = _read_pose(x, observer).heading + bearing
    c = np.cos(angle)
    s = np.sin(angle)
    # Columns: along the ray for the range, and across it, r times as long, for the bearing.
    rows = [
        np.stack([c, -distance * s], axis=-1),
        np.stack([s, distance * c], axis=-1),
    ]
    slope = np.stack(rows, axis=-2)
    return np.asarray(slope @ cov @ slope.mT)


class _Pose(NamedTuple):
    """East, north and heading of an observer, each (...)."""

    east: Array
    north: Array
    heading: Array


def _read_pose(x: Array, observer: Sequence[int]) -> _Pose:
    """Return the pose of the observer in states (..., d)."""
    if len(observer) != 3:
        raise ValueError(
            f"observer must have three entries, x, y and heading, got {len(observer)}"
        )
    east, north, heading = observer
    return _Pose(x[..., east], x[..., north], x[..., heading])
