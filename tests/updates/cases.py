"""A linear Gaussian case with a full noise matrix, for every update; all updates by name."""

from __future__ import annotations

from functools import partial

import numpy as np

from distfilt.updates import (
    centred,
    exact_draws,
    gated,
    inflated,
    informed_directions,
    known_noise,
    principal_components,
    sampled_noise,
    serial,
    square_root,
    transport,
    transport_sample,
)

H = np.array([[1.0, 0.0, 0.5], [0.0, 2.0, -1.0]])
R = np.array([[0.5, 0.3], [0.3, 0.9]])
Y = np.array([1.2, -0.7])
MEAN = np.array([1.0, -2.0, 0.5])
COV = np.array([[2.0, 0.6, 0.2], [0.6, 1.0, -0.3], [0.2, -0.3, 0.7]])

UPDATES = {
    "sampled_noise": sampled_noise,
    "known_noise": known_noise,
    "shrunk": partial(known_noise, shrinkage=0.1, ridge=0.05),
    "exact_draws": exact_draws,
    "square_root": square_root,
    "transport": transport,
    "transport_sample": transport_sample,
    "principal_components": partial(principal_components, n_state=2, n_observed=2),
    "informed_directions": informed_directions,
    "inflated": inflated(known_noise, factor=1.1),
    "gated": gated(known_noise),
    "centred": centred(known_noise),
    "serial": serial(known_noise),
    "inflated gated serial": inflated(gated(serial(square_root)), factor=1.01),
}
CONSISTENT = [
    "sampled_noise", "known_noise", "exact_draws", "square_root", "transport", "transport_sample",
    "informed_directions", "gated", "centred", "serial",
]
"""Those whose moments tend to the Kalman filter's."""


def members(n: int, *leading: int, seed: int = 0) -> np.ndarray:
    """Members (*leading, n, 3) of the case's prior."""
    rng = np.random.default_rng(seed)
    return MEAN + rng.standard_normal((*leading, n, 3)) @ np.linalg.cholesky(COV).T


def kalman(mean: np.ndarray, cov: np.ndarray, h: np.ndarray, r: np.ndarray, y: np.ndarray):
    """The Kalman filter's update by its formulas."""
    gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + r)
    return mean + gain @ (y - h @ mean), (np.eye(len(mean)) - gain @ h) @ cov


def moments(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sample mean and covariance by numpy."""
    return x.mean(axis=0), np.cov(x.T)
