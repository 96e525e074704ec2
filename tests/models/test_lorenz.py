"""Lorenz's model against an adaptive rule, with its Jacobian."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp

from distfilt.linalg import central
from distfilt.models import lorenz63, lorenz63_rate

NAN = float("nan")
_L = "distfilt.models.lorenz."
BAD_INPUT = {
    _L + "lorenz63": [
        ("prandtl", lambda: lorenz63(prandtl=NAN)),
        ("rho", lambda: lorenz63(rho="28")),
        ("beta", lambda: lorenz63(beta=NAN)),
        ("sigma", lambda: lorenz63(sigma=-1.0)),
        ("step", lambda: lorenz63(step=0.0)),
        ("longest", lambda: lorenz63(step=1e-12).step([1.0, 2.0, 3.0], 0.0, 0.1)),
        ("x", lambda: lorenz63().step([1.0, 2.0], 0.0, 0.1)),
    ],
    _L + "lorenz63_rate": [
        ("x", lambda: lorenz63_rate([1.0, 2.0])),
        ("prandtl", lambda: lorenz63_rate([1.0, 2.0, 3.0], prandtl=NAN)),
        ("rho", lambda: lorenz63_rate([1.0, 2.0, 3.0], rho=NAN)),
        ("beta", lambda: lorenz63_rate([1.0, 2.0, 3.0], beta=NAN)),
    ],
}


def test_lorenz_agrees_with_an_adaptive_rule() -> None:
    """From twenty states near the attractor: close, and closer with the step's fourth power."""
    starts = np.array([1.5, -1.5, 25.5]) + np.random.default_rng(0).standard_normal((20, 3))

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        return lorenz63_rate(x.reshape(20, 3)).ravel()

    run = solve_ivp(rate, (0, 1), starts.ravel(), method="DOP853", rtol=1e-13, atol=1e-13)
    exact = run.y[:, -1].reshape(20, 3)
    steps = np.array([0.01, 0.005, 0.0025, 0.00125])
    gaps = [lorenz63(step=h).step(starts, 0.0, 1.0) - exact for h in steps]
    error = [np.sqrt((gap**2).mean()) for gap in gaps]
    assert error[-1] < 1e-7
    assert abs(np.polyfit(np.log(steps), np.log(error), 1)[0] - 4) < 0.3


def test_lorenz_noise() -> None:
    assert np.allclose(lorenz63(sigma=0.5).noise(0.0, 0.1), 0.025 * np.eye(3))
    assert not lorenz63().noise(0.0, 0.1).any()


def test_every_parameter_is_in_its_place() -> None:
    assert np.allclose(lorenz63_rate([1.0, 2.0, 3.0], prandtl=5.0, rho=7.0, beta=11.0), [5, 2, -31])
    x = np.array([1.0, 2.0, 3.0])
    small = 1e-6
    moved = lorenz63(prandtl=5.0, rho=7.0, beta=11.0).step(x, 0.0, small) - x
    assert np.allclose(moved / small, [5, 2, -31], rtol=1e-4)


def test_jacobian_is_that_of_the_integration() -> None:
    x = np.random.default_rng(1).standard_normal((5, 3)) * 8
    model = lorenz63(prandtl=9.0, rho=27.0, beta=2.5, step=0.03)
    numeric = central(lambda v: model.step(v, 0.0, 0.1), x)
    assert np.abs(model.jacobian(x, 0.0, 0.1) - numeric).max() < 1e-7
