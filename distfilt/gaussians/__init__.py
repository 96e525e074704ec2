"""Gaussians: density, update, points, intersection of several, and ensembles moved onto one."""

from .intersecting import intersection, intersection_weights
from .single import conditioned, log_density

__all__ = ["conditioned", "intersection", "intersection_weights", "log_density"]
