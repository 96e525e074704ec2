"""Quaternions: scipy's rotations, rotation vectors and their inverse, derivatives."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from distfilt.derivatives import central_difference
from distfilt.models import cross_matrix, quaternion_rate, rotation_matrix
from distfilt.models.quaternions import (
    left_directions,
    rotate,
    rotation_vector_between,
)


def _random(seed: int, n: int = 50) -> tuple[np.ndarray, np.ndarray]:
    """Unit quaternions (n, 4) and vectors (n, 3)."""
    rng = np.random.default_rng(seed)
    q = rng.standard_normal((n, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return q, rng.standard_normal((n, 3))


@given(st.integers(0, 10_000))
def test_the_rotation_matrix_is_scipy_s_active_one(seed: int) -> None:
    """For a quaternion of any length."""
    q, _ = _random(seed)
    matrix = Rotation.from_quat(q, scalar_first=True).as_matrix()
    error = rotation_matrix(3 * q) - matrix
    assert np.abs(error).max() < 1e-13


@given(st.integers(0, 10_000))
def test_the_cross_matrix_times_a_vector_is_the_cross_product(seed: int) -> None:
    _, v = _random(seed)
    ones = np.ones(3)
    assert np.allclose(cross_matrix(v) @ ones, np.cross(v, ones))


@given(st.integers(0, 10_000))
def test_rotate_multiplies_the_active_matrix_from_the_left(seed: int) -> None:
    """R(rotate(q, θ)) = R(θ) R(q); the length of the quaternion is conserved."""
    q, angle = _random(seed)
    turn = Rotation.from_rotvec(angle).as_matrix()
    product = turn @ rotation_matrix(q)
    result = rotate(3 * q, angle)
    error = rotation_matrix(result) - product
    assert np.abs(error).max() < 1e-13
    lengths = np.linalg.norm(result, axis=1)
    assert np.abs(lengths - 3).max() < 1e-13


@given(st.integers(0, 10_000))
def test_the_rotation_vector_between_two_attitudes_inverts_rotate(seed: int) -> None:
    q, angle = _random(seed)
    # Unique for angles below π only: they are shortened to 3 rad.
    size = np.linalg.norm(angle, axis=1, keepdims=True)
    angle *= np.minimum(1, 3 / size)
    end = rotate(q, angle)
    # Neither the length nor the sign of a quaternion matters.
    for first, second in ((2 * q, end), (q, -end)):
        error = rotation_vector_between(first, second) - angle
        assert np.abs(error).max() < 1e-12
    assert np.abs(rotation_vector_between(q, q)).max() < 1e-15


def test_left_directions_are_the_derivative_of_rotate() -> None:
    """With respect to the rotation vector, at zero."""
    q, _ = _random(3, 5)
    for one in q:

        def turn(angle: np.ndarray, q: np.ndarray = one) -> np.ndarray:
            return rotate(q, angle)

        derivative = central_difference(turn, np.zeros(3))
        assert np.abs(left_directions(one) - derivative).max() < 1e-9


def test_equation_21_is_minus_the_left_directions_times_the_angular_velocity() -> None:
    """So that it conserves the length, and the active matrix changes by -[ω]R."""
    q, w = _random(3, 5)
    # q' = -½ ω q is a rotation by -ω from the left.
    rotation = left_directions(q) @ w[..., None]
    rate = -rotation[..., 0]
    assert np.abs(quaternion_rate(q, w) - rate).max() < 1e-15
