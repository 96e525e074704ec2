"""Gaussians: density, update, points, intersection of several, and ensembles moved onto one."""

from .intersection import intersect_gaussians, intersection_weights
from .single import condition, log_density

__all__ = ["condition", "intersect_gaussians", "intersection_weights", "log_density"]
