"""A gate that keeps rejecting says so once: a track that is lost, or a noise that is too small.

| Report | Situation |
|---|---|
| manankharwar/fusioncore 38 | a source that is rejected many times in a row, for good |
| cra-ros-pkg/robot_localization 417 | rejected observations, and a covariance that goes on |
| own | one bad sensor beside a good one; runs, saving, a reset, observations of neighbours |

A random walk x with deviation 1 is far from where the belief is; by how much each observation is
rejected follows by hand.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import filters
from distfilt.density import Grid
from distfilt.filters import Observation
from distfilt.filters.gating import LIMIT
from distfilt.models import Model
from distfilt.network import average_consensus, graphs
from distfilt.sensors import Sensor, component
from distfilt.updates import enkf_exact, serially

# Little noise, so that the belief stays where it is.
WALK = Model(1, lambda x, t, dt: x, lambda t, dt: 0.01 * dt * np.eye(1))
EYE = component([0], std=0.3)
PRIOR = ([0.0], [[1.0]])
NEAR = [0.1]
FAR = [40.0]
MESSAGE = rf"agent 0's has rejected the last {LIMIT} of kind 'component'"

FAMILIES: dict[str, Any] = {
    "extended": filters.GaussianFilter,
    "unscented": partial(filters.GaussianFilter, linearization="unscented"),
    "ensemble": partial(filters.EnsembleFilter, members=40),
    "serial": partial(filters.EnsembleFilter, members=40, update=serially(enkf_exact)),
    "particle": partial(filters.ParticleFilter, members=200),
    "transport": partial(filters.TransportFilter, members=20),
    "mixture": partial(filters.MixtureFilter, target_dim=1),
    "increments": partial(
        filters.InformationIncrementFilter, target_dim=1, graph=graphs.path(1)
    ),
    "sum": filters.GaussianSumFilter,
    "grid": partial(filters.GridFilter, grid=Grid((400,), low=-8.0, high=60.0)),
    "consensus": partial(
        filters.InformationConsensusFilter, fusion=partial(average_consensus, rounds=2)
    ),
    "tree": partial(filters.ChannelFilter, graph=graphs.path(1)),
    "likelihood": partial(
        filters.LikelihoodConsensusFilter,
        basis=filters.PolynomialBasis([0]),
        fusion=partial(average_consensus, rounds=2),
        members=200,
    ),
}


def make(family: str, **options: Any) -> tuple[Any, Any]:
    """Return a filter of one agent with a gate, and its first state."""
    f = FAMILIES[family](WALK, [EYE], gate_probability=0.999, **options)
    return f, f.start(PRIOR, rng=np.random.default_rng(0))


def steps_until_warned(f: Any, state: Any, values: list[Any]) -> tuple[list[int], Any]:
    """Return after which observations a warning of the gate came, and the last state."""
    warned = []
    for k, value in enumerate(values, start=1):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            state = f.step(state, state.t + 1.0, value)
        if any("rejected the last" in str(one.message) for one in caught):
            warned.append(k)
    return warned, state


@pytest.mark.parametrize("family", FAMILIES)
def test_a_lost_track_is_told_once_after_ten(family: str) -> None:
    """fusioncore 38: in a row; one that passes starts the count anew, a missing one does not."""
    f, state = make(family)
    nine_far = [[FAR]] * 9
    five_far = [[FAR]] * 5
    values = [[NEAR], *nine_far, [NEAR], *five_far, [None], *nine_far]
    warned, state = steps_until_warned(f, state, values)
    # 1 + 9 + 1 observations, then five, a gap, and the tenth after it
    assert warned == [11 + 5 + 1 + 5]
    assert state.rejection_streaks[0, 0].tolist() == [14.0, 0.0]


def test_the_count_is_saved_and_so_is_what_was_said(tmp_path: Any) -> None:
    f, state = make("extended")
    _, state = steps_until_warned(f, state, [[FAR]] * 6)
    state.save(tmp_path / "state.npz")
    state = type(state).load(tmp_path / "state.npz")
    warned, state = steps_until_warned(f, state, [[FAR]] * 6)
    # Six before the file and four after it are ten.
    assert warned == [4]
    state.save(tmp_path / "state.npz")
    state = type(state).load(tmp_path / "state.npz")
    assert steps_until_warned(f, state, [[FAR]] * 12)[0] == []


def test_a_bad_sensor_beside_a_good_one_is_named() -> None:
    """Odometers of two kinds: the good one passes between the rejected ones."""
    tape = Sensor(1, lambda x: x, [[0.01]], kind="tape")
    f = filters.GaussianFilter(WALK, [[EYE, tape]], gate_probability=0.999)
    state = f.start(PRIOR)
    events = [
        [[Observation(k, 0, [0.0], 0), Observation(k, 0, [30.0], 1)]]
        for k in range(1, 13)
    ]
    with pytest.warns(RuntimeWarning, match="last 10 of kind 'tape'") as caught:
        for k, value in enumerate(events, start=1):
            state = f.step(state, float(k), value)
    assert len(caught) == 1
    assert state.rejection_streaks.tolist() == [[[0.0, 12.0, 0.0]]]
    # In one step two of one sensor that are both rejected count twice; one that passes ends it.
    pair = [[Observation(13.0, 0, [v], 1) for v in (30.0, 31.0)]]
    state = f.step(state, 13.0, pair)
    assert state.rejection_streaks[0, 0, 1] == 14
    for values in ((30.0, 0.0), (0.0, 30.0)):
        pair = [[Observation(14.0, 0, [v], 1) for v in values]]
        assert f.step(state, 14.0, pair).rejection_streaks[0, 0, 1] == 0


def test_each_run_and_each_agent_counts_for_itself() -> None:
    """Agents hear each other: agent 0's belief is lost in one of two runs, agent 1's in none."""
    f = filters.GaussianFilter(
        WALK,
        [None, EYE],
        graphs.path(2),
        gate_probability=0.999,
    )
    # By run and agent
    means = np.array([[[0.0], [0.0]], [[50.0], [0.0]]])
    state = f.start(PRIOR, runs=(2,)).replace(joint_means=means)
    with pytest.warns(RuntimeWarning, match=f"{MESSAGE} from agent 1:") as caught:
        for k in range(1, 12):
            state = f.step(state, float(k), [None, np.array([[0.0], [0.0]])])
    assert len(caught) == 1
    # By run, agent and source; only agent 1 observes.
    by_source = state.rejection_streaks[..., 0].tolist()
    assert by_source == [[[0.0, 0.0], [0.0, 0.0]], [[0.0, 11.0], [0.0, 0.0]]]


@pytest.mark.parametrize("lag", [0, 2])
@pytest.mark.parametrize("comes_along", [False, True])
def test_good_observations_of_others_do_not_hide_a_bad_source(
    lag: int, comes_along: bool
) -> None:
    """Two agents with one kind of sensor share their observations: agent 1's is always far off.

    The numbers of the two alternate in every agent's list, so that counted together each good one
    would end the streak. With a lag every observation of agent 1 comes late by one step.
    """
    sensor = EYE if comes_along else 0
    sensors = [None, None] if comes_along else [EYE, EYE]
    f = filters.GaussianFilter(
        WALK, sensors, graphs.path(2), gate_probability=0.999, lag=lag
    )
    state = f.start(PRIOR)
    messages = []
    for k in range(1, 14):
        good = Observation(float(k), 0, [0.0], sensor)
        bad = Observation(float(k), 1, FAR, sensor)
        now = [[good], [bad]]
        delayed = []
        if lag:
            now = [[good], []]
            delayed = [Observation(k - 1.0, 1, FAR, sensor)] if k > 1 else []
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            state = f.step(state, float(k), now, delayed=delayed)
        messages += [(k, str(one.message)) for one in caught]
    ((when, text),) = messages
    assert when == (LIMIT + 1 if lag else LIMIT)
    assert f"agent 0's has rejected the last {LIMIT}" in text
    assert "from agent 1:" in text
    # Both reject every one of agent 1's, and none of agent 0's.
    by_source = state.rejection_streaks.sum(axis=-1).tolist()
    assert by_source == [[0.0, 12.0 if lag else 13.0]] * 2


def test_an_own_sensor_is_told_without_a_source() -> None:
    f = filters.GaussianFilter(
        WALK, [EYE, None], graphs.path(2), gate_probability=0.999
    )
    with pytest.warns(RuntimeWarning, match=f"{MESSAGE}: the belief"):
        f.run(f.start(PRIOR), np.arange(1.0, 13.0), [np.full((12, 1), 40.0), None])


@pytest.mark.parametrize("shares", [False, True])
def test_the_state_before_a_step_keeps_its_count(shares: bool) -> None:
    f = filters.GaussianFilter(
        WALK,
        [EYE, EYE],
        graphs.path(2),
        gate_probability=0.999,
        share_observations=shares,
    )
    before = f.step(f.start(PRIOR), 1.0, [FAR, NEAR])
    # Two steps from one state do not count on.
    first = f.step(before, 2.0, [FAR, NEAR]).rejection_streaks
    second = f.step(before, 2.0, [FAR, NEAR]).rejection_streaks
    assert before.rejection_streaks.max() == 1
    assert (first == second).all()
    assert first.max() == 2


def test_sensors_that_come_with_observations_are_counted_together() -> None:
    """A beacon that moves is a new sensor each time."""
    f = filters.GaussianFilter(WALK, [[]], gate_probability=0.999)
    state = f.start(PRIOR)
    with pytest.warns(RuntimeWarning, match="last 10 of kind 'component'") as caught:
        for k in range(1, 13):
            beacon = component([0], std=0.1 + 0.01 * k)
            state = f.step(state, float(k), [[Observation(k, 0, FAR, beacon)]])
    assert len(caught) == 1


def test_what_cannot_be_seen_is_not_rejected() -> None:
    blind = Sensor(1, lambda x: np.full_like(x, np.nan), [[1.0]])
    f = filters.ParticleFilter(WALK, [blind], gate_probability=0.999, members=50)
    state = f.start(PRIOR, rng=np.random.default_rng(0))
    with pytest.warns(RuntimeWarning, match="no particle can see"):
        for k in range(1, 13):
            state = f.step(state, float(k), [[1.0]])
    assert not state.rejection_streaks.any()


def test_one_that_cannot_be_seen_ends_no_row_of_rejections() -> None:
    blind = Sensor(1, lambda x: np.full_like(x, np.nan), [[1.0]])
    f = filters.GaussianFilter(WALK, [[]], gate_probability=0.999)
    state = f.start(PRIOR)
    sensors = [EYE] * 6 + [blind] + [EYE] * 3
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="observations must be predicted")
        for k, sensor in enumerate(sensors, start=1):
            seen = [[Observation(k, 0, FAR, sensor)]]
            state = f.step(state, float(k), seen)
    # Six rejections, one that is not seen, and three more
    assert state.rejection_streaks.tolist() == [[[9.0]]]


def test_a_reset_begins_anew() -> None:
    f, state = make("extended")
    _, state = steps_until_warned(f, state, [[FAR]] * 9)
    state = f.reset(state, [0], [0.0], [[1.0]])
    # Nine before it and nine after it are no ten in a row.
    assert steps_until_warned(f, state, [[FAR]] * 9)[0] == []
    # A filter of other sensors counts from zero.
    other = filters.GaussianFilter(
        WALK, [[EYE, component([0], std=2.0)]], gate_probability=0.9
    )
    seen = [[Observation(20.0, 0, FAR, 0)]]
    streaks = other.step(state, 20.0, seen).rejection_streaks
    assert streaks.tolist() == [[[1.0, 0.0, 0.0]]]


def test_the_covariance_of_a_lost_track_stays_small_as_the_warning_says() -> None:
    """robot_localization 417: all are rejected; the mean stays, the variance is a sum of noises."""
    f, state = make("extended")
    seen = np.full((20, 1), 40.0)
    with pytest.warns(RuntimeWarning, match="lost its target"):
        run = f.run(state, np.arange(1.0, 21.0), [seen])
    assert run["rejected"].values.sum() == 20
    assert (run["mean"].values == 0).all()
    assert np.isclose(run["variance"].values[-1, 0, 0], 1 + 20 * 0.01)


def test_a_run_that_has_failed_rejects_nothing() -> None:
    """It is left alone: no count, and no warning after ten."""
    f = filters.GaussianFilter(WALK, [EYE], gate_probability=0.999, on_error="keep")
    start = f.start(PRIOR, runs=(2,))
    start = start.replace(failed=np.array([False, True]))
    times = np.arange(1.0, LIMIT + 3.0)
    # By time and run: near in the first, far in the second
    values = np.tile(np.array([NEAR, FAR]), (times.size, 1, 1))
    with warnings.catch_warnings(action="error"):
        run = f.run(start, times, [values])
    # As its scores, the counts of a failed run are unknown; the other run rejects nothing.
    assert (run["rejected"].values[:, 0] == 0).all()
    for name in ("rejected", "unseen"):
        assert np.isnan(run[name].values[:, 1]).all()


def test_a_healthy_run_is_not_bothered() -> None:
    """A gate of 0.9 rejects one in ten: ten in a row have a chance of 1e-10 a step."""
    rng = np.random.default_rng(0)
    f = filters.GaussianFilter(WALK, [EYE], gate_probability=0.9)
    x = np.cumsum(0.1 * rng.standard_normal(800))
    y = x + 0.3 * rng.standard_normal(800)
    with warnings.catch_warnings(action="error"):
        run = f.run(f.start(PRIOR), np.arange(1.0, 801.0), [y[:, None]])
    # 80 of 800 are expected, with a standard deviation of sqrt(800 * 0.1 * 0.9) = 8.5.
    assert 40 < run["rejected"].values.sum() < 130
