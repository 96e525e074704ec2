"""Satellites near a chief: exact transition and noise, the attitude's equations, the pose."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from distfilt.models import (
    clohessy_wiltshire,
    quaternion_rate,
    rotation_matrix,
    satellite,
    satellite_pose,
)

START = np.array([0.3, 0.2, 0.1, 1.0, 0.0, 0.0, 0.0])


@given(st.floats(1e-3, 0.5), st.floats(0, 20))
def test_transition_is_the_exponential_of_the_drift(rate: float, dt: float) -> None:
    # Φ(dt) = exp(A dt) for the linear equations x' = A x.
    closed = satellite._transition_matrix(dt, rate)
    exponential = expm(satellite._drift(rate) * dt)
    assert np.allclose(closed, exponential, rtol=1e-9, atol=1e-9)


def test_drift_of_a_geostationary_orbit_is_not_rounded() -> None:
    """Over a day: an entry of 1.6e-8 rounded to 15 decimals has a relative error of 1e-7."""
    rate = 7.2921159e-5
    drift = satellite._drift(rate)
    assert drift[3, 0] == 3 * rate * rate
    assert drift[5, 2] == -rate * rate
    day = 86_164.0
    closed = satellite._transition_matrix(day, rate)
    exponential = expm(drift * day)
    # In units of positions and of rate times positions, all entries are of order one.
    units = np.repeat([1.0, rate], 3)
    error = (closed - exponential) * units / units[:, None]
    assert np.abs(error).max() < 1e-10


def test_noise_of_two_half_steps_is_that_of_a_whole_step() -> None:
    """Φ Q Φᵀ + Q, as for any exact noise covariance."""
    model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    phi = model.F(0.05)
    q = model.Q(0.0, 0.05)
    two_steps = phi @ q @ phi.T + q
    assert np.allclose(two_steps, model.Q(0.0, 0.1), rtol=1e-12, atol=1e-16)
    # In a short step it is σ² dt.
    short = 1e-7
    expected = 0.2**2 * short * np.eye(6)
    assert np.allclose(model.Q(0.0, short), expected, atol=1e-14)


def _move_attitude(step: float, attitude: np.ndarray, dt: float) -> np.ndarray:
    """Move angular velocity and quaternion (7,) by the model of the pose."""
    model = satellite_pose(rate=0.1, sigma=0.2, step=step)
    state = np.concatenate([np.zeros(6), attitude])
    return model.step(state, 0.0, dt)[6:]


def _attitude_rate(t: float, attitude: np.ndarray) -> np.ndarray:
    """Equations (20) and (21) by the library's rotation matrix and quaternion rate."""
    w = attitude[:3]
    q = attitude[3:]
    # (20): ω × R(q) (0, 0, α)
    acceleration = np.cross(w, rotation_matrix(q) @ [0.0, 0.0, 0.1])
    return np.concatenate([acceleration, quaternion_rate(q, w)])


def test_the_attitude_is_integrated_at_the_order_of_runge_kutta() -> None:
    """The global error falls with the fourth power of the step, that of |q| at least as fast."""
    start = START * [10, 10, 10, 2, 2, 2, 2]
    solution = solve_ivp(
        _attitude_rate, (0, 20), start, method="DOP853", rtol=1e-13, atol=1e-14
    )
    exact = solution.y[:, -1]
    steps = np.array([0.4, 0.2, 0.1, 0.05])
    ends = [_move_attitude(h, start, 20.0) for h in steps]
    errors = [np.abs(end - exact).max() for end in ends]
    # |q| = 2 is conserved by (21), and not by the integrator.
    drifts = [abs(np.linalg.norm(end[3:]) - 2) for end in ends]
    log_steps = np.log(steps)
    order, _ = np.polyfit(log_steps, np.log(errors), 1)
    drift_order, _ = np.polyfit(log_steps, np.log(drifts), 1)
    assert abs(order - 4) < 0.15
    assert drift_order > 3.85


def test_the_angular_speed_is_conserved() -> None:
    """By (20) the angular acceleration is orthogonal to the angular velocity."""
    end = _move_attitude(0.01, START, 5.0)
    speed = np.linalg.norm(end[:3])
    assert np.isclose(speed, np.linalg.norm(START[:3]), rtol=1e-9)


def test_the_pose_is_translation_and_attitude() -> None:
    """Neither acts on the other, in any of the leading axes."""
    x = np.random.default_rng(0).standard_normal((4, 5, 13))
    pose = satellite_pose(rate=0.1, sigma=0.2)
    orbit = clohessy_wiltshire(rate=0.1, sigma=0.2)
    result = pose.step(x, 0.0, 0.1)
    translation = orbit.step(x[..., :6], 0.0, 0.1)
    assert np.allclose(result[..., :6], translation, atol=1e-14)
    attitude = _move_attitude(0.01, x[2, 1, 6:], 0.1)
    assert np.allclose(result[2, 1, 6:], attitude, atol=1e-14)


def test_noise_of_the_pose() -> None:
    """That of the translation, σ² dt on the angular velocity, and none on the quaternion."""
    q = satellite_pose(rate=0.1, sigma=0.2).Q(0.0, 0.1)
    orbit = clohessy_wiltshire(rate=0.1, sigma=0.2)
    assert np.allclose(q[:6, :6], orbit.Q(0.0, 0.1))
    assert not q[:6, 6:].any()
    # 0.2² · 0.1 = 0.004 on each angular velocity
    expected = np.diag([0.004] * 3 + [0.0] * 4)
    assert np.allclose(q[6:, 6:], expected)
