"""Kalman filters for many runs at once: linear, extended, unscented, with a smoother.

Filterpy's stand beside them as the reference.
"""

from .linear import GaussianRun, kalman_filter, predict, update
from .multiplicative import Chart, multiplicative_filter, quaternion_chart
from .nonlinear import (
    extended_filter,
    extended_predict,
    extended_update,
    unscented_filter,
    unscented_predict,
    unscented_update,
)
from .reference import filterpy_ekf, filterpy_kf, filterpy_ukf
from .smoothing import rts_smoother

__all__ = [  # fmt: skip
    "Chart", "GaussianRun", "extended_filter", "extended_predict", "extended_update",
    "filterpy_ekf", "filterpy_kf", "filterpy_ukf", "kalman_filter", "multiplicative_filter",
    "predict", "quaternion_chart", "rts_smoother", "unscented_filter", "unscented_predict",
    "unscented_update", "update",
]
