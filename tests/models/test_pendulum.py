"""The pendulum: both forms by their equations and on the manifold, length, energy, chart."""

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


def _path(step: float, form: str = "printed", start: np.ndarray = START) -> np.ndarray:
    """States at every 0.05 s over 10 s, (201, 4)."""
    model = pendulum(step=step, form=form)
    out = [start]
    for k in range(200):
        out.append(model.step(out[-1], 0.05 * k, 0.05))
    return np.array(out)


def test_the_printed_equations() -> None:
    x, y, u, v = s = np.array([0.3, -1.1, 0.7, 2.0])
    size = 1.4
    square = u**2 + v**2
    expected = [
        u,
        v,
        (-G * x * y - x * square) / size**2,
        (G * x**2 - y * square) / size**2,
    ]
    assert np.allclose(pendulum_rate(s, length=size), expected, atol=1e-13)
    pull = -(square + G * y) / size**2
    expected[2:] = [pull * x, G + pull * y]
    assert np.allclose(
        pendulum_rate(s, length=size, form="multiplier"), expected, atol=1e-13
    )


@pytest.mark.parametrize("form", ["printed", "multiplier"])
def test_both_forms_are_the_pendulum_on_the_manifold(form: str) -> None:
    q = np.random.default_rng(0).uniform(-3, 3, (50, 2))
    one = pendulum(length=1.3, form=form, step=0.001)
    other = pendulum_angle(length=1.3, step=0.001).step(q, 0.0, 0.5)
    moved = one.step(pendulum_states(q, length=1.3), 0.0, 0.5)
    assert np.abs(moved - pendulum_states(other, length=1.3)).max() < 1e-8


@pytest.mark.parametrize(
    ("step", "bound"), [(0.05, 4e-2), (0.01, 1e-4), (0.0025, 4e-7)]
)
def test_the_length_drifts_with_the_fourth_power_of_the_step(
    step: float, bound: float
) -> None:
    drift = np.abs(np.hypot(*_path(step)[:, :2].T) - 1).max()
    assert bound / 4 < drift < bound


def test_energy_is_kept() -> None:
    x = _path(0.0025, "multiplier")
    energy = 0.5 * (x[..., 2:] ** 2).sum(axis=-1) - 9.8 * x[..., 1]
    assert np.abs(energy - energy[0]).max() < 1e-6


def test_the_period_is_the_elliptic_integral_s() -> None:
    period = 4 * np.sqrt(2.5 / G) * ellipk(0.25)
    back = pendulum_angle(length=2.5, step=0.001).step([np.pi / 3, 0.0], 0.0, period)
    assert np.abs(back - [np.pi / 3, 0.0]).max() < 1e-9


def test_the_chart_and_back() -> None:
    q = np.random.default_rng(2).uniform(-3.1, 3.1, (40, 2))
    assert np.abs(pendulum_chart(pendulum_states(q, length=0.7)) - q).max() < 1e-12
    hang = pendulum_states([0.0, 0.0])
    assert np.allclose(hang, [0.0, 1.0, 0.0, 0.0])
    away = pendulum_states([[1.0, 2.0]]) * 3.0
    assert np.allclose(pendulum_chart(away), [[1.0, 2.0]])


def test_noise_and_names() -> None:
    model = pendulum(sigma=(0.1, 0.2))
    assert np.allclose(model.Q(0.0, 0.5), np.diag([0.005, 0.005, 0.02, 0.02]))
    chart = pendulum_angle(sigma=(0.1, 0.2))
    assert np.allclose(chart.Q(0.0, 0.5), np.diag([0.005, 0.02]))
    assert model.names == ("x", "y", "vx", "vy") and chart.units == ("rad", "rad/s")
    assert (pendulum().Q(0.0, 0.1) == 0).all()
