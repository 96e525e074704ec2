"""Gaussian mixtures: densities, fusion of a shared part of the state, reduction, divergences."""

from .agreement import average, fuse, fuse_in_turn, fuse_moments, target_fusion
from .conditioning import conditioned, moved
from .divergence import Divergence, jeffreys_by_sampling, jeffreys_of_many
from .fusion import PartialFusion
from .gaussian import GaussianMixture
from .mixands import Shapes, nonnegative_least_squares, tikhonov
from .reduction import (
    cross_relevance,
    kept_by_relevance,
    merge_costs,
    pivoted_qr,
    runnalls,
    two_stage,
)
from .splitting import arc, split, split_library, stretching

__all__ = [  # fmt: skip
    "Divergence", "GaussianMixture", "PartialFusion", "Shapes", "arc", "average", "conditioned",
    "cross_relevance", "fuse", "fuse_in_turn", "fuse_moments", "jeffreys_by_sampling",
    "jeffreys_of_many", "kept_by_relevance", "merge_costs", "moved", "nonnegative_least_squares",
    "pivoted_qr", "runnalls", "split", "split_library", "stretching", "target_fusion", "tikhonov",
    "two_stage",
]
