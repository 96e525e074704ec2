"""Gaussians: density, update, points, intersection of several, and ensembles moved onto one."""

from .conditioning import conditioned
from .intersecting import intersection, intersection_weights
from .single import log_density, recolour

__all__ = ["conditioned", "intersection", "intersection_weights", "log_density", "recolour"]
