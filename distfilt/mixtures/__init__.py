"""Gaussian mixtures: densities, fusion of a shared part of the state, reduction, divergences."""

from .divergence import Divergence, jeffreys_by_sampling, jeffreys_of_many
from .fusion import (
    average_mixtures,
    fuse_mixtures,
    fuse_moments,
    fuse_sequentially,
    target_fusion,
)
from .gaussian import GaussianMixture
from .partial_fusion import PartialFusion, nonnegative_least_squares, tikhonov
from .reduction import (
    ComponentShapes,
    cross_relevance,
    merge_costs,
    merge_irrelevant,
    pivoted_qr,
    runnalls,
)
from .splitting import (
    nonlinearity,
    split_components,
    split_gaussian,
    split_library,
)

__all__ = [
    "Divergence",
    "GaussianMixture",
    "PartialFusion",
    "ComponentShapes",
    "average_mixtures",
    "cross_relevance",
    "fuse_mixtures",
    "fuse_sequentially",
    "fuse_moments",
    "jeffreys_by_sampling",
    "jeffreys_of_many",
    "merge_irrelevant",
    "merge_costs",
    "nonnegative_least_squares",
    "pivoted_qr",
    "runnalls",
    "split_components",
    "split_gaussian",
    "split_library",
    "nonlinearity",
    "target_fusion",
    "tikhonov",
]
