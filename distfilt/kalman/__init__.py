"""Kalman filters for many runs at once: the linear one, its smoother, one on unit quaternions.

Filterpy's stand beside them as the reference. Extended and unscented filters are
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
