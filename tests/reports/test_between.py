"""Delayed observations of times that were never stepped to, as a stream brings them.

| Project | Report | Here |
|---|---|---|
| own | a camera frame that arrives late, with a time stamp between two IMU steps | all families |

The right value is that of the filter that gets the same observations in the order of their times,
and steps to each of them.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import filters
from distfilt.filters import Observation
from distfilt.models import LinearModel, Model, constant_velocity
from distfilt.network import covariance_intersection, graphs
from distfilt.sensors import component

MOTION = constant_velocity(sigma=0.5, axes=1)
EYE = component([0], std=0.4)
PRIOR = (np.array([0.0, 1.0]), np.array([[1.0, 0.2], [0.2, 0.5]]))
TIMES = [1.0, 2.0, 3.0]
SEEN = [[0.8], [2.3], [2.9]]
LATE = [
    Observation(1.3, 0, [1.1], arrival_time=3.0),
    Observation(0.4, 0, [0.6], arrival_time=2.0),
    Observation(2.7, 0, [2.9], arrival_time=3.0),
    Observation(0.4, 0, [0.5], arrival_time=3.0),
]


def in_order(make: Any, prior: Any = PRIOR, model: Model = MOTION, **start: Any) -> Any:
    """Return the last state of a filter that gets all observations at their own times."""
    # All are events at their own times, of which the filter makes its steps.
    f = make(model, [EYE])
    events = [Observation(t, 0, y) for t, y in zip(TIMES, SEEN, strict=True)]
    events += [Observation(late.t, 0, late.value) for late in LATE]
    run = f.run(f.start(prior, **start), None, events)
    return f.final_state(run)


@pytest.mark.parametrize("lag", [5, 6, 9])
@pytest.mark.parametrize("linearization", ["extended", "unscented"])
def test_gaussian_filters_are_exact(lag: int, linearization: Any) -> None:
    """Late by one step or two, within the step that is taken, and twice at the same time."""
    make = partial(filters.GaussianFilter, linearization=linearization)
    f = make(MOTION, [EYE], lag=lag)
    run = f.run(f.start(PRIOR), TIMES, [SEEN], delayed=LATE)
    state = f.final_state(run)
    expected = in_order(make)
    assert np.allclose(state.means, expected.means, atol=1e-12)
    assert np.allclose(state.covariances, expected.covariances, atol=1e-12)
    # Inserted times are kept in order, and do not appear in the record.
    assert len(state.times) <= lag
    assert list(state.times) == sorted(state.times)
    assert run["time"].values.tolist() == TIMES


def frame(t: float) -> np.ndarray:
    """Return axes that turn and stretch with time."""
    return np.array([[1.0 + 0.3 * t, 0.2 * t], [-0.1 * t, np.exp(-0.2 * t)]])


def move_with_frame() -> LinearModel:
    """Return a random walk in the moving axes: two steps have the noise of one, at any time."""

    def transition(t: float, dt: float) -> np.ndarray:
        return frame(t + dt) @ np.linalg.inv(frame(t))

    def noise_cov(t: float, dt: float) -> np.ndarray:
        # x = A(t) w with w of covariance ∫ C dt
        w_cov = dt * np.array([[0.3, 0.1], [0.1, 0.2]])
        end = frame(t + dt)
        return end @ w_cov @ end.T

    return LinearModel.from_transition(2, transition, noise_cov)


@pytest.mark.parametrize("linearization", ["extended", "unscented"])
def test_a_model_that_depends_on_time_is_bridged_at_its_times(
    linearization: Any,
) -> None:
    """Both parts of a step that is cut have the matrix and the noise of their own times."""
    make = partial(filters.GaussianFilter, linearization=linearization)
    model = move_with_frame()
    f = make(model, [EYE], lag=5)
    run = f.run(f.start(PRIOR), TIMES, [SEEN], delayed=LATE)
    state = f.final_state(run)
    expected = in_order(make, model=model)
    assert np.allclose(state.means, expected.means, atol=1e-12)
    assert np.allclose(state.covariances, expected.covariances, atol=1e-12)


@pytest.mark.parametrize("runs", [(), (3,)])
def test_each_time_between_is_kept_as_the_others_are(runs: tuple[int, ...]) -> None:
    """The belief about the inserted time is that of a smoother which stepped there."""
    f = filters.GaussianFilter(MOTION, [EYE], lag=6)
    start = f.start(PRIOR, runs=runs)
    first = f.step(start, 1.0, [[0.8]])
    state = f.step(first, 2.0, [[2.3]])
    late = Observation(1.3, 0, [1.1])
    state = f.step(state, 2.0, [None], delayed=[late])
    stepped = f.step(first, 1.3, [[1.1]])
    stepped = f.step(stepped, 2.0, [[2.3]])
    # The joint belief about all times, with their cross-covariances
    assert state.times == stepped.times == (0.0, 1.0, 1.3)
    assert np.allclose(state.joint_means, stepped.joint_means, atol=1e-12)
    assert np.allclose(state.joint_covariances, stepped.joint_covariances, atol=1e-12)


MEMBERS = {
    "ensemble": partial(filters.EnsembleFilter.exact, members=4000),
    "particle": partial(filters.ParticleFilter, members=40_000, ess_threshold=0.9),
    "transport": partial(filters.TransportFilter, members=250),
}


@pytest.mark.filterwarnings("ignore::distfilt.filters.ParticleCollapse")
@pytest.mark.parametrize("family", MEMBERS)
def test_members_tend_to_it(family: str) -> None:
    f = MEMBERS[family](MOTION, [EYE], lag=6)
    start = f.start(PRIOR, rng=np.random.default_rng(0))
    run = f.run(start, TIMES, [SEEN], delayed=LATE)
    expected = in_order(filters.GaussianFilter)
    # A transport filter has 250 members in place of thousands.
    slack = 5.0 if family == "transport" else 1.0
    std = np.sqrt(np.diagonal(expected.covariances[0]))
    error = run["mean"].values[-1, 0] - expected.means[0]
    assert (np.abs(error) < 0.06 * slack * std).all()
    ratio = np.sqrt(run["variance"].values[-1, 0]) / std
    assert (np.abs(ratio - 1) < 0.06 * slack).all()


def test_members_without_noise_are_exact() -> None:
    """A state between two is then known from either, and so are all moments."""
    still = constant_velocity(sigma=0.0, axes=1)
    f = filters.EnsembleFilter.exact(still, [EYE], members=60, lag=6)
    # The Gaussian filter starts with the moments of the members.
    x = np.random.default_rng(0).standard_normal((60, 2))
    start = f.start(x, rng=np.random.default_rng(1))
    run = f.run(start, TIMES, [SEEN], delayed=LATE)
    sample_moments = (x.mean(axis=0), np.cov(x.T))
    expected = in_order(filters.GaussianFilter, sample_moments, still)
    assert np.allclose(run["mean"].values[-1], expected.means, atol=1e-9)
    variance = np.diagonal(expected.covariances, axis1=1, axis2=2)
    assert np.allclose(run["variance"].values[-1], variance, atol=1e-9)


TURNING = {
    "gaussian": filters.GaussianFilter,
    "gaussian, unscented": partial(filters.GaussianFilter, linearization="unscented"),
    "ensemble": partial(filters.EnsembleFilter.exact, members=200),
    "particle": partial(filters.ParticleFilter, members=500),
    "transport": partial(filters.TransportFilter, members=40),
}


@pytest.mark.parametrize("family", TURNING)
def test_a_heading_between_two_sides_of_the_cut(family: str) -> None:
    """It crosses ±π between the steps of the late one: as a heading that starts elsewhere."""
    model = LinearModel.from_transition(
        2,
        lambda dt: np.array([[1.0, dt], [0.0, 1.0]]),
        lambda t, dt: MOTION.Q(t, dt),
        periods={0: 2 * np.pi},
    )
    eye = component([0], std=0.1, periods=[2 * np.pi])
    f = TURNING[family](model, [eye], lag=4)
    summaries = []
    for angle in (0.1, 1.6):
        start = f.start(([angle, 1.0], 0.02 * np.eye(2)), rng=np.random.default_rng(0))
        state = f.step(start, 1.0, [[angle + 1.1]])
        state = f.step(state, 2.0, [[angle + 1.9]])
        late = Observation(1.4, 0, [angle + 1.2])
        state = f.step(state, 2.0, [None], delayed=[late])
        summaries.append(f.summarize(state))
    level, turned = summaries
    # The second is turned by 1.5, and lies behind the cut, a whole turn less.
    assert turned.mean[0, 0] < -2.0
    shift = [1.5 - 2 * np.pi, 0.0]
    assert np.allclose(turned.mean[0], level.mean[0] + shift, atol=1e-6)
    assert np.allclose(turned.variance, level.variance, atol=1e-6)


def test_agents_of_a_transport_filter_keep_their_members_in_common() -> None:
    f = filters.TransportFilter(MOTION, [EYE, None], graphs.path(2), members=20, lag=4)
    state = f.start(PRIOR, rng=np.random.default_rng(0))
    state = f.step(state, 1.0, [[0.8], None])
    state = f.step(state, 2.0, [None, None], delayed=[Observation(0.4, 0, [0.6])])
    # The state of the inserted time is drawn once, for all agents.
    assert (state.ensembles[0] == state.ensembles[1]).all()
    assert state.times == (0.0, 0.4, 1.0)


def test_a_network_exchanges_once_a_step_and_sends_the_late_one() -> None:
    """The neighbour assimilates it too; a time within the step costs no round of its own."""
    f = filters.GaussianFilter(
        MOTION, [EYE, None], graphs.path(2), fusion=covariance_intersection, lag=5
    )
    state = f.step(f.start(PRIOR), 1.0, [[0.8], None])
    plain = f.step(state, 2.0, [[2.3], None])
    late = [Observation(0.4, 0, [0.6]), Observation(1.5, 0, [1.4])]
    after = f.step(state, 2.0, [[2.3], None], delayed=late)
    # The late ones travel in the messages of the step.
    assert after.ledger.rounds == plain.ledger.rounds
    assert after.ledger.messages.tolist() == plain.ledger.messages.tolist()
    assert (after.covariances[1] != plain.covariances[1]).any()


def test_a_nonlinear_model_is_right_to_first_order() -> None:
    """A pendulum with small steps: the difference from stepping there is below the bend."""

    def transition(x: np.ndarray, t: float, dt: float) -> np.ndarray:
        angle = x[..., 0] + dt * x[..., 1]
        rate = x[..., 1] - dt * np.sin(x[..., 0])
        return np.stack([angle, rate], axis=-1)

    swing = Model(2, transition, lambda t, dt: 0.01 * dt * np.eye(2))
    f = filters.GaussianFilter(swing, [EYE], lag=4)
    state = f.step(f.start(PRIOR), 0.1, [[0.1]])
    late = f.step(state, 0.1, [None], delayed=[Observation(0.05, 0, [0.3])])
    start = f.start(PRIOR)
    stepped = f.step(f.step(start, 0.05, [[0.3]]), 0.1, [[0.1]])
    # Derivatives are taken at slightly different states: errors of second order in 0.1 s
    assert np.allclose(late.means, stepped.means, atol=0.01)
    assert np.allclose(late.covariances, stepped.covariances, atol=0.01)


def test_times_outside_are_refused_by_name() -> None:
    f = filters.GaussianFilter(MOTION, [EYE], lag=1)
    start = f.start(PRIOR)
    state = f.step(f.step(start, 1.0, [[0.8]]), 2.0, [[2.3]])
    # Before the oldest time that is kept; without any kept time; in smoothing; in a network
    with pytest.raises(ValueError, match="delayed must be of an earlier time"):
        f.step(state, 3.0, [None], delayed=[Observation(0.5, 0, [0.0])])
    late = Observation(0.5, 0, [0.0])
    none = filters.GaussianFilter(MOTION, [EYE])
    with pytest.raises(ValueError, match="none with lag = 0"):
        none.step(none.start(PRIOR), 1.0, [None], delayed=[late])
    g = filters.GaussianFilter(MOTION, [EYE], lag=2)
    between = Observation(1.5, 0, [0.0], arrival_time=3.0)
    with pytest.raises(ValueError, match="one of the times for smoothing"):
        g.smooth(g.start(PRIOR), TIMES, [SEEN], delayed=[between])
    h = filters.GaussianFilter(
        MOTION, [EYE, None], graphs.path(2), lag=3, exchange_interval=2.0
    )
    with pytest.raises(ValueError, match="agents that exchange at intervals"):
        h.step(h.start(PRIOR), 1.0, [None, None], delayed=[late])


def test_a_late_time_that_is_rounded_otherwise_is_the_one_that_is_kept() -> None:
    """0.1 + 0.2 is not 0.3, but neither is it a time between two steps."""
    f = filters.GaussianFilter(MOTION, [EYE], lag=2)
    start = f.start(PRIOR)
    rounded = 0.1 + 0.2
    assert rounded != 0.3
    ends = []
    for stepped, observed in ((0.3, 0.3), (0.3, rounded), (rounded, 0.3)):
        state = f.step(f.step(start, stepped, [None]), 1.0, [[0.8]])
        late = Observation(observed, 0, [1.1])
        state = f.step(state, 1.0, [None], delayed=[late])
        assert state.times == (0.0, stepped)
        ends.append(state.joint_means)
    in_order = f.step(f.step(start, 0.3, [[1.1]]), 1.0, [[0.8]])
    for end in ends:
        assert np.allclose(end, in_order.joint_means, atol=1e-12)
