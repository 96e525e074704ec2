"""Messages that say what to change.

==================================  ==========================================================
Report                              Situation
==================================  ==========================================================
dynesty issue 263, pycbc pull 2947  weights of single precision do not sum to 1
own                                 a standard deviation by position
own                                 a transition, noise or sensor of a wrong number of arguments
own                                 a series (T,) of a sensor of one component
own                                 a column vector as a mean or an observation
own                                 a log without a single event
own                                 noise that is drawn inside the transition
own                                 Observations alone in a step, in any order
own                                 an array whose first axes may be times or agents
simdkalman issue 10                 a missing number as None, numbers as text
==================================  ==========================================================
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from distfilt.filters import (
    EnsembleFilter,
    GaussianFilter,
    MixtureFilter,
    Observation,
    ParticleFilter,
    TransportFilter,
    final_state,
)
from distfilt.gaussians import log_density
from distfilt.kalman import kalman_filter
from distfilt.models import LinearModel, Model, constant_velocity
from distfilt.network import graphs
from distfilt.sensors import Sensor, bearing, component
from distfilt.updates import resample

WALK = constant_velocity(sigma=0.1, axes=1)
EYE = component([0], std=1.0)
PRIOR = (np.zeros(2), np.eye(2))


def test_an_option_by_position_is_named() -> None:
    with pytest.raises(TypeError, match="give std=.* by name, such as std=1.0"):
        component([0], 1.0)  # type: ignore[misc]
    with pytest.raises(ValueError, match=r"bearing\(\) must have at most 1 of its"):
        bearing([0, 1], 0.1)  # type: ignore[misc]


def test_functions_of_a_wrong_number_of_arguments() -> None:
    def q(t: float, dt: float) -> Any:
        return np.eye(1)

    calls = {
        r"transition must be a function of \(x, t, dt\), got one of \(x\)": lambda: (
            Model(1, lambda x: x, q)
        ),
        r"noise_cov must be a function of \(t, dt\)": lambda: Model(
            1, lambda x, t, dt: x, lambda dt: np.eye(1)
        ),
        r"derivative must be a function of \(x, t, dt\)": lambda: Model(
            1, lambda x, t, dt: x, q, derivative=lambda x: x
        ),
        r"h must be a function of \(x\), got": lambda: Sensor(
            1, lambda x, t: x, [[1.0]]
        ),
        r"h must be a function of \(x, previous\)": lambda: Sensor(
            1, lambda x: x, [[1.0]], uses_previous=True
        ),
    }
    for text, call in calls.items():
        with pytest.raises(TypeError, match=text):
            call()
    # More arguments with defaults are fine, and so is a function that does not tell.
    Model(1, lambda x, t, dt, gain=1.0: x, q)
    Sensor(1, np.abs, [[1.0]])
    LinearModel.from_transition(1, lambda dt: np.eye(1), q)


def test_a_series_without_an_axis() -> None:
    f = GaussianFilter(WALK, [EYE])
    start = f.start(PRIOR)
    series = np.array([0.1, 0.2, 0.3])
    with pytest.raises(ValueError, match=r"got \(3,\): .* give y\[:, None\]"):
        f.run(start, [1.0, 2.0, 3.0], [series])
    with pytest.raises(ValueError, match=r"got \(\): give \[x\]"):
        f.run(start, [1.0, 2.0, 3.0], [series.tolist()])
    with pytest.raises(ValueError, match=r"got \(\): give \[x\]"):
        f.step(start, 1.0, [0.1])


def test_weights_of_single_precision() -> None:
    weights = np.random.default_rng(3).dirichlet(np.full(10_000, 0.01))
    single = weights.astype(np.float32)
    with pytest.raises(ValueError, match="1 up to 1e-9, got a sum that is .* off"):
        resample(single, rng=np.random.default_rng(0))
    double = single.astype(np.float64)
    resample(double / double.sum(), rng=np.random.default_rng(0))
    with pytest.raises(ValueError, match="must sum to 1, got 1.1"):
        resample([0.5, 0.6], rng=np.random.default_rng(0))


def test_column_vectors_are_named() -> None:
    column = np.zeros((2, 1))
    matrices = {"F": np.eye(2), "H": [[1.0, 0.0]], "Q": np.eye(2), "R": [[1.0]]}
    with pytest.raises(
        ValueError, match=r"mean has shape \(2, 1\), a column; give mean"
    ):
        kalman_filter(column, np.eye(2), np.zeros((5, 1)), **matrices)
    with pytest.raises(ValueError, match=r"mean must have shape .* a column, give x"):
        log_density(np.zeros(2), column, np.eye(2))
    f = GaussianFilter(WALK, [component([0, 1], std=1.0)])
    with pytest.raises(ValueError, match=r"got \(2, 1\): a column, give x\[:, 0\]"):
        f.start((column, np.eye(2)))
    with pytest.raises(ValueError, match=r"got \(2, 1\): a column, give x\[:, 0\]"):
        f.step(f.start(PRIOR), 1.0, [column])


@pytest.mark.parametrize(
    "make", [GaussianFilter, EnsembleFilter, ParticleFilter, TransportFilter]
)
@pytest.mark.parametrize("option", [{}, {"gate_probability": 0.9}])
def test_a_log_without_an_event(make: Any, option: Any) -> None:
    """The record has the variables of any other, with no times, and ends where it began."""
    f = make(WALK, [EYE], **option)
    start = f.start(PRIOR, rng=np.random.default_rng(0), runs=(3,))
    empty = f.run(start, None, [], truth=np.zeros((0, 3, 2)))
    one = f.run(start, [1.0], [np.zeros((1, 1))], truth=np.zeros((1, 3, 2)))
    assert set(empty) == set(one)
    for name in one:
        assert empty[name].shape == (0, *one[name].shape[1:])
        assert empty[name].dims == one[name].dims
    assert final_state(empty) is start
    with pytest.raises(ValueError, match="run must be"):
        final_state(one.isel(time=slice(0, 0)))


def test_a_log_without_an_event_of_a_mixture() -> None:
    f = MixtureFilter(WALK, [EYE], target_dim=1)
    run = f.run(f.start(PRIOR), None, [])
    assert run["mean"].shape == (0, 1, 2)


@pytest.mark.parametrize("make", [GaussianFilter, ParticleFilter])
def test_times_without_an_event_are_a_run_of_forecasts(make: Any) -> None:
    f = make(WALK, [EYE, EYE], graphs.path(2))
    start = f.start(PRIOR, rng=np.random.default_rng(0))
    times = [1.0, 2.5]
    run = f.run(start, times, [])
    as_arrays = f.run(start, times, [None, None])
    assert run["time"].values.tolist() == times
    assert (run["mean"].values == as_arrays["mean"].values).all()
    assert (run["covariance"].values == as_arrays["covariance"].values).all()
    with pytest.raises(ValueError, match="entry for each of 2 agents, got 1 entries"):
        f.run(start, times, [None])


def test_noise_that_is_drawn_inside() -> None:
    rng = np.random.default_rng(0)

    def move(x: Any, t: float, dt: float) -> Any:
        return x + rng.normal(0.0, 0.1, x.shape)

    noisy = Model(1, move, lambda t, dt: np.zeros((1, 1)))
    f = ParticleFilter(noisy, [component([0], std=0.2)])
    with pytest.raises(
        ValueError, match="noise that is drawn in it belongs in noise_cov"
    ):
        f.step(f.start(([0.0], [[0.1]]), rng=rng), 1.0, [[0.1]])
    sensor = Sensor(1, lambda x: x + rng.normal(size=x.shape), [[1.0]])
    with pytest.raises(ValueError, match="h must give the same values"):
        sensor.predict(np.arange(5.0)[:, None])


def test_observations_alone_in_any_order() -> None:
    f = GaussianFilter(WALK, [EYE, EYE, EYE], graphs.path(3))
    start = f.start(PRIOR)
    one, two = Observation(1.0, 2, [1.0]), Observation(1.0, 0, [2.0])
    expected = f.step(start, 1.0, [[2.0], None, [1.0]])
    for given in ([one, two], (two, one), [[two], [], [one]]):
        assert np.array_equal(f.step(start, 1.0, given).means, expected.means)
    with pytest.raises(ValueError, match="of agents below 3, got 5"):
        f.step(start, 1.0, [Observation(1.0, 5, [1.0])])
    with pytest.raises(
        ValueError, match="an Observation of agent 0 at t = 1, got one of"
    ):
        f.step(start, 1.0, [Observation(2.0, 0, [1.0])])


def test_an_array_of_as_many_times_as_agents() -> None:
    """(times, agents, 1) and (agents, times, 1) cannot be told apart."""
    f = GaussianFilter(WALK, [EYE, EYE], graphs.path(2))
    y = np.array([[[1.0], [2.0]], [[1.5], [2.5]]])
    with pytest.raises(ValueError, match=r"give list\(y\), agents first"):
        f.run(f.start(PRIOR), [1.0, 2.0], y)
    run = f.run(f.start(PRIOR), [1.0, 2.0], list(y))
    longer = f.run(
        f.start(PRIOR), [1.0, 2.0, 3.0], np.concatenate([y, y[:, :1]], axis=1)
    )
    assert np.allclose(run["mean"], longer["mean"][:2])


def test_numbers_that_are_none_or_text() -> None:
    f = GaussianFilter(WALK, [component([0, 1], std=1.0)])
    with pytest.raises(ValueError, match="got NoneType: a missing number is NaN"):
        f.step(f.start(PRIOR), 1.0, [[None, 1.0]])
    with pytest.raises(ValueError, match="must be an array of real numbers, got str$"):
        f.step(f.start(PRIOR), 1.0, [np.array(["1", "2"])])
    with pytest.raises(ValueError, match=r"give \[\[x\]\], a matrix of one number"):
        kalman_filter([0.0], [[1.0]], [[1.0]], F=[[1.0]], H=[[1.0]], Q=[[0.1]], R=0.5)
