"""The Clohessy-Wiltshire model: exact transition, exact noise."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from distfilt.models import satellite as sat

_S = "distfilt.models.satellite."
BAD_INPUT = {
    _S + "clohessy_wiltshire": [
        ("rate", lambda: sat.clohessy_wiltshire(rate=0.0, sigma=0.2)),
        ("sigma", lambda: sat.clohessy_wiltshire(rate=0.1, sigma=-0.2)),
    ],
    _S + "clohessy_wiltshire_drift": [("rate", lambda: sat.clohessy_wiltshire_drift(-1.0))],
    _S + "clohessy_wiltshire_transition": [
        ("rate", lambda: sat.clohessy_wiltshire_transition(0.0, 0.1)),
        ("dt", lambda: sat.clohessy_wiltshire_transition(0.1, -0.1)),
    ],
}


@given(st.floats(1e-3, 0.5), st.floats(0, 20))
def test_transition_is_the_exponential_of_the_drift(rate: float, dt: float) -> None:
    closed = sat.clohessy_wiltshire_transition(rate, dt)
    assert np.allclose(closed, expm(sat.clohessy_wiltshire_drift(rate) * dt), rtol=1e-9, atol=1e-9)


def test_transition_over_the_paper_s_step_to_rounding() -> None:
    closed = sat.clohessy_wiltshire_transition(0.1, 0.1)
    assert np.abs(closed - expm(sat.clohessy_wiltshire_drift(0.1) * 0.1)).max() < 1e-12


def test_drift_of_a_geostationary_orbit_keeps_its_digits() -> None:
    """Over a day: an entry of 1.6e-8 rounded to 15 decimals is off by 1e-7 of itself."""
    rate = 7.2921159e-5
    drift = sat.clohessy_wiltshire_drift(rate)
    assert drift[3, 0] == 3 * rate * rate and drift[5, 2] == -rate * rate
    day = 86_164.0
    closed, numeric = sat.clohessy_wiltshire_transition(rate, day), expm(drift * day)
    units = np.repeat([1.0, rate], 3)
    assert np.abs((closed - numeric) * units / units[:, None]).max() < 1e-10


@given(st.floats(0.01, 0.5), st.floats(0.01, 5), st.floats(0.01, 5))
def test_transitions_compose(rate: float, a: float, b: float) -> None:
    phi = sat.clohessy_wiltshire_transition
    assert np.allclose(phi(rate, a) @ phi(rate, b), phi(rate, a + b), rtol=1e-9, atol=1e-9)


def test_no_drift_along_a_closed_relative_orbit() -> None:
    """The 2:1 ellipse with vy = -2 n x comes back after a period."""
    rate = 0.1
    x0 = np.array([1.0, 0.0, 0.3, 0.0, -2 * rate, 0.0])
    model = sat.clohessy_wiltshire(rate=rate, sigma=0.2)
    assert np.allclose(model.step(x0, 0.0, 2 * np.pi / rate), x0, atol=1e-12)


def test_noise_is_exact_over_two_halves() -> None:
    model = sat.clohessy_wiltshire(rate=0.1, sigma=0.2)
    half, q = model.transition(0.05), model.noise(0.0, 0.05)
    assert np.allclose(half @ q @ half.T + q, model.noise(0.0, 0.1), rtol=1e-12)


def test_step_broadcasts_and_leaves_its_input() -> None:
    model = sat.clohessy_wiltshire(rate=0.1, sigma=0.2)
    x = np.random.default_rng(0).standard_normal((3, 4, 6))
    before = x.copy()
    moved = model.step(x, 0.0, 0.1)
    assert (x == before).all()
    assert np.allclose(moved[2, 1], model.step(x[2, 1], 0.0, 0.1), rtol=1e-13)
    assert np.allclose(moved[2, 1], model.transition(0.1) @ x[2, 1], rtol=1e-13)
