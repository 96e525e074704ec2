"""Gaussian mixtures: densities, fusion of a shared part of the state, reduction, divergences."""

from .agreement import average, fuse, fuse_in_turn, fuse_moments, target_fusion
from .divergence import Divergence, jeffreys_by_sampling, jeffreys_of_many
from .fusion import PartialFusion, nonnegative_least_squares, tikhonov
from .gaussian import GaussianMixture
from .reduction import Shapes, cross_relevance, kept_by_relevance, merge_costs, pivoted_qr, runnalls
from .splitting import split, split_library, stretching

__all__ = [  # fmt: skip
    "Divergence", "GaussianMixture", "PartialFusion", "Shapes", "average", "cross_relevance",
    "fuse", "fuse_in_turn", "fuse_moments", "jeffreys_by_sampling", "jeffreys_of_many",
    "kept_by_relevance", "merge_costs", "nonnegative_least_squares", "pivoted_qr", "runnalls",
    "split", "split_library", "stretching", "target_fusion", "tikhonov",
]
