"""Models: exact transitions, exact noise, trajectories."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from distfilt.models import LinearModel, Model, simulate
from distfilt.models import satellite as sat


def _walk(dim: int = 1) -> Model:
    return Model(dim, lambda x, t, dt: x, lambda t, dt: dt * np.eye(dim))


def _rng() -> np.random.Generator:
    return np.random.default_rng(0)


_M = "distfilt.models.base."
_S = "distfilt.models.satellite."
BAD_INPUT = {
    _M + "Model": [
        ("dim", lambda: Model(0, lambda x, t, dt: x, lambda t, dt: np.eye(1))),
        ("flow", lambda: Model(1, 3, lambda t, dt: np.eye(1))),
        ("noise_covariance", lambda: Model(1, lambda x, t, dt: x, np.eye(1))),
        ("names", lambda: Model(1, lambda x, t, dt: x, lambda t, dt: np.eye(1), ("a", "b"))),
        ("units", lambda: Model(2, lambda x, t, dt: x, lambda t, dt: np.eye(2), (), ("m",))),
        ("noise_covariance", lambda: Model(1, lambda x, t, dt: x, lambda t, dt: -np.eye(1)).noise(
            0.0, 1.0)),
        ("flow", lambda: Model(1, lambda x, t, dt: x[0], lambda t, dt: np.eye(1)).step(
            [[1.0]], 0.0, 1.0)),
        ("x", lambda: _walk().step([1.0, 2.0], 0.0, 1.0)),
        ("x", lambda: _walk().step([float("nan")], 0.0, 1.0)),
        ("dt", lambda: _walk().step([1.0], 0.0, -1.0)),
        ("t", lambda: _walk().noise(float("inf"), 1.0)),
        ("rng", lambda: _walk().sample_step([1.0], 0.0, 1.0, rng=1)),
    ],
    _M + "LinearModel": [
        ("transition_matrix", lambda: LinearModel.from_transition(1, np.eye(1), lambda t, dt: 1)),
        ("transition_matrix", lambda: LinearModel(1, lambda x, t, dt: x, lambda t, dt: np.eye(1))
            .transition(0.1)),
        ("dt", lambda: sat.clohessy_wiltshire(rate=0.1, sigma=0.2).transition(-1.0)),
    ],
    _M + "simulate": [
        ("x0", lambda: simulate(_walk(), [1.0, 2.0], [1.0], rng=_rng())),
        ("times", lambda: simulate(_walk(), [1.0], [2.0, 1.0], rng=_rng())),
        ("times", lambda: simulate(_walk(), [1.0], [0.0], rng=_rng())),
        ("rng", lambda: simulate(_walk(), [1.0], [1.0], rng=3)),
        ("t0", lambda: simulate(_walk(), [1.0], [1.0], rng=_rng(), t0=float("nan"))),
    ],
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
    x = _rng().standard_normal((3, 4, 6))
    before = x.copy()
    moved = model.step(x, 0.0, 0.1)
    assert (x == before).all()
    assert np.allclose(moved[2, 1], model.step(x[2, 1], 0.0, 0.1), rtol=1e-13)


def test_simulated_covariance_grows_as_the_noise_says() -> None:
    """The sample variance of 4000 walks lies in its 99.9% chi-square band."""
    from scipy.stats import chi2

    path = simulate(_walk(), np.zeros((4000, 1)), [0.5, 2.0], rng=_rng())
    for k, t in enumerate((0.5, 2.0)):
        statistic = (path[k] ** 2).sum() / t
        low, high = chi2.ppf([5e-4, 1 - 5e-4], 4000)
        assert low < statistic < high


def test_simulation_depends_on_the_seed_alone() -> None:
    model = sat.clohessy_wiltshire(rate=0.1, sigma=0.2)
    paths = [simulate(model, np.ones((2, 6)), [0.1, 0.2], rng=_rng()) for _ in range(2)]
    assert (paths[0] == paths[1]).all()
    assert paths[0].shape == (2, 2, 6)


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_a_model_without_noise(dt: float) -> None:
    model = sat.clohessy_wiltshire(rate=0.1, sigma=0.0)
    x = np.arange(6.0)
    assert (model.sample_step(x, 0.0, dt, rng=_rng()) == model.step(x, 0.0, dt)).all()
