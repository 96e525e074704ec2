"""The pendulum: its two forms, the manifold, the length, the energy, and the chart."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ellipk

from distfilt.models import (
    pendulum,
    pendulum_angle,
    pendulum_chart,
    pendulum_rate,
    pendulum_states,
)

G = 9.8
START = np.array([np.sin(np.pi / 3), np.cos(np.pi / 3), 0.0, 0.0])


def _simulate(step: float, form: str = "printed") -> np.ndarray:
    """States at every 0.05 s over 10 s, (201, 4)."""
    model = pendulum(step=step, form=form)
    states = [START]
    for k in range(200):
        states.append(model.step(states[-1], 0.05 * k, 0.05))
    return np.array(states)


def test_rates_are_the_printed_equations_and_those_with_a_multiplier() -> None:
    """At a state off the circle, where the two forms differ."""
    state = np.array([0.3, -1.1, 0.7, 2.0])
    x, y, u, v = state
    length = 1.4
    square = u**2 + v**2
    # Equations (14) and (15) as printed
    ax = (-G * x * y - x * square) / length**2
    ay = (G * x**2 - y * square) / length**2
    printed = pendulum_rate(state, length=length)
    assert np.allclose(printed, [u, v, ax, ay], atol=1e-13)
    # q'' = g + λ q with λ = -(|v|² + g y)/L²
    multiplier = -(square + G * y) / length**2
    ax = multiplier * x
    ay = G + multiplier * y
    rate = pendulum_rate(state, length=length, form="multiplier")
    assert np.allclose(rate, [u, v, ax, ay], atol=1e-13)


@pytest.mark.parametrize("form", ["printed", "multiplier"])
def test_both_forms_are_the_pendulum_on_the_manifold(form: str) -> None:
    """A step in Cartesian coordinates is the step of the angle, mapped to them."""
    chart = np.random.default_rng(0).uniform(-3, 3, (50, 2))
    model = pendulum(length=1.3, form=form, step=0.001)
    states = pendulum_states(chart, length=1.3)
    result = model.step(states, 0.0, 0.5)
    moved = pendulum_angle(length=1.3, step=0.001).step(chart, 0.0, 0.5)
    expected = pendulum_states(moved, length=1.3)
    assert np.abs(result - expected).max() < 1e-8


@pytest.mark.parametrize(
    ("step", "bound"), [(0.05, 4e-2), (0.01, 1e-4), (0.0025, 4e-7)]
)
def test_the_length_drifts_with_the_fourth_power_of_the_step(
    step: float, bound: float
) -> None:
    positions = _simulate(step)[:, :2]
    lengths = np.linalg.norm(positions, axis=1)
    drift = np.abs(lengths - 1).max()
    # The bounds fall with about the fourth power of the step.
    assert bound / 4 < drift < bound


def test_energy_is_conserved() -> None:
    """½ |v|² - g y, since y points downwards."""
    states = _simulate(0.0025, "multiplier")
    kinetic = 0.5 * (states[:, 2:] ** 2).sum(axis=-1)
    energy = kinetic - G * states[:, 1]
    assert np.abs(energy - energy[0]).max() < 1e-6


def test_the_period_is_the_elliptic_integral_s() -> None:
    """From 60 degrees: 4 sqrt(L/g) K(sin²(30°)), after which the pendulum is back."""
    start = np.array([np.pi / 3, 0.0])
    period = 4 * np.sqrt(2.5 / G) * ellipk(0.25)
    end = pendulum_angle(length=2.5, step=0.001).step(start, 0.0, period)
    assert np.abs(end - start).max() < 1e-9


def test_the_chart_inverts_the_states() -> None:
    chart = np.random.default_rng(2).uniform(-3.1, 3.1, (40, 2))
    states = pendulum_states(chart, length=0.7)
    assert np.abs(pendulum_chart(states) - chart).max() < 1e-12
    # At rest it hangs at (0, L).
    assert np.allclose(pendulum_states([0.0, 0.0]), [0.0, 1.0, 0.0, 0.0])
    # Angle and rate do not depend on the length.
    scaled = 3.0 * pendulum_states([[1.0, 2.0]])
    assert np.allclose(pendulum_chart(scaled), [[1.0, 2.0]])


def test_noise_is_white_on_positions_and_velocities() -> None:
    """σ² dt, with one strength for positions and one for velocities; none by default."""
    model = pendulum(sigma=(0.1, 0.2))
    expected = np.diag([0.005, 0.005, 0.02, 0.02])
    assert np.allclose(model.Q(0.0, 0.5), expected)
    chart = pendulum_angle(sigma=(0.1, 0.2))
    assert np.allclose(chart.Q(0.0, 0.5), np.diag([0.005, 0.02]))
    assert (pendulum().Q(0.0, 0.1) == 0).all()


def test_names_and_units_of_both_models() -> None:
    assert pendulum().names == ("x", "y", "vx", "vy")
    assert pendulum_angle().units == ("rad", "rad/s")
