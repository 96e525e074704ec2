"""Densities on grids: kernel estimates, the Fokker-Planck equation, and the filter of both."""

from .fokker_planck import FokkerPlanck, bernoulli
from .grid import Grid, zero_mean_prior
from .kernel import (
    bandwidth,
    kernel_constant,
    kernel_covariance,
    kernel_density,
    kernels,
)
from .low_rank import (
    Dense,
    LowRank,
    dense_step,
    low_rank_predict,
    low_rank_start,
    low_rank_step,
)
from .sharing import (
    Centralised,
    ConsensusProtocol,
    DynamicAverage,
    Flooding,
    Neighbours,
    PIConsensus,
)

__all__ = [
    "Centralised",
    "Dense",
    "DynamicAverage",
    "Flooding",
    "FokkerPlanck",
    "Grid",
    "LowRank",
    "Neighbours",
    "PIConsensus",
    "ConsensusProtocol",
    "bandwidth",
    "bernoulli",
    "dense_step",
    "kernel_covariance",
    "kernel_density",
    "kernel_constant",
    "kernels",
    "low_rank_predict",
    "low_rank_start",
    "low_rank_step",
    "zero_mean_prior",
]
