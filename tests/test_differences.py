"""Central differences: the order of their error, values that wrap, components of any size."""

from __future__ import annotations

import numpy as np

from distfilt.linalg import central
from distfilt.sensors import wrap


def test_a_matrix_is_its_own_derivative() -> None:
    a = np.random.default_rng(0).standard_normal((2, 3))
    x = np.random.default_rng(1).standard_normal((4, 5, 3))
    slope = central(lambda v: v @ a.T, x)
    assert slope.shape == (4, 5, 2, 3) and np.abs(slope - a).max() < 1e-9


def test_values_that_wrap_and_large_components() -> None:
    slope = central(wrap, np.array([np.pi, 3.0]), lambda a, b: wrap(a - b))
    assert np.abs(slope - np.eye(2)).max() < 1e-9
    assert np.abs(central(lambda x: 2 * x, np.array([1e9])) - 2).max() < 1e-9
