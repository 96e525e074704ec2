"""Sensors: the observation function of an agent, its noise, and the residual."""

from .base import Sensor, wrap
from .kinds import (
    angles_only,
    bearing,
    component,
    distance,
    ephemeris,
    from_name,
    increment,
    line_angle,
    range_bearing,
    stack,
)
from .likelihood import LikelihoodSensor

__all__ = [
    "LikelihoodSensor",
    "Sensor",
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
    "wrap",
]
