"""Densities on grids: kernel estimates, the Fokker-Planck equation, and the filter of both."""

from .fokker_planck import FokkerPlanck, bernoulli
from .forms import Separate, filters_start, filters_step
from .gain import (
    Dense,
    LowRank,
    Shared,
    dense_step,
    low_rank_start,
    low_rank_step,
    shared_moved,
    shared_start,
    shared_step,
)
from .grid import Grid
from .kernel import (
    adaptive_bandwidths,
    bandwidth,
    kernel_covariance,
    kernel_density,
    kernel_information,
    kernel_noise,
    kernels,
)
from .prior import zero_mean_prior
from .sharing import Centralised, DynamicAverage, Flooding, Neighbours, PIConsensus, Sharing

__all__ = [  # fmt: skip
    "Centralised", "Dense", "DynamicAverage", "Flooding", "FokkerPlanck", "Grid", "LowRank",
    "Neighbours", "PIConsensus", "Separate", "Shared", "Sharing", "adaptive_bandwidths",
    "bandwidth", "bernoulli", "dense_step", "filters_start", "filters_step", "kernel_covariance",
    "kernel_density", "kernel_information", "kernel_noise", "kernels", "low_rank_start",
    "low_rank_step", "shared_moved", "shared_start", "shared_step", "zero_mean_prior",
]
