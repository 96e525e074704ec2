"""A transition matrix that changes with time, F(t, dt), in every family.

| Project | Report | Here |
|---|---|---|
| own | a matrix that depends on the time, as a schedule of gains | Kalman filter |

The right value is a product of matrices, or a Kalman filter written out.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import filters
from distfilt.kalman import kalman_filter
from distfilt.models import LinearModel, Model, simulate
from distfilt.sensors import Sensor, wrap

TIMES = np.array([0.5, 1.5, 2.0, 3.5])
SEEN = np.array([[1.0], [0.5], [0.2], [0.9]])
PRIOR = (np.array([1.0, 0.0]), np.array([[1.0, 0.2], [0.2, 0.5]]))
Q = np.array([[0.3, 0.1], [0.1, 0.2]])
H = np.array([[1.0, 0.5]])
EYE = Sensor(1, lambda x: x @ H.T, [[0.3]], linear=lambda d: H)


def matrix(t: float, dt: float) -> np.ndarray:
    # A turn with the rate t: the angle is ∫ t dt.
    angle = 0.5 * ((t + dt) ** 2 - t**2)
    c = np.cos(angle)
    s = np.sin(angle)
    return np.array([[c, s], [-s, c]])


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


@pytest.mark.parametrize(
    "make",
    [
        filters.GaussianFilter,
        partial(filters.GaussianFilter, linearization="unscented"),
        partial(filters.GaussianSumFilter, linearization="unscented"),
        partial(filters.MixtureFilter, target_dim=1),
        partial(filters.EnsembleFilter, members=20),
        partial(filters.ParticleFilter, members=20),
        partial(filters.TransportFilter, members=20),
    ],
)
def test_a_heading_turns_at_the_rate_of_the_time_at_which_a_step_begins(
    make: Any,
) -> None:
    """At (1 + t) rad/s from 0 to 0.5 s and then to 2 s: by 1 · 0.5 + 1.5 · 1.5 = 2.75 rad."""
    model = Model(
        1,
        lambda x, t, dt: x + (1 + t) * dt,
        lambda t, dt: np.zeros((1, 1)),
        periods=(2 * np.pi,),
    )
    f = make(model, [None])
    start = f.start(([2.0], [[0.04]]), rng=np.random.default_rng(0))
    *_, last = f.steps(start, [0.5, 2.0], [None])
    # Members have a mean of their own, and all turn by the same angle.
    before = f.summarize(start)
    after = f.summarize(last)
    assert np.allclose(wrap(after.mean - before.mean - 2.75), 0.0, atol=1e-12)
    assert np.allclose(after.variance, before.variance, rtol=1e-9)


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
