"""Measured inputs with noise in the body's frame: odometry.

| Project | Report | Here |
|---|---|---|
| own | the noise of a robot's wheels, along its heading | Jacobian by hand, and draws |
| own | odometry at another rate than the filter's steps | pieces by hand |
| ros-controls/ros2_controllers pull 1454 | a log that ends: the last speed is held | warned of |

Covariances are G Σ Gᵀ written out for a robot on the plane, and sample covariances of draws.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import filters
from distfilt.kalman import filterpy_ekf, filterpy_ukf
from distfilt.models import InputModel, Inputs
from distfilt.sensors import component
from distfilt.updates.gaussian import exact_forecast

SIGMA = np.diag([0.04, 0.01])


def drive(x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
    heading = x[..., 2]
    distance = dt * u[..., 0]
    first = x[..., 0] + distance * np.cos(heading)
    second = x[..., 1] + distance * np.sin(heading)
    turned = heading + dt * u[..., 1]
    return np.stack([first, second, turned], axis=-1)


ODOMETRY = Inputs([0.0, 1.0, 2.0], [[1.0, 0.2], [2.0, -0.1], [0.5, 0.0]], SIGMA)
ROBOT = InputModel.from_inputs(3, drive, ODOMETRY)
PRIOR = (np.array([0.0, 0.0, 0.7]), np.diag([0.1, 0.1, 0.05]))


def by_hand(heading: float, dt: float, u: np.ndarray) -> tuple[Any, Any]:
    """Return F and G of one piece."""
    c = np.cos(heading)
    s = np.sin(heading)
    # x' = x + dt (v cos θ, v sin θ, ω) with u = (v, ω)
    distance = dt * u[0]
    f = np.array([[1, 0, -distance * s], [0, 1, distance * c], [0, 0, 1]])
    g = np.array([[dt * c, 0], [dt * s, 0], [0, dt]])
    return f, g


@pytest.mark.parametrize("linearization", ["extended", "unscented"])
def test_the_noise_of_the_wheels_is_along_the_heading(linearization: Any) -> None:
    """With a sure prior the covariance is G Σ Gᵀ at the robot's own heading."""
    f = filters.GaussianFilter(ROBOT, [None], linearization=linearization)
    for heading in (0.0, 0.7, np.pi / 2):
        start = f.start(([1.0, 2.0, heading], np.zeros((3, 3))))
        state = f.step(start, 1.0, [None])
        _, g = by_hand(heading, 1.0, np.array([1.0, 0.2]))
        assert np.allclose(state.covariances[0], g @ SIGMA @ g.T, atol=1e-9)
        moved = [1 + np.cos(heading), 2 + np.sin(heading), heading + 0.2]
        assert np.allclose(state.means[0], moved)


def test_steps_across_inputs_use_each_for_its_time() -> None:
    """From .5 to 1.75: the first for half a second, the second for .75 s."""
    pieces = ODOMETRY.pieces(0.5, 1.25)
    assert [(t, dt) for t, dt, _ in pieces] == [(0.5, 0.5), (1.0, 0.75)]
    x = np.array([1.0, -1.0, 0.3])
    cov = np.zeros((3, 3))
    for _, dt, u in pieces:
        f, g = by_hand(x[2], dt, u)
        # The noise of the earlier piece is moved by F.
        cov = f @ cov @ f.T + g @ SIGMA @ g.T
        x = drive(x, u, dt)
    assert np.allclose(ROBOT.step([1.0, -1.0, 0.3], 0.5, 1.25), x)
    assert np.allclose(ROBOT.noise_at([1.0, -1.0, 0.3], 0.5, 1.25), cov, atol=1e-9)
    # At the edges: up to an input's time it does not hold yet, and the last holds on.
    for start, length, values in (
        (0.0, 1.0, [1.0, 0.2]),
        (1.0, 1.0, [2.0, -0.1]),
        (3.0, 5.0, [0.5, 0.0]),
    ):
        ((_, _, u),) = ODOMETRY.pieces(start, length)
        assert u.tolist() == values


FAMILIES = {
    "ensemble": partial(filters.EnsembleFilter, members=100_000),
    "particle": partial(filters.ParticleFilter, members=100_000),
}


