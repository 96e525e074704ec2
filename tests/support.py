"""What tests of several rooms share: random covariances, their comparison, and bad values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

NAN = float("nan")
INDEFINITE = [[1.0, 2.0], [2.0, 1.0]]
ASYMMETRIC = [[1.0, 0.5], [0.0, 1.0]]


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def spd(
    rng: np.random.Generator, d: int, leading: tuple[int, ...] = (), *, least: float = 0.1
) -> np.ndarray:
    """Random full covariances with eigenvalues above `least`."""
    a = rng.standard_normal((*leading, d, d))
    return a @ np.swapaxes(a, -1, -2) + least * np.eye(d)


def singular(
    rng: np.random.Generator, d: int, rank: int, leading: tuple[int, ...] = ()
) -> np.ndarray:
    """Random full covariances of the given rank."""
    a = rng.standard_normal((*leading, d, rank))
    cov = a @ np.swapaxes(a, -1, -2)
    return 0.5 * (cov + np.swapaxes(cov, -1, -2))


def unit_gap(found: np.ndarray, wanted: np.ndarray) -> float:
    """Largest difference of two covariances in units of the wanted standard deviations."""
    std = np.sqrt(np.diagonal(wanted, axis1=-2, axis2=-1))
    unit = np.where(std > 0, std, 1.0)
    return float((np.abs(found - wanted) / (unit[..., :, None] * unit[..., None, :])).max())


def assert_unchanged(call: Callable[..., object], *arrays: np.ndarray) -> None:
    """Call with arrays that may not be written, and compare them before and after."""
    before = [a.copy() for a in arrays]
    for a in arrays:
        a.flags.writeable = False
    call(*arrays)
    for a, b in zip(arrays, before, strict=True):
        np.testing.assert_array_equal(a, b)
