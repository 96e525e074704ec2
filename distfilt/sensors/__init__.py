"""Sensors: what an agent sees of a state, how noisy it is, and how two readings are compared."""

from .base import Sensor, wrap
from .kinds import angle, differential, direct, distance, distance_and_angle, of_kind, stack

__all__ = [  # fmt: skip
    "Sensor", "angle", "differential", "direct", "distance", "distance_and_angle", "of_kind",
    "stack", "wrap",
]
