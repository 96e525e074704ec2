"""Swarms: reflection, the rotating mixture, and the law of the agents."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.models import RotatingMixture, Swarm, rotating_swarm
from distfilt.models.swarm import _reflect

LOW = np.array([-1.0, 0.5])
HIGH = np.array([1.0, 2.0])
DIFFUSION = np.array([1e-4, 4e-4])


def _still(x: np.ndarray, t: float) -> np.ndarray:
    return 0 * x


@given(st.floats(-30, 30), st.floats(-30, 30))
def test_reflection_is_even_and_periodic(a: float, b: float) -> None:
    point = np.array([a, b])
    width = HIGH - LOW
    folded = _reflect(point, LOW, HIGH)
    assert (folded >= LOW).all()
    assert (folded <= HIGH).all()
    # Mirrored in either wall, or shifted by twice the box, a point folds to the same
    # place.
    for image in (2 * LOW - point, 2 * HIGH - point, point + 2 * width):
        error = _reflect(image, LOW, HIGH) - folded
        assert np.abs(error).max() < 1e-12 * 40


def test_points_inside_are_not_reflected() -> None:
    inside = LOW + 0.3 * (HIGH - LOW)
    folded = _reflect(inside, LOW, HIGH)
    assert np.abs(folded - inside).max() < 1e-14


@pytest.mark.parametrize("axis", [0, 1])
def test_the_score_is_the_gradient_of_the_log_density(axis: int) -> None:
    """By central differences along one axis."""
    f = RotatingMixture(components=3, radius=0.2, phase=0.4)
    x = np.random.default_rng(1).random((7, 2))
    h = 1e-6
    shift = h * np.eye(2)[axis]
    forward = np.log(f.density(x + shift, 2.0))
    backward = np.log(f.density(x - shift, 2.0))
    slope = (forward - backward) / (2 * h)
    score = f.score(x, 2.0)
    assert np.abs(slope - score[:, axis]).max() < 1e-6


def test_the_score_is_finite_where_the_density_underflows() -> None:
    f = RotatingMixture(variance=1e-5)
    assert f.density([0.0, 0.0], 0.0) == 0
    # ∇p / p would be 0 / 0; Σ r_l (m_l - x) / σ² with responsibilities r_l is not.
    assert np.isfinite(f.score([0.0, 0.0], 0.0)).all()


def test_components_move_on_the_circle() -> None:
    f = RotatingMixture()
    # After a quarter of a turn at 0.04 rad/s
    quarter = np.pi / 2 / 0.04
    assert np.allclose(f.means(quarter), [[0.5, 0.8], [0.5, 0.2]])
    # A phase is a shift in time.
    shifted = RotatingMixture(phase=0.3)
    assert np.allclose(shifted.means(1.0), f.means(1.0 + 0.3 / 0.04))
    # Three components are the corners of an equilateral triangle, of side √3 times the
    # radius.
    corners = RotatingMixture(components=3).means(1.0)
    edges = corners - corners[[1, 2, 0]]
    sides = np.linalg.norm(edges, axis=1)
    assert np.allclose(sides, 0.3 * np.sqrt(3))


def test_the_mixture_is_normalised() -> None:
    """The midpoint rule over a square that holds nearly all of its mass."""
    s = np.linspace(-1, 2, 301)
    x = np.stack(np.meshgrid(s, s, indexing="ij"), axis=-1)
    density = RotatingMixture().density(x, 5.0)
    mass = density.sum() * 0.01**2
    assert abs(mass - 1) < 1e-6


def test_a_simulation_begins_with_a_step() -> None:
    swarm = rotating_swarm()
    x = np.random.default_rng(2).random((5, 2))
    first = swarm.step(x, 2.0, 0.25, rng=np.random.default_rng(3))
    # The same random numbers
    states = swarm.simulate(x, [2.25, 2.5], rng=np.random.default_rng(3), t0=2.0)
    assert states.shape == (2, 5, 2)
    assert np.array_equal(states[0], first)


def test_agents_drift_and_spread_by_2_d_t_on_each_axis() -> None:
    """Rates that grow with time: Euler's ten steps of 0.2 s integrate t to 1.8 instead of 2."""
    swarm = Swarm(
        lambda x, t: 0 * x + 0.02 * t, lambda x, t: 0 * x + (1 + t) * DIFFUSION
    )
    n = 40_000
    start = np.full((n, 2), 0.5)
    x = swarm.step(start, 0.0, 2.0, rng=np.random.default_rng(4))
    # 2 D ∫(1 + t) dt = 2 D (2 + 1.8), within four standard errors of a variance
    ratio = x.var(axis=0) / (7.6 * DIFFUSION)
    assert np.abs(ratio - 1).max() < 4 * np.sqrt(2 / n)
    # The mean, within four standard errors of the wider axis
    shift = x.mean(axis=0) - 0.5
    standard_error = np.sqrt(30.4e-4 / n)
    assert np.abs(shift - 0.02 * 1.8).max() < 4 * standard_error


