"""Straight motion and turns against closed forms, with no gap at a turn rate of zero."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from distfilt.linalg import central
from distfilt.models import LinearModel, constant_velocity, coordinated_turn

NAN = float("nan")
_M = "distfilt.models.motion."
BAD_INPUT = {
    _M + "constant_velocity": [
        ("sigma", lambda: constant_velocity(sigma=-1.0)),
        ("axes", lambda: constant_velocity(sigma=1.0, axes=4)),
        ("axes", lambda: constant_velocity(sigma=1.0, axes=0)),
        ("x", lambda: constant_velocity(sigma=1.0).step([1.0, 2.0], 0.0, 1.0)),
    ],
    _M + "coordinated_turn": [
        ("sigma", lambda: coordinated_turn(sigma=-1.0, rate=0.1)),
        ("sigma", lambda: coordinated_turn(sigma=NAN, turn_sigma=0.1)),
        ("rate", lambda: coordinated_turn(sigma=1.0, rate=NAN)),
        ("rate", lambda: coordinated_turn(sigma=1.0)),
        ("rate", lambda: coordinated_turn(sigma=1.0, rate=0.1, turn_sigma=0.1)),
        ("turn_sigma", lambda: coordinated_turn(sigma=1.0, turn_sigma=-0.1)),
        ("x", lambda: coordinated_turn(sigma=1.0, turn_sigma=0.1).step([1.0] * 4, 0.0, 1.0)),
    ],
}


def _turn_drift(omega: float) -> np.ndarray:
    a = np.zeros((4, 4))
    a[0, 2] = a[1, 3] = 1.0
    a[2, 3], a[3, 2] = -omega, omega
    return a


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_straight_motion(axes: int) -> None:
    model = constant_velocity(sigma=0.3, axes=axes)
    p, v = np.arange(1.0, 1 + axes), np.arange(axes) - 0.5
    assert np.allclose(model.step([*p, *v], 0.0, 2.0), [*(p + 2 * v), *v])
    q = model.noise(0.0, 2.0)
    # The integral of the noise's response, by components: 0.09 (8/3, 4/2; 4/2, 2).
    assert np.allclose(q[:axes, :axes], 0.09 * 8 / 3 * np.eye(axes))
    assert np.allclose(q[axes:, :axes], 0.09 * 2.0 * np.eye(axes))
    assert np.allclose(q[axes:, axes:], 0.09 * 2.0 * np.eye(axes))
    assert model.names == (*"xyz"[:axes], *(f"v{k}" for k in "xyz"[:axes]))
    assert model.units == ("m",) * axes + ("m/s",) * axes


@given(st.floats(-3, 3), st.floats(0, 3))
def test_known_turn_is_the_exponential_of_its_drift(omega: float, dt: float) -> None:
    model = coordinated_turn(sigma=0.2, rate=omega)
    assert isinstance(model, LinearModel)
    assert np.abs(model.transition(dt) - expm(_turn_drift(omega) * dt)).max() < 1e-12


@pytest.mark.parametrize("omega", [-1.3, 0.7, 2.0])
def test_noise_in_a_turn_in_closed_form(omega: float) -> None:
    """Complex numbers for the plane: S = (exp(iτ) - 1) / iω, R = exp(iτ), integrated by hand."""
    dt, sigma = 0.8, 0.3
    tau = omega * dt
    pp = 2 * (tau - np.sin(tau)) / omega**3
    pv = (1 - np.cos(tau)) / omega**2 - 1j * (tau - np.sin(tau)) / omega**2
    q = coordinated_turn(sigma=sigma, rate=omega).noise(0.0, dt)
    block = np.array([[pv.real, -pv.imag], [pv.imag, pv.real]])
    assert np.allclose(q[:2, :2], sigma**2 * pp * np.eye(2), rtol=1e-9)
    assert np.allclose(q[:2, 2:], sigma**2 * block, rtol=1e-9, atol=1e-12)
    assert np.allclose(q[2:, 2:], sigma**2 * dt * np.eye(2), rtol=1e-9)


@given(st.floats(-2, 2), st.floats(0.01, 2))
def test_estimated_turn_moves_along_the_circle(omega: float, dt: float) -> None:
    model = coordinated_turn(sigma=0.2, turn_sigma=0.1)
    x = np.array([1.0, -2.0, 3.0, 0.5, omega])
    moved = model.step(x, 0.0, dt)
    assert np.abs(moved[:4] - expm(_turn_drift(omega) * dt) @ x[:4]).max() < 1e-12
    assert moved[4] == omega and np.isclose(np.hypot(*moved[2:4]), np.hypot(3.0, 0.5))


def test_the_limit_at_no_turn_is_straight_motion() -> None:
    turn, straight = coordinated_turn(sigma=0.2, turn_sigma=0.1), constant_velocity(sigma=0.2)
    x = np.array([1.0, -2.0, 3.0, 0.5])
    for omega in (0.0, 1e-300, -1e-12, 1e-8):
        moved = turn.step([*x, omega], 0.0, 1.5)[:4]
        assert np.abs(moved - straight.step(x, 0.0, 1.5)).max() < 1e-6 * abs(omega) ** 0.1 + 1e-15
        known = coordinated_turn(sigma=0.2, rate=omega)
        assert np.allclose(known.noise(0.0, 1.5), straight.noise(0.0, 1.5), atol=1e-7)
    exact = turn.step([*x, 0.0], 0.0, 1.5)[:4]
    assert (exact == straight.step(x, 0.0, 1.5)).all()
    slope = turn.jacobian([*x, 0.0], 0.0, 1.5)
    # dx/dω at zero: dt²/2 times the velocity turned left, and dt times it.
    assert np.allclose(slope[:4, 4], [-1.125 * 0.5, 1.125 * 3.0, -1.5 * 0.5, 1.5 * 3.0])


@given(st.floats(-4, 4), st.floats(0.01, 2), st.integers(0, 1000))
def test_the_turn_s_jacobian_is_its_derivative(omega: float, dt: float, seed: int) -> None:
    model = coordinated_turn(sigma=0.2, turn_sigma=0.1)
    x = np.random.default_rng(seed).standard_normal((3, 5))
    x[:, 4] = omega
    numeric = central(lambda v: model.step(v, 0.0, dt), x)
    assert np.abs(model.jacobian(x, 0.0, dt) - numeric).max() < 1e-8


def test_noise_of_the_estimated_turn() -> None:
    q = coordinated_turn(sigma=0.2, turn_sigma=0.1).noise(0.0, 2.0)
    assert np.allclose(q[:4, :4], constant_velocity(sigma=0.2).noise(0.0, 2.0))
    assert np.isclose(q[4, 4], 0.02) and not q[4, :4].any()
