"""Densities on grids: kernel estimates, the Fokker-Planck equation, and the filter of both."""

from .fokker_planck import FokkerPlanck, bernoulli
from .grid import Grid, zero_mean_prior
from .kernel import bandwidth, kernel_covariance, kernel_density, kernel_information, kernels
from .low_rank import Dense, LowRank, dense_step, low_rank_moved, low_rank_start, low_rank_step
from .sharing import Centralised, DynamicAverage, Flooding, Neighbours, PIConsensus, Sharing

__all__ = [  # fmt: skip
    "Centralised", "Dense", "DynamicAverage", "Flooding", "FokkerPlanck", "Grid", "LowRank",
    "Neighbours", "PIConsensus", "Sharing", "bandwidth", "bernoulli", "dense_step",
    "kernel_covariance", "kernel_density", "kernel_information", "kernels", "low_rank_moved",
    "low_rank_start", "low_rank_step", "zero_mean_prior",
]
