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
from .sightings import sighted_cov, sighted_place

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
    "sighted_cov",
    "sighted_place",
    "stack",
    "wrap",
]
