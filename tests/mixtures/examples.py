"""Mixtures that the tests of this folder share; none is diagonal or centred."""

from __future__ import annotations

import numpy as np

from distfilt.mixtures import GaussianMixture

TARGET = [0, 1]


def random_mixture(
    size: int, dim: int, seed: int, spread: float = 3.0
) -> GaussianMixture:
    """Full covariances of differing shape, uneven weights."""
    rng = np.random.default_rng(seed)
    roots = rng.standard_normal((size, dim, dim)) + 0.5 * np.eye(dim)
    covs = roots @ roots.mT + 0.2 * np.eye(dim)
    w = rng.dirichlet(np.full(size, 2.0))
    return GaussianMixture(w, spread * rng.standard_normal((size, dim)) + 1.0, covs)


def affine(
    p: GaussianMixture, matrix: np.ndarray, shift: np.ndarray
) -> GaussianMixture:
    """The same density in other coordinates."""
    return GaussianMixture.construct(
        p.weights.copy(), p.means @ matrix.T + shift, matrix @ p.covs @ matrix.T
    )


def shuffled(p: GaussianMixture, seed: int = 0) -> GaussianMixture:
    """The same density with its mixands in another order."""
    order = np.random.default_rng(seed).permutation(p.n_components)
    return GaussianMixture(p.weights[order], p.means[order], p.covs[order])


def same(a: GaussianMixture, b: GaussianMixture, tolerance: float = 1e-9) -> None:
    """Both have the same mixands, in whatever order."""
    assert a.n_components == b.n_components
    first, second = (
        np.array(
            sorted(
                np.c_[p.means, p.weights, p.covs.reshape(p.n_components, -1)]
                .round(12)
                .tolist()
            )
        )
        for p in (a, b)
    )
    np.testing.assert_allclose(
        first, second, rtol=tolerance, atol=tolerance * np.abs(second).max()
    )


def scales(dim: int, target_dim: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Another frame, in units of 1e-3 to 1e5 and far away; the target apart from the rest."""
    rng = np.random.default_rng(dim)
    matrix = rng.standard_normal((dim, dim)) + 2 * np.eye(dim)
    matrix[:target_dim, target_dim:] = matrix[target_dim:, :target_dim] = 0.0
    return np.geomspace(1e-3, 1e5, dim)[:, None] * matrix, 100 * rng.standard_normal(
        dim
    )