@pytest.mark.parametrize("family", FAMILIES)
def test_members_are_draws_of_the_inputs(family: str) -> None:
    """Their moments are those of draws that are made here, of pose and inputs."""
    f = FAMILIES[family](ROBOT, [component([0], std=9.0)])
    state = f.start(PRIOR, rng=np.random.default_rng(0))
    state = f.step(state, 1.5, [None])
    rng = np.random.default_rng(1)
    x = rng.multivariate_normal(*PRIOR, size=400_000)
    # One draw for each input, which holds as long as it does; Σ = diag(0.2², 0.1²)
    for dt, u in ((1.0, [1.0, 0.2]), (0.5, [2.0, -0.1])):
        noise = rng.standard_normal((400_000, 2)) * [0.2, 0.1]
        x = drive(x, u + noise, dt)
    assert np.allclose(state.belief[0].mean(axis=0), x.mean(axis=0), atol=0.01)
    assert np.allclose(np.cov(state.belief[0].T), np.cov(x.T), atol=0.01)


def test_all_agents_of_a_transport_filter_draw_the_same() -> None:
    f = filters.TransportFilter(
        ROBOT, [component([0], std=1.0)] * 2, [(0, 1)], members=10
    )
    start = f.start(PRIOR, rng=np.random.default_rng(0))
    state = f.step(start, 1.0, [None, None])
    # Members in common need noise in common.
    assert (state.belief[0] == state.belief[1]).all()


@pytest.mark.parametrize(
    ("reference", "linearization"),
    [(filterpy_ekf, "extended"), (filterpy_ukf, "unscented")],
)
def test_filters_of_filterpy_have_the_inputs_noise(
    reference: Any, linearization: Any
) -> None:
    """The same as the library's, whose noise is compared with G Σ Gᵀ by hand above."""
    sensor = component([0, 1], std=0.2)
    seen = np.array([[0.6, 0.5], [2.1, 1.6]])
    prior = (PRIOR[0], PRIOR[1] + 0.01 * np.eye(3))
    run = reference(*prior, seen, model=ROBOT, sensors=[sensor], times=[1.0, 2.0])
    f = filters.GaussianFilter(ROBOT, [sensor], linearization=linearization)
    expected = f.run(f.start(prior), [1.0, 2.0], [seen])
    assert np.allclose(run.means, expected["mean"].values[:, 0], atol=1e-9)
    assert np.allclose(run.covariances, expected["covariance"].values[:, 0], atol=1e-9)


def test_further_noise_is_added() -> None:
    extra = 0.3 * np.eye(3)
    noisier = InputModel.from_inputs(3, drive, ODOMETRY, lambda t, dt: dt * extra)
    x = [0.0, 0.0, 0.7]
    # In one second
    difference = noisier.noise_at(x, 0.0, 1.0) - ROBOT.noise_at(x, 0.0, 1.0)
    assert np.allclose(difference, extra)


def test_what_needs_one_covariance_refuses_it_by_name() -> None:
    with pytest.raises(
        ValueError, match="model must have a noise that does not depend"
    ):
        filters.MixtureFilter(ROBOT, [None], target_dim=2)
    with pytest.raises(ValueError, match="use stochastic_forecast"):
        exact_forecast(
            np.random.default_rng(0).standard_normal((9, 3)),
            ROBOT,
            0.0,
            1.0,
            rng=np.random.default_rng(0),
        )
    with pytest.raises(ValueError, match="times must begin at the model's first step"):
        Inputs([1.0], [[0.0]], [[1.0]]).pieces(0.0, 1.0)
    with pytest.raises(ValueError, match=r"values must have shape \(2, k\)"):
        Inputs([0.0, 1.0], [[0.0]], [[1.0]])


def test_inputs_that_end_are_told_once() -> None:
    """Up to ten times the longest interval the last one is held without a word."""
    log = Inputs([0.0, 1.0, 2.0], [[1.0], [1.0], [1.0]], [[0.01]])
    line = InputModel.from_inputs(1, lambda x, u, dt: x + dt * u, log)
    f = filters.GaussianFilter(line, [None])
    state = f.step(f.start(([0.0], [[1.0]])), 12.0, [None])
    assert np.allclose(state.means, 12.0)
    with pytest.warns(RuntimeWarning, match="a step's end at 13, got 2 last") as caught:
        state = f.step(state, 13.0, [None])
        f.step(state, 500.0, [None])
    assert len(caught) == 1
    # A single input holds for ever.
    wind = Inputs([0.0], [[1.0]], [[0.01]])
    steady = InputModel.from_inputs(1, lambda x, u, dt: x + dt * u, wind)
    g = filters.GaussianFilter(steady, [None])
    start = g.start(([0.0], [[1.0]]))
    state = g.step(start, 500.0, [None])
    assert np.allclose(state.means, 500.0)
