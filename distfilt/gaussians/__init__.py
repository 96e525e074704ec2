"""Gaussians: density, intersection of several, barycentre, and ensembles moved onto one."""

from .conditioning import conditioned
from .intersecting import _intersection as _intersection
from .intersecting import _intersection_weights as _intersection_weights
from .intersecting import intersection, intersection_weights
from .moving import _bures_barycentre as _bures_barycentre
from .moving import _recolour as _recolour
from .moving import bures_barycentre, recolour
from .single import _log_density as _log_density
from .single import log_density

__all__ = [  # fmt: skip
    "bures_barycentre", "conditioned", "intersection", "intersection_weights", "log_density",
    "recolour",
]
