"""Gaussian mixtures: densities, fusion of a shared part of the state, reduction, divergences."""

from . import unscented
from .agreement import target_fusion
from .arcs import arc
from .collocation import nonnegative_least_squares, tikhonov
from .divergence import (
    Divergence,
    jeffreys_by_quadrature,
    jeffreys_by_sampling,
    jeffreys_of_many,
)
from .fusion import PartialFusion, average, fuse, fuse_in_turn, fuse_moments
from .gaussian import GaussianMixture
from .quadratics import ExponentialQuadratics
from .reduction import (
    cross_relevance,
    kept_by_relevance,
    merge_costs,
    pivoted_qr,
    prune,
    runnalls,
    two_stage,
)
from .shapes import Shapes
from .splitting import split, split_library, stretching
from .steps import conditioned, moved, split_stretched

__all__ = [  # fmt: skip
    "Divergence", "ExponentialQuadratics", "GaussianMixture", "PartialFusion", "Shapes", "arc",
    "average", "conditioned", "cross_relevance", "fuse", "fuse_in_turn", "fuse_moments",
    "jeffreys_by_quadrature", "jeffreys_by_sampling", "jeffreys_of_many", "kept_by_relevance",
    "merge_costs", "moved", "nonnegative_least_squares", "pivoted_qr", "prune", "runnalls", "split",
    "split_library", "split_stretched", "stretching", "target_fusion", "tikhonov", "two_stage",
    "unscented",
]
