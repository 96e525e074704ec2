"""Samples that the tests of this folder share."""

from __future__ import annotations

import numpy as np


def rng_of(seed: int = 0) -> np.random.Generator:
    """Return a generator."""
    return np.random.default_rng(seed)


def samples(
    seed: int, n: int = 60, m: int = 2, d: int = 3, leading: tuple[int, ...] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Draw correlated, shifted, badly scaled samples (y, x)."""
    rng = rng_of(seed)
    size = m + d
    units = np.logspace(-1, 1, size)
    mixing = rng.standard_normal((size, size)) * units
    z = rng.standard_normal((*leading, n, size)) @ mixing
    z += 10 * rng.standard_normal(size)
    return z[..., :m], z[..., m:]


def banana(
    seed: int, n: int = 400, leading: tuple[int, ...] = ()
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw members on a parabola: noisy observations of x_2, members, and their normals."""
    u = rng_of(seed).standard_normal((*leading, n, 3))
    first = u[..., 0]
    second = 0.5 * u[..., 1] + first**2
    x = np.stack([first, second], axis=-1)
    y = x[..., 1:] + 0.3 * u[..., 2:]
    return y, x, u[..., :2]
