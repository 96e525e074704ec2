"""Sensors: what an agent sees of a state, how noisy it is, and how two readings are compared."""

from .base import Sensor, wrap
from .kinds import (
    line_angle,
    component,
    distance,
    range_bearing,
    ephemeris,
    angles_only,
    from_name,
    stack,
)

__all__ = [  # fmt: skip
    "Sensor", "line_angle", "component", "distance", "range_bearing", "ephemeris",
    "angles_only", "from_name", "stack", "wrap",
]
