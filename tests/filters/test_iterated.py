"""Iterated extended updates: steps to the maximum of the posterior density."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.optimize import minimize

from distfilt.filters import GaussianFilter
from distfilt.network import graphs
from distfilt.sensors import Sensor, bearing, distance
from tests.filters.families import PRIOR, TIMES, data, model, still_model, team

CUBE = Sensor(
    1,
    lambda x: x**3,
    [[0.04]],
    derivative=lambda x: 3 * x[..., None] ** 2,
)


def test_the_limit_is_the_maximum_of_the_posterior() -> None:
    """Minus log density (x - 1)² / 2 + (y - x³)² / 0.08, and its curvature by Gauss-Newton."""
    # Enough steps of Gauss and Newton to converge
    f = GaussianFilter(still_model(1), [CUBE], iterations=30)
    start = f.start(([1.0], [[1.0]]))
    state = f.step(start, 0.0, [[5.0]])

    def cost(x: np.ndarray) -> float:
        prior = (x[0] - 1) ** 2 / 2
        misfit = (5 - x[0] ** 3) ** 2 / 0.08
        return float(prior + misfit)

    best = minimize(cost, [1.5], tol=1e-12).x[0]
    assert abs(state.means.item() - best) < 1e-6
    # 1 + H² / R with the slope there
    slope = 3 * best**2
    information = 1 + slope**2 / 0.04
    assert np.isclose(1 / state.covariances.item(), information, rtol=1e-4)
    # Control: one linearisation, about the forecast, is far from it.
    g = GaussianFilter(still_model(1), [CUBE])
    start = g.start(([1.0], [[1.0]]))
    once = g.step(start, 0.0, [[5.0]])
    assert abs(once.means.item() - best) > 0.5


@pytest.mark.parametrize("iterations", [1, 2, 5])
def test_linear_sensors_need_no_iterations(iterations: int) -> None:
    _, seen = data(team(), (2,))
    last = []
    for options in ({}, {"iterations": iterations}):
        f = GaussianFilter(model(), team(), graphs.path(5), lag=1, **options)
        start = f.start(PRIOR, runs=(2,))
        *_, state = f.steps(start, TIMES, seen)
        last.append(state)
    assert (last[0].joint_means == last[1].joint_means).all()
    assert (last[0].joint_covariances == last[1].joint_covariances).all()


def test_two_iterations_by_hand_with_missing_numbers_and_several_agents() -> None:
    """x₁ = m + K (y - h(m)), then linearised there; agents as each alone."""
    sensors: list[Any] = [
        bearing([0, 1], std=0.1),
        distance([0, 1], std=0.2),
        Sensor(
            2,
            lambda x: np.stack([x[..., 0] * x[..., 1], x[..., 1] ** 2], -1),
            np.eye(2),
        ),
    ]
    # A full covariance, and a component that is missing
    prior = (np.array([1.0, 0.5]), np.array([[0.5, 0.1], [0.1, 0.4]]))
    rng = default_rng(0)
    seen = [rng.standard_normal(s.dim) + s.predict(prior[0]) for s in sensors]
    seen[2][1] = np.nan
    options: dict[str, Any] = {"share_observations": False}
    f = GaussianFilter(still_model(2), sensors, iterations=2, **options)
    state = f.step(f.start(prior), 0.0, seen)
    for k, sensor in enumerate(sensors):
        present = ~np.isnan(seen[k])
        first, _ = _update(prior, prior[0], sensor, seen[k], present)
        mean, cov = _update(prior, first, sensor, seen[k], present)
        assert np.allclose(state.means[k], mean, atol=1e-7)
        assert np.allclose(state.covariances[k], cov, atol=1e-7)


def _update(
    prior: Any, x: np.ndarray, sensor: Sensor, y: np.ndarray, present: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the update of a prior by a sensor that is linearised at x."""
    m, p = prior
    # Present components only: rows of H and blocks of R
    h = sensor.jacobian(x)[present]
    residual = sensor.residual(y, sensor.predict(x))[present]
    r = residual - h @ (m - x)
    noise = sensor.noise_cov[np.ix_(present, present)]
    innovation_cov = h @ p @ h.T + noise
    gain = p @ h.T @ np.linalg.inv(innovation_cov)
    return m + gain @ r, p - gain @ h @ p


def test_the_past_follows_the_iterated_present() -> None:
    """By its regression on it: the same as for a linear sensor of the same result."""
    f = GaussianFilter(still_model(1, 0.5), [CUBE], lag=1, iterations=20)
    start = f.start(([1.0], [[1.0]]))
    state = f.step(start, 1.0, [[5.0]])
    # Before: the past is N(1, 1), the present N(1, 1.5), and their covariance 1.
    shift = (state.means - 1.0).item()
    past = state.lagged_states[0]
    assert np.isclose(past.means.item(), 1.0 + shift / 1.5)


def test_a_batch_is_each_run_alone_whatever_the_others_see() -> None:
    """A step to where no prediction is finite is not taken."""
    f = GaussianFilter(still_model(1), [CUBE], iterations=4, on_error="keep")
    values = np.array([[5.0], [1e308], [3.0]])
    with np.errstate(all="ignore"):
        batch = f.step(f.start(([1.0], [[1.0]]), runs=(3,)), 0.0, [values])
    assert not batch.failed[[0, 2]].any()
    start = f.start(([1.0], [[1.0]]))
    alone = f.step(start, 0.0, [[3.0]])
    assert np.allclose(batch.means[2], alone.means)


def test_where_a_later_point_cannot_see() -> None:
    """The first linearisation is kept."""
    root = Sensor(1, lambda x: np.where(x > 0, x**2, np.nan), [[1e-4]])
    f = GaussianFilter(still_model(1), [root], iterations=3)
    # The first step leads to a negative state, from where nothing can be seen.
    start = f.start(([1.0], [[9.0]]))
    state = f.step(start, 0.0, [[-4.0]])
    g = GaussianFilter(still_model(1), [root])
    start = g.start(([1.0], [[9.0]]))
    once = g.step(start, 0.0, [[-4.0]])
    assert once.means.item() < 0
    assert np.allclose(state.means, once.means)


def test_unscented_updates_have_no_iterations() -> None:
    with pytest.raises(ValueError, match="^iterations must be 1 for the linearization"):
        GaussianFilter(still_model(1), [CUBE], iterations=2, linearization="unscented")
