"""Sensors: what an agent sees of a state, how noisy it is, and how two readings are compared."""

from .base import Sensor, wrap
from .kinds import (
    angles_only,
    component,
    distance,
    ephemeris,
    from_name,
    line_angle,
    range_bearing,
    stack,
)

__all__ = [
    "Sensor",
    "line_angle",
    "component",
    "distance",
    "range_bearing",
    "ephemeris",
    "angles_only",
    "from_name",
    "stack",
    "wrap",
]
