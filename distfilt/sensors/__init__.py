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
from .sightings import locate_sighting, sighting_cov

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
    "locate_sighting",
    "range_bearing",
    "sighting_cov",
    "stack",
    "wrap",
]
