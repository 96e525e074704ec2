"""Kalman filters for many runs at once: linear, with its smoother, and on unit quaternions.

The filters of filterpy serve as a reference. Extended and unscented filters are
:class:`distfilt.filters.GaussianFilter`, of one agent or of many.
"""

from .linear import FilterResult, kalman_filter, rts_smoother
from .multiplicative import QuaternionChart, mekf
from .reference import filterpy_ekf, filterpy_kf, filterpy_ukf

__all__ = [
    "FilterResult",
    "QuaternionChart",
    "filterpy_ekf",
    "filterpy_kf",
    "filterpy_ukf",
    "kalman_filter",
    "mekf",
    "rts_smoother",
]
