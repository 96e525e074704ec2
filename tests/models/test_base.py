"""Models: steps, noise with the stated covariance, Jacobians, trajectories."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from distfilt.models import LinearModel, Model, simulate
from distfilt.models.satellite import clohessy_wiltshire

NAN = float("nan")
# Full, of several components, and with no symmetry that a transposed factor could hide behind.
FULL = np.array([[4.0, 1.2, -0.6], [1.2, 1.0, 0.3], [-0.6, 0.3, 0.5]])


def _walk(dim: int = 1) -> Model:
    return Model(dim, lambda x, t, dt: x, lambda t, dt: dt * np.eye(dim))


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def _no(t: float, dt: float) -> np.ndarray:
    return np.eye(1)


_M = "distfilt.models.base."
BAD_INPUT = {
    _M + "Model": [
        ("dim", lambda: Model(0, lambda x, t, dt: x, _no)),
        ("flow", lambda: Model(1, 3, _no)),
        ("noise_cov", lambda: Model(1, lambda x, t, dt: x, np.eye(1))),
        ("derivative", lambda: Model(1, lambda x, t, dt: x, _no, derivative=np.eye(1))),
        ("names", lambda: Model(1, lambda x, t, dt: x, _no, names=("a", "b"))),
        ("names", lambda: Model(1, lambda x, t, dt: x, _no, names="a")),
        ("units", lambda: Model(2, lambda x, t, dt: x, _no, units=("m",))),
        ("units", lambda: Model(1, lambda x, t, dt: x, _no, units=(1,))),
        ("noise_cov", lambda: Model(1, lambda x, t, dt: x, lambda t, dt: -np.eye(1)).noise(
            0.0, 1.0)),
        ("noise_cov", lambda: Model(1, lambda x, t, dt: x, lambda t, dt: np.eye(1)[None]).noise(
            0.0, 1.0)),
        ("noise_cov", lambda: Model(1, lambda x, t, dt: x, lambda t, dt: -np.eye(1)).sample_step(
            [0.0], 0.0, 1.0, rng=_rng())),
        ("flow", lambda: Model(1, lambda x, t, dt: x[0], _no).step([[1.0]], 0.0, 1.0)),
        ("flow", lambda: Model(1, lambda x, t, dt: x[0], _no).jacobian([[1.0]], 0.0, 1.0)),
        ("derivative", lambda: Model(
            2, lambda x, t, dt: x, _no, derivative=lambda x, t, dt: np.eye(3)
        ).jacobian([1.0, 2.0], 0.0, 1.0)),
        ("x", lambda: _walk().step([1.0, 2.0], 0.0, 1.0)),
        ("x", lambda: _walk().step([NAN], 0.0, 1.0)),
        ("x", lambda: _walk().jacobian([NAN], 0.0, 1.0)),
        ("dt", lambda: _walk().step([1.0], 0.0, -1.0)),
        ("dt", lambda: _walk().jacobian([1.0], 0.0, -1.0)),
        ("t", lambda: _walk().noise(float("inf"), 1.0)),
        ("rng", lambda: _walk().sample_step([1.0], 0.0, 1.0, rng=1)),
    ],
    _M + "LinearModel": [
        ("transition_matrix", lambda: LinearModel.from_transition(1, np.eye(1), _no)),
        ("transition_matrix", lambda: LinearModel(
            1, lambda x, t, dt: x, _no, transition_matrix=None)),
        ("transition_matrix", lambda: LinearModel.from_transition(
            1, lambda dt: np.eye(2), _no).step([1.0], 0.0, 1.0)),
        ("dt", lambda: clohessy_wiltshire(rate=0.1, sigma=0.2).transition(-1.0)),
    ],
    _M + "simulate": [
        ("model", lambda: simulate(3, [1.0], [1.0], rng=_rng())),
        ("x0", lambda: simulate(_walk(), [1.0, 2.0], [1.0], rng=_rng())),
        ("times", lambda: simulate(_walk(), [1.0], [2.0, 1.0], rng=_rng())),
        ("times", lambda: simulate(_walk(), [1.0], [0.0], rng=_rng())),
        ("rng", lambda: simulate(_walk(), [1.0], [1.0], rng=3)),
        ("t0", lambda: simulate(_walk(), [1.0], [1.0], rng=_rng(), t0=NAN)),
    ],
}


def _in_place(x: np.ndarray, t: float, dt: float) -> np.ndarray:
    x += dt
    return x


def test_a_flow_that_works_in_place_leaves_the_caller_s_states() -> None:
    model = Model(2, _in_place, lambda t, dt: np.zeros((2, 2)))
    x = np.ones((3, 2))
    assert (model.step(x, 0.0, 0.5) == 1.5).all() and (x == 1.0).all()
    assert (model.sample_step(x, 0.0, 0.5, rng=_rng()) == 1.5).all() and (x == 1.0).all()
    assert np.abs(model.jacobian(x, 0.0, 0.5) - np.eye(2)).max() < 1e-9 and (x == 1.0).all()
    path = simulate(model, x, [1.0, 2.0], rng=_rng())
    assert (path[0] == 2.0).all() and (path[1] == 3.0).all() and (x == 1.0).all()


def test_a_step_never_hands_back_the_caller_s_array() -> None:
    x = np.ones((3, 2))
    assert not np.shares_memory(_walk(2).step(x, 0.0, 1.0), x)


def test_noise_cannot_be_changed_through_what_it_returns() -> None:
    q = FULL.copy()
    model = Model(3, lambda x, t, dt: x, lambda t, dt: q)
    assert not model.noise(0.0, 1.0).flags.writeable
    assert not np.shares_memory(model.noise(0.0, 1.0), q)


def test_a_wrong_shape_is_named() -> None:
    with pytest.raises(ValueError, match=r"flow: .*\(4, 2\).*\(2,\)"):
        Model(2, lambda x, t, dt: x[0], lambda t, dt: np.eye(2)).step(np.ones((4, 2)), 0.0, 1.0)


@pytest.mark.parametrize("door", ["sample_step", "simulate"])
def test_drawn_noise_has_the_full_covariance(door: str) -> None:
    """A transposed factor has another covariance: each entry lies in its 99.99% band."""
    model = Model(3, lambda x, t, dt: x, lambda t, dt: dt * FULL)
    n = 40_000
    if door == "simulate":
        draws = simulate(model, np.zeros((n, 3)), [0.5], rng=_rng(1))[0]
    else:
        draws = model.sample_step(np.zeros((n, 3)), 0.0, 0.5, rng=_rng(1))
    truth = 0.5 * FULL
    error = np.sqrt((truth**2 + np.outer(truth.diagonal(), truth.diagonal())) / n)
    assert (np.abs(draws.T @ draws / n - truth) < 3.9 * error).all()
    transposed = np.linalg.cholesky(truth).T @ np.linalg.cholesky(truth)
    assert (np.abs(transposed - truth) > 10 * error).any()


def test_noise_of_another_time_and_step_is_drawn_with_its_own_factor() -> None:
    model = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[(1 + t) ** 2 * dt]]))
    one, other, longer = (
        model.sample_step([0.0], t, dt, rng=_rng(2))[0]
        for t, dt in ((0.0, 1.0), (2.0, 1.0), (0.0, 4.0))
    )
    assert other == pytest.approx(3 * one) and longer == pytest.approx(2 * one)


def test_simulated_covariance_grows_as_the_noise_says() -> None:
    """The sample variance of 4000 walks lies in its 99.9% chi-square band."""
    path = simulate(_walk(), np.zeros((4000, 1)), [0.5, 2.0], rng=_rng())
    for k, t in enumerate((0.5, 2.0)):
        low, high = chi2.ppf([5e-4, 1 - 5e-4], 4000)
        assert low < (path[k] ** 2).sum() / t < high


def test_simulation_passes_the_times_on() -> None:
    seen = []

    def flow(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        seen.append((t, dt))
        return x

    model = Model(1, flow, lambda t, dt: seen.append((t, dt)) or np.zeros((1, 1)))
    simulate(model, [0.0], [1.5, 4.0], rng=_rng(), t0=1.0)
    assert seen == [(1.0, 0.5)] * 2 + [(1.5, 2.5)] * 2


def test_simulation_depends_on_the_seed_alone() -> None:
    model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    paths = [simulate(model, np.ones((2, 6)), [0.1, 0.2], rng=_rng()) for _ in range(2)]
    assert (paths[0] == paths[1]).all() and paths[0].shape == (2, 2, 6)
    assert simulate(model, np.ones(6), [], rng=_rng()).shape == (0, 6)


def test_jacobian_by_differences_given_and_of_a_matrix() -> None:
    def flow(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        return np.stack([x[..., 0] * x[..., 1], np.sin(x[..., 0]) + t + dt], axis=-1)

    def exact(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        out = np.zeros((*x.shape, 2))
        out[..., 0, 0], out[..., 0, 1] = x[..., 1], x[..., 0]
        out[..., 1, 0] = np.cos(x[..., 0])
        return out

    x = _rng().standard_normal((4, 3, 2))
    model = Model(2, flow, lambda t, dt: np.eye(2))
    slope = model.jacobian(x, 0.3, 0.1)
    assert slope.shape == (4, 3, 2, 2) and np.abs(slope - exact(x, 0.3, 0.1)).max() < 1e-9
    given = Model(2, flow, lambda t, dt: np.eye(2), derivative=exact)
    assert (given.jacobian(x, 0.3, 0.1) == exact(x, 0.3, 0.1)).all()
    orbit = clohessy_wiltshire(rate=0.1, sigma=0.2)
    for state in (np.ones(6), np.ones((2, 6))):
        slope = orbit.jacobian(state, 0.0, 0.7)
        assert slope.shape == (*state.shape, 6) and (slope == orbit.transition(0.7)).all()


@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_a_model_without_noise(dt: float) -> None:
    model = clohessy_wiltshire(rate=0.1, sigma=0.0)
    x = np.arange(6.0)
    assert (model.sample_step(x, 0.0, dt, rng=_rng()) == model.step(x, 0.0, dt)).all()
