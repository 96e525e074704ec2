"""A linear Gaussian case with a full noise matrix, for every update; all updates by name."""

from __future__ import annotations

from functools import partial

import numpy as np

from distfilt import updates
from distfilt.coupling import Constraint

H = np.array([[1.0, 0.0, 0.5], [0.0, 2.0, -1.0]])
R = np.array([[0.5, 0.3], [0.3, 0.9]])
Y = np.array([1.2, -0.7])
MEAN = np.array([1.0, -2.0, 0.5])
COV = np.array([[2.0, 0.6, 0.2], [0.6, 1.0, -0.3], [0.2, -0.3, 0.7]])

PLANE = Constraint(
    lambda x: 0.5 * x.sum(axis=-1, keepdims=True), [-0.3],
    derivative=lambda x: np.full((*x.shape[:-1], 1, x.shape[-1]), 0.5),
)  # fmt: skip
"""A plane near the prior's mean, for any number of components."""
FRESH = partial(updates.ensemble_transform, rejuvenation=0.1)

UPDATES = {
    "sampled_noise": updates.sampled_noise,
    "known_noise": updates.known_noise,
    "exact_draws": updates.exact_draws,
    "square_root": updates.square_root,
    "transport": updates.transport,
    "principal_components": partial(updates.principal_components, n_state=2, n_observed=2),
    "inflated": updates.inflated(updates.known_noise, factor=1.1),
    "serial": updates.serial(updates.known_noise),
    "localised": updates.localised(
        updates.known_noise, places=np.zeros((3, 1)), readings=np.zeros((2, 1)), radius=9.0
    ),
    "inflated serial": updates.inflated(updates.serial(updates.square_root), factor=1.01),
    "ensemble_transform": FRESH,
    "ensemble_transform, corrected": partial(FRESH, correct=True),
    "augmented": updates.augmented(updates.known_noise, PLANE, std=0.5),
    "projected": updates.projected(updates.known_noise, PLANE),
    "retracted": updates.retracted(updates.known_noise, PLANE),
}

def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


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
