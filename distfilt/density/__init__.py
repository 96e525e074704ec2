"""Densities on grids: kernel estimates, the Fokker-Planck equation, and their Kalman filter."""

from .consensus import (
    BiasedAverage,
    ConsensusProtocol,
    DynamicAverage,
    PIConsensus,
)
from .flooding import Centralised, Flooding, Neighbours
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

__all__ = [
    "BiasedAverage",
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
