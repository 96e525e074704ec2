"""Gaussians: density, update, points, intersection of several, and ensembles moved onto one."""

from ..doors import unchecked
from .conditioning import conditioned
from .intersecting import intersection, intersection_weights
from .moving import _bures_barycentre as _bures_barycentre
from .moving import bures_barycentre
from .points import unscented_points
from .single import log_density, recolour

__all__ = [  # fmt: skip
    "bures_barycentre", "conditioned", "intersection", "intersection_weights", "log_density",
    "recolour", "unscented_points",
]
_recolour = unchecked(recolour)


def _intersection_weights(covs, rule, here):  # type: ignore
    return unchecked(intersection_weights)(covs, rule=rule, here=here)
