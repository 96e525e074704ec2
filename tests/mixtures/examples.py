"""Mixtures that several tests use; none is diagonal or centred."""

from __future__ import annotations

import numpy as np

from distfilt.mixtures import GaussianMixture

TARGET = [0, 1]


def random_mixture(
    size: int, dim: int, seed: int, spread: float = 3.0
) -> GaussianMixture:
    """Full covariances of differing shape, uneven weights."""
    rng = np.random.default_rng(seed)
    # Covariances R Rᵀ + 0.2 I are positive definite.
    roots = rng.standard_normal((size, dim, dim)) + 0.5 * np.eye(dim)
    covs = roots @ roots.mT + 0.2 * np.eye(dim)
    weights = rng.dirichlet(np.full(size, 2.0))
    means = spread * rng.standard_normal((size, dim)) + 1.0
    return GaussianMixture(weights, means, covs)


def transform(
    p: GaussianMixture, matrix: np.ndarray, shift: np.ndarray
) -> GaussianMixture:
    """The density of A x + b: means A m + b, covariances A P Aᵀ."""
    means = p.means @ matrix.T + shift
    covs = matrix @ p.covs @ matrix.T
    return GaussianMixture.construct(p.weights.copy(), means, covs)


def shuffle(p: GaussianMixture, seed: int = 0) -> GaussianMixture:
    """The same density with its components in another order."""
    order = np.random.default_rng(seed).permutation(p.n_components)
    return GaussianMixture(p.weights[order], p.means[order], p.covs[order])


def assert_same(
    a: GaussianMixture, b: GaussianMixture, tolerance: float = 1e-9
) -> None:
    """Both have the same components, in any order."""
    assert a.n_components == b.n_components
    first = sort_components(a)
    second = sort_components(b)
    absolute = tolerance * np.abs(second).max()
    np.testing.assert_allclose(first, second, rtol=tolerance, atol=absolute)


def sort_components(p: GaussianMixture) -> np.ndarray:
    """Rows of means, weights and covariances, sorted by the rounded mean."""
    # Rounding first: equal components of two mixtures are sorted alike.
    rows = np.c_[p.means, p.weights, p.covs.reshape(p.n_components, -1)]
    return np.array(sorted(rows.round(12).tolist()))


def random_frame(dim: int, target_dim: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Matrix and shift of other coordinates, in units of 1e-3 to 1e5 and far from the origin.

    Target and ego components are not mixed.
    """
    rng = np.random.default_rng(dim)
    matrix = rng.standard_normal((dim, dim)) + 2 * np.eye(dim)
    matrix[:target_dim, target_dim:] = 0.0
    matrix[target_dim:, :target_dim] = 0.0
    units = np.geomspace(1e-3, 1e5, dim)
    shift = 100 * rng.standard_normal(dim)
    return units[:, None] * matrix, shift
