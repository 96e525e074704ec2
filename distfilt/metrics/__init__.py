"""Metrics of estimates: error, consistency and scores, with confidence intervals."""

from .intervals import Interval, mean_interval, median_interval, proportion_interval
from .scores import crps, gaussian_crps, log_score, nees, nees_band, nis, squared_error

__all__ = [
    "Interval",
    "crps",
    "gaussian_crps",
    "log_score",
    "mean_interval",
    "median_interval",
    "nees",
    "nees_band",
    "nis",
    "proportion_interval",
    "squared_error",
]
