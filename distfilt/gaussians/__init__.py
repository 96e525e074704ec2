"""Gaussians: density, update, points, fusion of several, and ensembles moved onto one."""

from .intersection import intersect_gaussians, intersection_weights
from .pairwise import (
    intersect_ellipsoids,
    intersect_inverses,
    intersect_split,
    unite_gaussians,
)
from .single import condition, log_density

__all__ = [
    "condition",
    "intersect_ellipsoids",
    "intersect_gaussians",
    "intersect_inverses",
    "intersect_split",
    "intersection_weights",
    "log_density",
    "unite_gaussians",
]
