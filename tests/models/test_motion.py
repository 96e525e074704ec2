"""Runge-Kutta's rule, straight motion, Lorenz's model: closed forms and other integrators."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from distfilt.models import constant_velocity, lorenz63, rk4


@pytest.mark.parametrize("longest", [None, 0.5, 0.34])
def test_rk4_is_batched_and_exact_for_cubics_in_time(longest: float | None) -> None:
    # Without x in the rate the rule is Simpson's, which is exact up to degree three.
    x = np.zeros((3, 2))
    # The integral of 4 t³ from 1 to 2 is 2⁴ - 1⁴ = 15.
    result = rk4(lambda x, t: np.full_like(x, 4 * t**3), x, 1.0, 1.0, longest=longest)
    assert np.allclose(result, 15.0, atol=1e-12)
    # The states of the caller are unchanged.
    assert not x.any()


@pytest.mark.parametrize(
    ("dt", "longest", "steps"),
    [
        (1.0, None, 1),
        (1.0, 2.0, 1),
        (1.0, 0.5, 2),
        (1.0, 0.4, 3),
        (0.1, 0.01, 10),
        (0.0, 0.1, 1),
    ],
)
def test_an_interval_is_divided_into_the_fewest_steps(
    dt: float, longest: float | None, steps: int
) -> None:
    """By the times of the rate's calls, four a step, and by the result of dx/dt = -x."""
    times = []

    def rate(x: np.ndarray, t: float) -> np.ndarray:
        times.append(t)
        return -x

    result = rk4(rate, [1.0], 3.0, dt, longest=longest)
    h = dt / steps
    assert len(times) == 4 * steps
    assert np.allclose(times[::4], 3.0 + h * np.arange(steps))
    # Each step multiplies by the series of exp(-h) to the fourth order.
    factor = 1 - h + h**2 / 2 - h**3 / 6 + h**4 / 24
    assert np.allclose(result, factor**steps, rtol=1e-14)


BUFFER = np.empty(2)


@pytest.mark.parametrize(
    "rate",
    [
        # One array for all results; the states themselves; a copy of the changed
        # states.
        lambda x, t: np.multiply(x, -np.cos(t), out=BUFFER),
        lambda x, t: np.multiply(x, -np.cos(t), out=x),
        lambda x, t: np.multiply(x, -np.cos(t), out=x).copy(),
    ],
)
def test_a_rate_may_work_in_place(rate: Callable[..., np.ndarray]) -> None:
    x = np.array([1.0, -2.0])
    expected = rk4(lambda x, t: -x * np.cos(t), x, 0.0, 1.0, longest=0.5)
    assert (rk4(rate, x, 0.0, 1.0, longest=0.5) == expected).all()
    assert (x == [1.0, -2.0]).all()


@pytest.mark.parametrize(
    "rate", [np.int64(1), np.float32(0.5)], ids=["integers", "half"]
)
def test_a_rate_of_another_type_does_not_round_the_states(rate: np.generic) -> None:
    """The 1e-12 would vanish in single precision."""
    start = np.array([1.0 + 1e-12, 2.0])
    result = rk4(lambda x, t: np.full(x.shape, rate), start, 0.0, 1.0, longest=0.25)
    assert np.allclose(result, start + float(rate), rtol=0, atol=1e-15)


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_straight_motion(axes: int) -> None:
    model = constant_velocity(sigma=0.3, axes=axes)
    position = np.arange(1.0, 1 + axes)
    velocity = np.arange(axes) - 0.5
    result = model.step(np.concatenate([position, velocity]), 0.0, 2.0)
    # p + 2 v, and the same v
    assert np.allclose(result[:axes], position + 2 * velocity)
    assert np.allclose(result[axes:], velocity)
    # σ² (dt³/3, dt²/2; dt²/2, dt) with dt = 2 on each axis
    exact = np.kron([[8 / 3, 2.0], [2.0, 2.0]], 0.09 * np.eye(axes))
    assert np.allclose(model.Q(0.0, 2.0), exact)


def test_names_and_units_of_straight_motion() -> None:
    model = constant_velocity(sigma=0.3, axes=3)
    assert model.names == ("x", "y", "z", "vx", "vy", "vz")
    assert model.units == ("m", "m", "m", "m/s", "m/s", "m/s")


def _lorenz_rate(t: float, states: np.ndarray) -> np.ndarray:
    """Lorenz's equations of twenty states in one vector, for scipy's integrator."""
    x, y, z = states.reshape(20, 3).T
    x_rate = 10 * (y - x)
    y_rate = x * (28 - z) - y
    z_rate = x * y - 8 / 3 * z
    return np.stack([x_rate, y_rate, z_rate], axis=-1).ravel()


def test_lorenz_s_model_converges_to_an_adaptive_integrator() -> None:
    """From twenty states near the attractor, with the fourth power of the step."""
    rng = np.random.default_rng(0)
    centre = np.array([1.5, -1.5, 25.5])
    starts = centre + rng.standard_normal((20, 3))
    solution = solve_ivp(
        _lorenz_rate, (0, 1), starts.ravel(), method="DOP853", rtol=1e-13, atol=1e-13
    )
    exact = solution.y[:, -1].reshape(20, 3)
    steps = np.array([0.01, 0.005, 0.0025, 0.00125])
    errors = []
    for h in steps:
        result = lorenz63(step=h).step(starts, 0.0, 1.0)
        difference = result - exact
        errors.append(np.sqrt((difference**2).mean()))
    assert errors[-1] < 1e-7
    # The order is the slope of the error in logarithmic scales.
    order, _ = np.polyfit(np.log(steps), np.log(errors), 1)
    assert abs(order - 4) < 0.3


def test_noise_of_lorenz_s_model() -> None:
    """σ² dt on each component, and none by default."""
    noisy = lorenz63(sigma=0.5)
    assert np.allclose(noisy.Q(0.0, 0.1), 0.025 * np.eye(3))
    assert not lorenz63().Q(0.0, 0.1).any()
