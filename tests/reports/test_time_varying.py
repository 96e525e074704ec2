"""A transition matrix that changes with time, F(t, dt), in every family.

| Project | Report | Here |
|---|---|---|
| own | a matrix that depends on the time, as a schedule of gains | Kalman filter |

The right value is a product of matrices, or a Kalman filter written out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from distfilt import filters
from distfilt.kalman import kalman_filter
from distfilt.models import LinearModel, simulate
from distfilt.sensors import Sensor

TIMES = np.array([0.5, 1.5, 2.0, 3.5])
SEEN = np.array([[1.0], [0.5], [0.2], [0.9]])
PRIOR = (np.array([1.0, 0.0]), np.array([[1.0, 0.2], [0.2, 0.5]]))
Q = np.array([[0.3, 0.1], [0.1, 0.2]])
H = np.array([[1.0, 0.5]])
EYE = Sensor(1, lambda x: x @ H.T, [[0.3]], linear=lambda d: H)


def matrix(t: float, dt: float) -> np.ndarray:
    angle = 0.5 * ((t + dt) ** 2 - t**2)
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


TURN = LinearModel.from_transition(2, matrix, lambda t, dt: dt * Q)


def test_steps_and_jacobians_begin_at_their_time() -> None:
    x = np.array([[1.0, 2.0], [0.0, 1.0]])
    assert np.allclose(TURN.step(x, 1.0, 0.5), x @ matrix(1.0, 0.5).T)
    assert np.allclose(TURN.jacobian(x, 1.0, 0.5), matrix(1.0, 0.5))
    assert np.allclose(TURN.F(0.5, 1.0), matrix(1.0, 0.5))
    assert np.allclose(TURN.F(0.5, t=2.0), matrix(2.0, 0.5))
    quiet = LinearModel.from_transition(2, matrix, lambda t, dt: np.zeros((2, 2)))
    path = simulate(quiet, [1.0, 0.0], TIMES, rng=np.random.default_rng(0))
    assert np.allclose(path[-1], matrix(0.0, 3.5) @ [1.0, 0.0])


@pytest.mark.parametrize("linearization", ["extended", "unscented"])
def test_filters_are_the_kalman_filter(linearization: Any) -> None:
    steps = np.diff(TIMES, prepend=0.0)
    exact = kalman_filter(
        *PRIOR,
        SEEN,
        F=np.array([matrix(t - dt, dt) for t, dt in zip(TIMES, steps, strict=True)]),
        Q=steps[:, None, None] * Q,
        H=H,
        R=[[0.3]],
    )
    f = filters.GaussianFilter(TURN, [EYE], linearization=linearization)
    run = f.run(f.start(PRIOR), TIMES, [SEEN])
    assert np.allclose(run["mean"].values[:, 0], exact.means, atol=1e-12)
    assert np.allclose(run["covariance"].values[:, 0], exact.covariances, atol=1e-12)
    g = filters.MixtureFilter(TURN, [EYE], target_dim=2)
    mixed = g.run(g.start(PRIOR), TIMES, [SEEN])
    assert np.allclose(mixed["mean"].values[:, 0], exact.means, atol=1e-9)
    for h in (
        filters.EnsembleFilter(TURN, [EYE], members=20_000),
        filters.ParticleFilter(TURN, [EYE], members=20_000),
    ):
        start = h.start(PRIOR, rng=np.random.default_rng(0))
        drawn = h.run(start, TIMES, [SEEN])
        assert np.allclose(drawn["mean"].values[:, 0], exact.means, atol=0.04)


def test_a_matrix_with_options_is_still_one_of_dt() -> None:
    def of_step(dt: float, rate: float = 2.0) -> np.ndarray:
        return np.array([[np.exp(-rate * dt)]])

    model = LinearModel.from_transition(1, of_step, lambda t, dt: np.zeros((1, 1)))
    assert np.allclose(model.step([1.0], 7.0, 0.5), np.exp(-1.0))
    assert not model.varies_with_time
    assert np.allclose(model.F(0.5), np.exp(-1.0))


def test_what_needs_the_time_says_so() -> None:
    with pytest.raises(ValueError, match="t must be the time at which the step begins"):
        TURN.F(0.5)
    with pytest.raises(ValueError, match="time_invariant must be False"):
        LinearModel.from_transition(
            2, matrix, lambda t, dt: dt * Q, time_invariant=True
        )
