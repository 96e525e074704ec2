"""Attitude and pose: what is conserved, what rotates what, and the derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import distfilt.models as att
from distfilt.linalg import central
from distfilt.models import clohessy_wiltshire

NAN = float("nan")
START = np.array([0.3, 0.2, 0.1, 1.0, 0.0, 0.0, 0.0])
_Q = [1.0, 0.0, 0.0, 0.0]
_W = [0.3, 0.2, 0.1]
_A = "distfilt.models.attitude."
_R = "distfilt.models.rotations."


BAD_INPUT = {
    _R + "cross_matrix": [
        ("vector", lambda: att.cross_matrix([1.0, 2.0])),
        ("vector", lambda: att.cross_matrix([1.0, 2.0, NAN])),
    ],
    _R + "rotation_matrix": [
        ("quaternion", lambda: att.rotation_matrix([1.0, 0.0, 0.0])),
        ("quaternion", lambda: att.rotation_matrix(np.zeros(4))),
    ],
    _R + "quaternion_rate": [
        ("quaternion", lambda: att.quaternion_rate(np.zeros(4), _W)),
        ("angular_velocity", lambda: att.quaternion_rate(_Q, [1.0])),
        ("angular_velocity", lambda: att.quaternion_rate(np.ones((2, 4)), _W)),
    ],
    _A + "angular_acceleration": [
        ("quaternion", lambda: att.angular_acceleration([NAN] * 4, _W, rate=0.1)),
        ("angular_velocity", lambda: att.angular_acceleration(_Q, [0.1], rate=0.1)),
        ("rate", lambda: att.angular_acceleration(_Q, _W, rate=-0.1)),
    ],
    _A + "attitude": [
        ("rate", lambda: att.attitude(rate=0.0, sigma=0.2)),
        ("sigma", lambda: att.attitude(rate=0.1, sigma=-0.2)),
        ("step", lambda: att.attitude(rate=0.1, sigma=0.2, step=0.0)),
        ("x", lambda: att.attitude(rate=0.1, sigma=0.2).step([1.0], 0.0, 0.1)),
    ],
    _A + "satellite_pose": [
        ("rate", lambda: att.satellite_pose(rate=-1.0, sigma=0.2)),
        ("sigma", lambda: att.satellite_pose(rate=0.1, sigma=NAN)),
        ("step", lambda: att.satellite_pose(rate=0.1, sigma=0.2, step=-0.1)),
        ("x", lambda: att.satellite_pose(rate=0.1, sigma=0.2).step(START, 0.0, 0.1)),
    ],
    _R + "left_directions": [("quaternion", lambda: att.left_directions(np.zeros(4)))],
    _R + "turned": [
        ("quaternion", lambda: att.turned(np.zeros(4), _W)),
        ("angle", lambda: att.turned(_Q, [1.0])),
    ],
    _R + "turn_between": [
        ("quaternion", lambda: att.turn_between([1.0], _Q)),
        ("quaternion", lambda: att.turn_between(_Q, np.zeros(4))),
    ],
}


def _random(seed: int, n: int = 50) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q = rng.standard_normal((n, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True), rng.standard_normal((n, 3))


@given(st.integers(0, 10_000))
def test_equation_21_keeps_the_length(seed: int) -> None:
    q, w = _random(seed)
    assert np.abs((q * att.quaternion_rate(q, w)).sum(axis=1)).max() < 1e-15


@given(st.integers(0, 10_000))
def test_rotation_matrix_is_the_active_one(seed: int) -> None:
    q, v = _random(seed)
    theirs = Rotation.from_quat(q, scalar_first=True).as_matrix()
    assert np.abs(att.rotation_matrix(3 * q) - theirs).max() < 1e-13
    assert np.allclose(att.cross_matrix(v) @ np.ones(3), np.cross(v, np.ones(3)))


def _turned(q: np.ndarray, w: np.ndarray, h: float) -> np.ndarray:
    return q + h * att.quaternion_rate(q, w)


def test_equation_21_belongs_to_the_active_rotation() -> None:
    """The derivative of R is -[ω]R for the active R, and far from it for its transpose."""
    q, w = _random(1)
    h = 1e-5
    ahead, behind = (att.rotation_matrix(_turned(q, w, s * h)) for s in (1, -1))
    derivative = (ahead - behind) / (2 * h)
    active = att.rotation_matrix(q)
    passive = np.swapaxes(active, 1, 2)
    good = derivative + att.cross_matrix(w) @ active
    bad = np.swapaxes(derivative, 1, 2) + att.cross_matrix(w) @ passive
    assert np.abs(good).max() < 1e-8
    assert np.abs(bad).max() > 1


def test_angular_acceleration_is_equation_20() -> None:
    q, w = _random(2)
    turning = att.rotation_matrix(q) @ np.array([0.0, 0.0, 0.1])
    expected = (att.cross_matrix(w) @ turning[..., None])[..., 0]
    assert np.abs(att.angular_acceleration(q, w, rate=0.1) - expected).max() < 1e-15


def test_length_drifts_at_the_order_of_the_rule() -> None:
    """Over a fixed time: the global error of rk4 falls with the fourth power, or faster for |q|."""
    steps = np.array([0.4, 0.2, 0.1, 0.05])
    model = [att.attitude(rate=0.1, sigma=0.0, step=h) for h in steps]
    exact = solve_ivp(
        lambda t, x: np.concatenate([
            att.angular_acceleration(x[3:], x[:3], rate=0.1), att.quaternion_rate(x[3:], x[:3])
        ]),
        (0, 20), START * [10, 10, 10, 1, 1, 1, 1], method="DOP853", rtol=1e-13, atol=1e-14,
    ).y[:, -1]
    ends = [m.step(START * [10, 10, 10, 1, 1, 1, 1], 0.0, 20.0) for m in model]
    error = [np.abs(x - exact).max() for x in ends]
    drift = [abs(np.linalg.norm(x[3:]) - 1) for x in ends]
    assert abs(np.polyfit(np.log(steps), np.log(error), 1)[0] - 4) < 0.15
    assert np.polyfit(np.log(steps), np.log(drift), 1)[0] > 3.85


def test_the_paper_s_step_and_a_ten_times_longer_one_agree() -> None:
    fine, coarse = (att.attitude(rate=0.1, sigma=0.0, step=h) for h in (0.01, 0.1))
    assert np.abs(fine.step(START, 0.0, 20.0) - coarse.step(START, 0.0, 20.0)).max() < 1e-7


def test_speed_of_rotation_in_the_hill_frame_is_constant_and_noise_drives_it_only() -> None:
    model = att.attitude(rate=0.1, sigma=0.2)
    x = model.step(START, 0.0, 5.0)
    assert np.isclose(np.linalg.norm(x[:3]), np.linalg.norm(START[:3]), rtol=1e-9)
    assert np.allclose(model.noise(0.0, 0.1), np.diag([0.004] * 3 + [0.0] * 4))


def test_pose_is_translation_and_attitude() -> None:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((4, 5, 13))
    pose = att.satellite_pose(rate=0.1, sigma=0.2)
    orbit, body = clohessy_wiltshire(rate=0.1, sigma=0.2), att.attitude(rate=0.1, sigma=0.2)
    moved = pose.step(x, 0.0, 0.1)
    assert np.allclose(moved[..., :6], orbit.step(x[..., :6], 0.0, 0.1), atol=1e-14)
    assert np.allclose(moved[..., 6:], body.step(x[..., 6:], 0.0, 0.1), atol=1e-14)
    q = pose.noise(0.0, 0.1)
    assert np.allclose(q[:6, :6], orbit.noise(0.0, 0.1)) and not q[:6, 6:].any()
    assert np.allclose(q[6:, 6:], body.noise(0.0, 0.1))


@given(st.integers(0, 10_000))
def test_turned_rotates_the_active_matrix_from_the_left(seed: int) -> None:
    q, angle = _random(seed)
    rotated = Rotation.from_rotvec(angle).as_matrix() @ att.rotation_matrix(q)
    assert np.abs(att.rotation_matrix(att.turned(3 * q, angle)) - rotated).max() < 1e-13
    lengths = np.linalg.norm(att.turned(3 * q, angle), axis=1)
    assert np.abs(lengths - 3).max() < 1e-13


@given(st.integers(0, 10_000))
def test_turn_between_undoes_turned(seed: int) -> None:
    q, angle = _random(seed)
    angle *= np.minimum(1, 3 / np.linalg.norm(angle, axis=1, keepdims=True))
    there = att.turned(q, angle)
    assert np.abs(att.turn_between(2 * q, there) - angle).max() < 1e-12
    assert np.abs(att.turn_between(q, -there) - angle).max() < 1e-12
    assert np.abs(att.turn_between(q, q)).max() < 1e-15


def test_left_directions_are_the_derivative_of_turned_and_of_equation_21() -> None:
    q, w = _random(3, 5)
    for one in q:
        numeric = central(lambda e, one=one: att.turned(one, e), np.zeros(3))
        assert np.abs(att.left_directions(one) - numeric).max() < 1e-9
    rate = -(att.left_directions(q) @ w[..., None])[..., 0]
    assert np.abs(att.quaternion_rate(q, w) - rate).max() < 1e-15


@pytest.mark.parametrize("seed", range(3))
def test_the_pose_s_jacobian_is_that_of_its_step(seed: int) -> None:
    """Off the unit sphere and with large rates too, through several substeps."""
    x = np.random.default_rng(seed).standard_normal((3, 13))
    model = att.satellite_pose(rate=0.1, sigma=0.2, step=0.04)
    slope = model.jacobian(x, 0.0, 0.1)
    numeric = central(lambda v: model.step(v, 0.0, 0.1), x)
    assert np.abs(slope - numeric).max() < 1e-8 * max(1.0, np.abs(slope).max())
    body = att.attitude(rate=0.1, sigma=0.2, step=0.04)
    assert np.array_equal(body.jacobian(x[:, 6:], 0.0, 0.1), slope[:, 6:, 6:])
    assert not slope[:, :6, 6:].any() and not slope[:, 6:, :6].any()
