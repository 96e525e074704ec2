"""Kalman filters: exact and batched, filterpy's as a reference, ensemble and particle filters."""

from .ensemble import EnsembleRun, enkf, enkf_filter
from .linear import GaussianRun, kalman_filter, predict, update
from .particle import (
    ParticleRun,
    Particles,
    effective_size,
    particle_filter,
    resample,
    systematic,
)
from .reference import filterpy_ekf, filterpy_kf, filterpy_ukf

__all__ = [
    "EnsembleRun",
    "GaussianRun",
    "ParticleRun",
    "Particles",
    "effective_size",
    "enkf",
    "enkf_filter",
    "filterpy_ekf",
    "filterpy_kf",
    "filterpy_ukf",
    "kalman_filter",
    "particle_filter",
    "predict",
    "resample",
    "systematic",
    "update",
]
