"""Swarms: reflection, the rotating mixture, and the law of the agents."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.models import RotatingMixture, Swarm, rotating_swarm
from distfilt.models.swarm import _reflect

CORNERS = [-1.0, 0.5], [1.0, 2.0]
RATES = np.array([1e-4, 4e-4])


def _still(x: np.ndarray, t: float) -> np.ndarray:
    return 0 * x


@given(st.floats(-30, 30), st.floats(-30, 30))
def test_reflection_is_even_and_periodic(a: float, b: float) -> None:
    low, high = (np.array(c) for c in CORNERS)
    width = high - low
    here = _reflect(np.array([a, b]), low, high)
    assert (here >= low).all() and (here <= high).all()
    # Mirrored in either wall, or moved by twice the box, a point folds to the same place.
    for other in (2 * low - [a, b], 2 * high - [a, b], np.array([a, b]) + 2 * width):
        assert np.abs(_reflect(other, low, high) - here).max() < 1e-12 * 40
    inside = low + width * 0.3
    assert np.abs(_reflect(inside, low, high) - inside).max() < 1e-14


def test_score_is_the_gradient_of_the_logarithm() -> None:
    f = RotatingMixture(components=3, radius=0.2, phase=0.4)
    x = np.random.default_rng(1).random((7, 2))
    h = 1e-6
    for k in range(2):
        step = h * np.eye(2)[k]
        slope = (
            np.log(f.density(x + step, 2.0)) - np.log(f.density(x - step, 2.0))
        ) / (2 * h)
        assert np.abs(slope - f.score(x, 2.0)[:, k]).max() < 1e-6


def test_score_far_away_is_finite() -> None:
    f = RotatingMixture(variance=1e-5)
    assert f.density([0.0, 0.0], 0.0) == 0
    assert np.isfinite(f.score([0.0, 0.0], 0.0)).all()


def test_mixture_goes_round() -> None:
    f = RotatingMixture()
    assert np.allclose(f.means(np.pi / 2 / 0.04), [[0.5, 0.8], [0.5, 0.2]])
    three = RotatingMixture(components=3).means(1.0)
    assert np.allclose(
        np.linalg.norm(three - three[[1, 2, 0]], axis=1), 0.3 * np.sqrt(3)
    )
    shifted = RotatingMixture(phase=0.3)
    assert np.allclose(shifted.means(1.0), f.means(1.0 + 0.3 / 0.04))
    # Its integral over the plane is one.
    s = np.linspace(-1, 2, 301)
    x = np.stack(np.meshgrid(s, s, indexing="ij"), axis=-1)
    assert abs(f.density(x, 5.0).sum() * 0.01**2 - 1) < 1e-6


def test_a_path_begins_with_a_step() -> None:
    swarm = rotating_swarm()
    x = np.random.default_rng(2).random((5, 2))
    moved = swarm.step(x, 2.0, 0.25, rng=np.random.default_rng(3))
    path = swarm.simulate(x, [2.25, 2.5], rng=np.random.default_rng(3), t0=2.0)
    assert np.array_equal(path[0], moved) and path.shape == (2, 5, 2)


def test_agents_drift_and_spread_by_2_d_t_on_each_axis() -> None:
    """Of rates that grow with time Euler's rule adds what its ten steps find: of t, 1.8 in 2 s."""
    swarm = Swarm(lambda x, t: 0 * x + 0.02 * t, lambda x, t: 0 * x + (1 + t) * RATES)
    x = swarm.step(np.full((40_000, 2), 0.5), 0.0, 2.0, rng=np.random.default_rng(4))
    # Four standard errors of a variance of 40 000 draws.
    assert np.abs(x.var(axis=0) / (7.6 * RATES) - 1).max() < 4 * np.sqrt(2 / 40_000)
    assert np.abs(x.mean(axis=0) - 0.5 - 0.02 * 1.8).max() < 4 * np.sqrt(
        30.4e-4 / 40_000
    )


def test_numbers_and_functions_of_place_mean_the_same() -> None:
    x = np.random.default_rng(5).random((2, 2))  # as many agents as coordinates
    forms = [
        0.02,
        [0.02, 0.02],
        lambda x, t: 0.02 + 0 * x[..., 0],
        lambda x, t: 0.02 + 0 * x,
    ]
    steps = [
        Swarm(_still, f).step(x, 0.0, 0.1, rng=np.random.default_rng(6)) for f in forms
    ]
    for other in steps[1:]:
        assert np.abs(other - steps[0]).max() < 1e-15
    apart = Swarm(_still, lambda x, t: np.stack([x[..., 0], 1 + x[..., 1]], axis=-1))
    assert np.allclose(apart.diffusion_at(x, 0.0), x + [0, 1])


def test_euler_and_maruyama_inflate_the_variance_as_said() -> None:
    # v = -k x about the middle: the stationary variance is D/k / (1 - k h / 2).
    k = 4.0
    d = 2e-3
    h = 0.2
    swarm = Swarm(lambda x, t: k * (0.5 - x), d, low=[0.0], high=[1.0])
    x = swarm.simulate(
        np.full((40_000, 1), 0.5),
        np.arange(1, 21) * h,
        rng=np.random.default_rng(7),
        substeps=1,
    )[-1]
    wanted = d / k / (1 - k * h / 2)
    assert abs(x.var() / wanted - 1) < 4 * np.sqrt(2 / 40_000)


@pytest.mark.parametrize(
    ("reading", "mobility", "diffusion"),
    [("literal", 0.2, 0.02), ("gibbs", 0.2, 0.2), ("slowgibbs", 0.02, 0.02)],
)
def test_readings_are_the_published_numbers(
    reading: str, mobility: float, diffusion: float
) -> None:
    swarm = rotating_swarm(reading, strength=0.2)
    x = np.array([[0.3, 0.9]])
    assert np.allclose(
        swarm.drift_at(x, 1.0), mobility * RotatingMixture().score(x, 1.0)
    )
    assert np.allclose(swarm.diffusion_at(x, 1.0), diffusion)