@pytest.mark.parametrize(
    "diffusion",
    [
        [0.02, 0.02],
        lambda x, t: 0.02 + 0 * x[..., 0],
        lambda x, t: 0.02 + 0 * x,
    ],
)
def test_a_diffusion_is_a_number_one_for_each_axis_or_a_function(
    diffusion: Any,
) -> None:
    """All forms give the step of the number, for as many agents as there are axes."""
    x = np.random.default_rng(5).random((2, 2))
    expected = Swarm(_still, 0.02).step(x, 0.0, 0.1, rng=np.random.default_rng(6))
    result = Swarm(_still, diffusion).step(x, 0.0, 0.1, rng=np.random.default_rng(6))
    assert np.abs(result - expected).max() < 1e-15


def test_a_diffusion_may_depend_on_the_position_and_the_axis() -> None:
    def diffusion(x: np.ndarray, t: float) -> np.ndarray:
        return np.stack([x[..., 0], 1 + x[..., 1]], axis=-1)

    x = np.random.default_rng(5).random((2, 2))
    swarm = Swarm(_still, diffusion)
    assert np.allclose(swarm.diffusion_at(x, 0.0), x + [0, 1])


def test_the_euler_maruyama_scheme_inflates_the_stationary_variance() -> None:
    """Of dx = -k (x - ½) dt + noise to D/k / (1 - k h/2), as the docstring of `step` has it."""
    k = 4.0
    d = 2e-3
    h = 0.2
    n = 40_000
    swarm = Swarm(lambda x, t: k * (0.5 - x), d, low=[0.0], high=[1.0])
    times = h * np.arange(1, 21)
    states = swarm.simulate(
        np.full((n, 1), 0.5), times, rng=np.random.default_rng(7), substeps=1
    )
    # x' = (1 - k h) x + √(2 D h) w has the variance v = (1 - k h)² v + 2 D h.
    expected = d / k / (1 - k * h / 2)
    # Within four standard errors of a variance
    ratio = states[-1].var() / expected
    assert abs(ratio - 1) < 4 * np.sqrt(2 / n)


@pytest.mark.parametrize(
    ("interpretation", "mobility", "diffusion"),
    [("literal", 0.2, 0.02), ("gibbs", 0.2, 0.2), ("slowgibbs", 0.02, 0.02)],
)
def test_interpretations_have_the_mobility_and_diffusion_of_their_definition(
    interpretation: str, mobility: float, diffusion: float
) -> None:
    """With s = 0.2: s or s²/2 = 0.02."""
    swarm = rotating_swarm(interpretation, strength=0.2)
    x = np.array([[0.3, 0.9]])
    drift = mobility * RotatingMixture().score(x, 1.0)
    assert np.allclose(swarm.drift_at(x, 1.0), drift)
    assert np.allclose(swarm.diffusion_at(x, 1.0), diffusion)
