"""A linear Gaussian case with a full noise covariance, and all updates by name."""

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
REJUVENATED = partial(updates.etpf, rejuvenation=0.1)
"""An update by transport whose members are not all averages of the prior's."""

UPDATES = {
    "enkf_sampled_covariance": updates.enkf_sampled_covariance,
    "enkf": updates.enkf,
    "enkf_exact": updates.enkf_exact,
    "etkf": updates.etkf,
    "transport_map_update": updates.transport_map_update,
    "principal_components": partial(
        updates.principal_components, n_state=2, n_observed=2
    ),
    "with_inflation": updates.with_inflation(updates.enkf, factor=1.1),
    "serially": updates.serially(updates.enkf),
    "with_localization": updates.with_localization(
        updates.enkf,
        places=np.zeros((3, 1)),
        observation_places=np.zeros((2, 1)),
        radius=9.0,
    ),
    "with_inflation, serially": updates.with_inflation(
        updates.serially(updates.etkf), factor=1.01
    ),
    "etpf": REJUVENATED,
    "etpf, correct": partial(REJUVENATED, correct=True),
    "with_augmentation": updates.with_augmentation(updates.enkf, PLANE, std=0.5),
    "with_projection": updates.with_projection(updates.enkf, PLANE),
    "with_retraction": updates.with_retraction(updates.enkf, PLANE),
}
CONSTRAINED = ("with_augmentation", "with_projection", "with_retraction")
"""Updates that bring members near the plane, which has units and an origin of its own."""


def rng(seed: int = 1) -> np.random.Generator:
    """Return a generator."""
    return np.random.default_rng(seed)


def members(n: int, *leading: int, seed: int = 0) -> np.ndarray:
    """Draw members (*leading, n, 3) of the case's prior."""
    normal = rng(seed).standard_normal((*leading, n, 3))
    return MEAN + normal @ np.linalg.cholesky(COV).T


def kalman(
    mean: np.ndarray, cov: np.ndarray, h: np.ndarray, r: np.ndarray, y: np.ndarray
):
    """Return the Kalman filter's posterior mean and covariance by its formulas."""
    # K = P Hᵀ (H P Hᵀ + R)⁻¹
    innovation_cov = h @ cov @ h.T + r
    gain = cov @ h.T @ np.linalg.inv(innovation_cov)
    posterior_mean = mean + gain @ (y - h @ mean)
    posterior_cov = (np.eye(len(mean)) - gain @ h) @ cov
    return posterior_mean, posterior_cov


def moments(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the sample mean and covariance by numpy."""
    return x.mean(axis=0), np.cov(x.T)
