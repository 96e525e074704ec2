"""How good an estimate is: error, consistency, score and spread, with intervals.

Lengths sum over the components, which has a meaning only where they have one unit; otherwise ask
for each component with ``per_component=True``.

Shapes: estimates and truths are (..., d), ensembles (..., N, d), covariances (..., d, d). Leading
axes (runs, agents, times) broadcast between an estimate and its truth.
"""

from ..intervals import Interval, mean_interval, median_interval, proportion_interval
from .consistency import ensemble_nees, nees, nees_band, nis
from .errors import rmse, spread, squared_error
from .scores import crps, gaussian_crps, log_score

__all__ = [  # fmt: skip
    "Interval", "crps", "ensemble_nees", "gaussian_crps", "log_score", "mean_interval",
    "median_interval", "nees", "nees_band", "nis", "proportion_interval", "rmse", "spread",
    "squared_error",
]
