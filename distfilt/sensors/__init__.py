"""Sensors: what an agent sees of a state, how noisy it is, and how two readings are compared."""

from .base import Sensor, wrap
from .kinds import (
    angle,
    direct,
    distance,
    distance_and_angle,
    ephemeris,
    line_of_sight,
    of_kind,
    stack,
)

__all__ = [  # fmt: skip
    "Sensor", "angle", "direct", "distance", "distance_and_angle", "ephemeris",
    "line_of_sight", "of_kind", "stack", "wrap",
]
