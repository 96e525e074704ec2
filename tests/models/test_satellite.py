"""Satellites near a chief: exact transition and noise; what turns, what is kept, derivatives."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import distfilt.models as att
from distfilt.linalg import central_difference
from distfilt.models import satellite as sat
from distfilt.models.quaternions import left_directions, rotate, rotation_vector_between

START = np.array([0.3, 0.2, 0.1, 1.0, 0.0, 0.0, 0.0])


@given(st.floats(1e-3, 0.5), st.floats(0, 20))
def test_transition_is_the_exponential_of_the_drift(rate: float, dt: float) -> None:
    closed = sat._transition_matrix(dt, rate)
    assert np.allclose(closed, expm(sat._drift(rate) * dt), rtol=1e-9, atol=1e-9)


def test_drift_of_a_geostationary_orbit_keeps_its_digits() -> None:
    """Over a day: an entry of 1.6e-8 rounded to 15 decimals is off by 1e-7 of itself."""
    rate = 7.2921159e-5
    drift = sat._drift(rate)
    assert drift[3, 0] == 3 * rate * rate and drift[5, 2] == -rate * rate
    day = 86_164.0
    closed = sat._transition_matrix(day, rate)
    numeric = expm(drift * day)
    units = np.repeat([1.0, rate], 3)
    assert np.abs((closed - numeric) * units / units[:, None]).max() < 1e-10


def test_noise_is_exact_over_two_halves() -> None:
    model = sat.clohessy_wiltshire(rate=0.1, sigma=0.2)
    half = model.F(0.05)
    q = model.Q(0.0, 0.05)
    assert np.allclose(half @ q @ half.T + q, model.Q(0.0, 0.1), rtol=1e-12)
    assert np.allclose(model.Q(0.0, 1e-7), 0.2**2 * 1e-7 * np.eye(6), atol=1e-14)


def _random(seed: int, n: int = 50) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q = rng.standard_normal((n, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True), rng.standard_normal((n, 3))


@given(st.integers(0, 10_000))
def test_rotation_matrix_is_the_active_one(seed: int) -> None:
    q, v = _random(seed)
    theirs = Rotation.from_quat(q, scalar_first=True).as_matrix()
    assert np.abs(att.rotation_matrix(3 * q) - theirs).max() < 1e-13
    assert np.allclose(att.cross_matrix(v) @ np.ones(3), np.cross(v, np.ones(3)))


@given(st.integers(0, 10_000))
def test_turned_rotates_the_active_matrix_from_the_left(seed: int) -> None:
    q, angle = _random(seed)
    rotated = Rotation.from_rotvec(angle).as_matrix() @ att.rotation_matrix(q)
    assert np.abs(att.rotation_matrix(rotate(3 * q, angle)) - rotated).max() < 1e-13
    lengths = np.linalg.norm(rotate(3 * q, angle), axis=1)
    assert np.abs(lengths - 3).max() < 1e-13


@given(st.integers(0, 10_000))
def test_turn_between_undoes_turned(seed: int) -> None:
    q, angle = _random(seed)
    angle *= np.minimum(1, 3 / np.linalg.norm(angle, axis=1, keepdims=True))
    there = rotate(q, angle)
    assert np.abs(rotation_vector_between(2 * q, there) - angle).max() < 1e-12
    assert np.abs(rotation_vector_between(q, -there) - angle).max() < 1e-12
    assert np.abs(rotation_vector_between(q, q)).max() < 1e-15


def test_left_directions_are_the_derivative_of_turned_and_of_equation_21() -> None:
    """So (21) keeps the length and turns the active matrix by -[w]R, as `turned` does."""
    q, w = _random(3, 5)
    for one in q:
        numeric = central_difference(lambda e, one=one: rotate(one, e), np.zeros(3))
        assert np.abs(left_directions(one) - numeric).max() < 1e-9
    rate = -(left_directions(q) @ w[..., None])[..., 0]
    assert np.abs(att.quaternion_rate(q, w) - rate).max() < 1e-15


def _body(step: float, x: np.ndarray, dt: float) -> np.ndarray:
    """The attitude alone, moved by the model of both."""
    model = att.satellite_pose(rate=0.1, sigma=0.2, step=step)
    return model.step(np.concatenate([np.zeros(6), x]), 0.0, dt)[6:]


def test_the_attitude_moves_by_equations_20_and_21_at_the_order_of_the_rule() -> None:
    """Over a fixed time: the global error of rk4 falls with the fourth power, or faster for |q|."""
    start = START * [10, 10, 10, 2, 2, 2, 2]

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        turning = att.rotation_matrix(x[3:]) @ [0.0, 0.0, 0.1]
        return np.concatenate(
            [np.cross(x[:3], turning), att.quaternion_rate(x[3:], x[:3])]
        )

    exact = solve_ivp(rate, (0, 20), start, method="DOP853", rtol=1e-13, atol=1e-14).y[
        :, -1
    ]
    steps = np.array([0.4, 0.2, 0.1, 0.05])
    ends = [_body(h, start, 20.0) for h in steps]
    error = [np.abs(x - exact).max() for x in ends]
    drift = [abs(np.linalg.norm(x[3:]) - 2) for x in ends]
    assert abs(np.polyfit(np.log(steps), np.log(error), 1)[0] - 4) < 0.15
    assert np.polyfit(np.log(steps), np.log(drift), 1)[0] > 3.85
    speed = np.linalg.norm(_body(0.01, START, 5.0)[:3])
    assert np.isclose(speed, np.linalg.norm(START[:3]), rtol=1e-9)


def test_pose_is_translation_and_attitude() -> None:
    x = np.random.default_rng(0).standard_normal((4, 5, 13))
    pose, orbit = (
        f(rate=0.1, sigma=0.2) for f in (att.satellite_pose, att.clohessy_wiltshire)
    )
    moved = pose.step(x, 0.0, 0.1)
    assert np.allclose(moved[..., :6], orbit.step(x[..., :6], 0.0, 0.1), atol=1e-14)
    assert np.allclose(moved[2, 1, 6:], _body(0.01, x[2, 1, 6:], 0.1), atol=1e-14)
    q = pose.Q(0.0, 0.1)
    assert np.allclose(q[:6, :6], orbit.Q(0.0, 0.1)) and not q[:6, 6:].any()
    assert np.allclose(q[6:, 6:], np.diag([0.004] * 3 + [0.0] * 4))
