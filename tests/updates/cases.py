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
    lambda x: 0.5 * x.sum(axis=-1, keepdims=True),
    [-0.3],
    derivative=lambda x: np.full((*x.shape[:-1], 1, x.shape[-1]), 0.5),
)
"""A plane near the prior's mean, for any number of components."""
FRESH = partial(updates.etpf, rejuvenation=0.1)

UPDATES = {
    "enkf_sampled_covariance": updates.enkf_sampled_covariance,
    "enkf": updates.enkf,
    "enkf_exact": updates.enkf_exact,
    "square_root": updates.etkf,
    "transport": updates.transport_map_update,
    "principal_components": partial(
        updates.principal_components, n_state=2, n_observed=2
    ),
    "inflated": updates.with_inflation(updates.enkf, factor=1.1),
    "serial": updates.serially(updates.enkf),
    "localised": updates.with_localization(
        updates.enkf,
        places=np.zeros((3, 1)),
        observation_places=np.zeros((2, 1)),
        radius=9.0,
    ),
    "inflated serial": updates.with_inflation(
        updates.serially(updates.etkf), factor=1.01
    ),
    "ensemble_transform": FRESH,
    "ensemble_transform, corrected": partial(FRESH, correct=True),
    "augmented": updates.with_augmentation(updates.enkf, PLANE, std=0.5),
    "projected": updates.with_projection(updates.enkf, PLANE),
    "retracted": updates.with_retraction(updates.enkf, PLANE),
}


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


def members(n: int, *leading: int, seed: int = 0) -> np.ndarray:
    """Members (*leading, n, 3) of the case's prior."""
    rng = np.random.default_rng(seed)
    return MEAN + rng.standard_normal((*leading, n, 3)) @ np.linalg.cholesky(COV).T


def kalman(
    mean: np.ndarray, cov: np.ndarray, h: np.ndarray, r: np.ndarray, y: np.ndarray
):
    """The Kalman filter's update by its formulas."""
    gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + r)
    return mean + gain @ (y - h @ mean), (np.eye(len(mean)) - gain @ h) @ cov


def moments(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sample mean and covariance by numpy."""
    return x.mean(axis=0), np.cov(x.T)
