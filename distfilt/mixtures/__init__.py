"""Gaussian mixtures: densities, fusion of a shared part of the state, reduction, divergences."""

from .agreement import average_mixtures, fuse_mixtures, fuse_sequentially, fuse_moments, target_fusion
from .divergence import Divergence, jeffreys_by_sampling, jeffreys_of_many
from .fusion import PartialFusion, nonnegative_least_squares, tikhonov
from .gaussian import GaussianMixture
from .reduction import ComponentShapes, cross_relevance, merge_irrelevant, merge_costs, pivoted_qr, runnalls
from .splitting import split_components, split_library, nonlinearity

__all__ = [  # fmt: skip
    "Divergence", "GaussianMixture", "PartialFusion", "ComponentShapes", "average_mixtures", "cross_relevance",
    "fuse_mixtures", "fuse_sequentially", "fuse_moments", "jeffreys_by_sampling", "jeffreys_of_many",
    "merge_irrelevant", "merge_costs", "nonnegative_least_squares", "pivoted_qr", "runnalls",
    "split_components", "split_library", "nonlinearity", "target_fusion", "tikhonov",
]
