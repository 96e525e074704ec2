"""What came twice counts once; weights, angles and times that are given in another scale.

==================================  ==========================================================
Report                              Situation
==================================  ==========================================================
robot_localization issue 336        messages with the same time stamp come twice
robot_localization issue 451        a measurement of a time that was processed already
mcstate issue 75, figaro issue 175  weights in place of their logarithms
MSS pull 18, filterpy issue 305     degrees in place of radians
fuse pull 74                        a start at time 0, and a first time of the clock
ultralytics pull 25499              a copy that went through single precision
Sendspin pull 119                   a copy whose time has been rounded
kalmanjs issue 33,                  times of a clock in nanoseconds or milliseconds
BLE-Indoor-Positioning issue 31
Stone-Soup issue 195                dates and durations in place of seconds
own                                 a delayed copy, a copy after saving, a second sensor
==================================  ==========================================================
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import coupling
from distfilt.filters import (
    EnsembleFilter,
    GaussianFilter,
    InformationIncrementFilter,
    MixtureFilter,
    Observation,
    ParticleFilter,
    TransportFilter,
)
from distfilt.kalman import QuaternionChart, mekf
from distfilt.models import constant_velocity, satellite_pose, simulate
from distfilt.network import graphs
from distfilt.sensors import (
    Sensor,
    bearing,
    component,
    distance,
    line_angle,
    range_bearing,
    stack,
)
from distfilt.updates import effective_size
from tests.filters.families import still_model

WALK = constant_velocity(sigma=0.3, axes=1)
EYE = component([0], std=0.5)
PRIOR = (np.zeros(2), np.eye(2))
FAMILIES: dict[str, Callable[..., Any]] = {
    "gaussian": GaussianFilter,
    "gaussian, unscented": partial(GaussianFilter, linearization="unscented"),
    "ensemble": partial(EnsembleFilter, members=50),
    "ensemble, exact": partial(EnsembleFilter.exact, members=50),
    "particle": partial(ParticleFilter, members=500),
    "transport": partial(TransportFilter, members=40),
    "mixture": partial(MixtureFilter, target_dim=1),
}
EACH = pytest.mark.parametrize("family", FAMILIES)
TWICE = "observations must differ to count each"


def start_of(f: Any, **options: Any) -> Any:
    return f.start(PRIOR, rng=np.random.default_rng(0), **options)


def means(f: Any, state: Any) -> np.ndarray:
    return np.asarray(f.summarize(state).mean)


# Twice ---------------------------------------------------------------------------------


@EACH
@pytest.mark.parametrize("copied", [lambda o: o, copy.copy, copy.deepcopy])
@pytest.mark.parametrize("way", ["events", "step"])
def test_the_same_observation_twice(family: str, copied: Any, way: str) -> None:
    """The result is that of one of them, to the bit, and one warning says so."""
    f = FAMILIES[family](WALK, [EYE])
    one = Observation(1.0, 0, [0.3])
    start = start_of(f)

    def assimilate(entries: list[Observation]) -> np.ndarray:
        if way == "step":
            return means(f, f.step(start, 1.0, [entries]))
        return np.asarray(f.run(start, None, entries)["mean"].values[-1])

    once = assimilate([one])
    with pytest.warns(RuntimeWarning, match=TWICE) as caught:
        twice = assimilate([one, copied(one)])
    assert len(caught) == 1
    assert (twice == once).all()


def test_a_value_that_is_seen_again_at_another_time_counts() -> None:
    """Of a state at rest: with R = P = 1 the mean is the sum of n values over n + 1."""
    f = GaussianFilter(still_model(1), [[EYE, component([0], std=1.0)]], lag=3)
    scale = EYE.noise_cov[0, 0]
    state = f.start(([0.0], [[scale]]))
    with warnings.catch_warnings(action="error"):
        state = f.step(state, 1.0, [[Observation(1.0, 0, [0.3])]])
        # Beside another observation, and beside a late one
        both = [Observation(2.0, 0, [0.3]), Observation(2.0, 0, [0.7], 1)]
        state = f.step(state, 2.0, [both])
        late = Observation(2.0, 0, [0.9])
        state = f.step(state, 3.0, [[Observation(3.0, 0, [0.3])]], delayed=[late])
    # m = Σ y/R / (1/P₀ + Σ 1/R): four values of R = P₀, and 0.7 of R = 1
    values = np.array([0.3, 0.3, 0.3, 0.9])
    precision = 1 / scale + values.size / scale + 1.0
    information = values.sum() / scale + 0.7
    expected = information / precision
    assert np.isclose(state.means[0, 0], expected, rtol=1e-9)


@EACH
def test_a_step_that_is_repeated_at_its_own_time(family: str) -> None:
    f = FAMILIES[family](WALK, [EYE])
    state = f.step(start_of(f), 1.0, [[0.3]])
    with pytest.warns(RuntimeWarning, match="sensor 0 at t = 1 s twice"):
        repeated = f.step(state, 1.0, [np.array([0.3])])
    # A second step to the same time, without an observation
    nothing = f.step(state, 1.0, [None])
    assert (means(f, repeated) == means(f, nothing)).all()
    # Another observation of that time in between does not make it a new one.
    between = f.step(state, 1.0, [[0.8]])
    with pytest.warns(RuntimeWarning, match="sensor 0 at t = 1 s twice"):
        repeated = f.step(between, 1.0, [np.array([0.3])])
    nothing = f.step(between, 1.0, [None])
    assert (means(f, repeated) == means(f, nothing)).all()


@pytest.mark.parametrize(
    "family", ["gaussian", "ensemble", "particle", "transport", "gaussian, unscented"]
)
def test_a_delayed_copy(family: str, tmp_path: Any) -> None:
    """Also after saving, and of one that was delayed itself."""
    f = FAMILIES[family](WALK, [EYE], lag=3)
    one = Observation(1.0, 0, [0.3])
    value = np.array([0.3])
    state = f.step(start_of(f), 1.0, [value])
    value[0] = 9.0  # the user's array may be used again
    state.save(tmp_path / "state.npz")
    state = type(state).load(tmp_path / "state.npz")
    # The copy of an observation that the state has had changes nothing.
    plain = f.step(state, 2.0, [[0.5]])
    with pytest.warns(RuntimeWarning, match=TWICE):
        state = f.step(state, 2.0, [[0.5]], delayed=[one])
    assert (means(f, state) == means(f, plain)).all()
    # The warning is given once in a chain of states.
    with warnings.catch_warnings(action="error"):
        state = f.step(state, 2.5, [None], delayed=[one])
    # One that comes late twice: in one step, and in two
    other = Observation(2.0, 0, [0.7])
    start = f.step(start_of(f), 2.0, [None])
    once = f.step(start, 3.0, [None], delayed=[other])
    with pytest.warns(RuntimeWarning, match=TWICE):
        twice = f.step(start, 3.0, [None], delayed=[other, copy.copy(other)])
    assert (means(f, once) == means(f, twice)).all()
    with pytest.warns(RuntimeWarning, match=TWICE):
        later = f.step(once, 3.5, [None], delayed=[other])
    plain = f.step(once, 3.5, [None])
    assert (means(f, later) == means(f, plain)).all()


def test_a_network_that_delivers_twice() -> None:
    """Events of a run with delayed copies; agents share what they observe."""
    f = GaussianFilter(WALK, [EYE, EYE], graphs.path(2), lag=3)
    events = [Observation(float(t), t % 2, [0.1 * t]) for t in range(1, 6)]
    times = np.arange(1.0, 6.0)
    expected = f.run(start_of(f), times, events)
    # Copies of the first three come two steps later, and one event is in the list twice.
    late = [o.replace(arrival_time=o.t + 1.5) for o in events[:3]]
    with pytest.warns(RuntimeWarning, match=TWICE):
        run = f.run(start_of(f), times, [*events, events[1]], delayed=late)
    assert (run["mean"].values == expected["mean"].values).all()
    assert (run["variance"].values == expected["variance"].values).all()


def test_increments_of_what_came_twice() -> None:
    f = InformationIncrementFilter(WALK, [EYE] * 2, graphs.path(2), target_dim=2)
    one = Observation(1.0, 0, [0.3])
    expected = means(f, f.step(start_of(f), 1.0, [one, None]))
    with pytest.warns(RuntimeWarning, match=TWICE):
        twice = means(f, f.step(start_of(f), 1.0, [[one, one], None]))
    assert (twice == expected).all()


def test_two_that_differ_count_both() -> None:
    """Another value, sensor, time, agent, or another place of a sensor that comes along."""
    f = GaussianFilter(WALK, [[EYE, EYE], EYE], share_observations=False, lag=2)
    pairs = [
        (Observation(1.0, 0, [0.3]), Observation(1.0, 0, [0.31])),
        (Observation(1.0, 0, [0.3]), Observation(1.0, 0, [0.3], 1)),
        (
            Observation(1.0, 0, [0.5], distance([0], std=0.5, origin=[-1.0])),
            Observation(1.0, 0, [0.5], distance([0], std=0.5, origin=[1.0])),
        ),
    ]
    with warnings.catch_warnings(action="error"):
        for pair in pairs:
            of_one = f.step(start_of(f), 1.0, [[pair[0]], None]).covariances[0]
            of_two = f.step(start_of(f), 1.0, [list(pair), None]).covariances[0]
            assert np.trace(of_two) < np.trace(of_one)
        # The same value of another agent, and of another time
        state = f.step(start_of(f), 1.0, [pairs[0][0], [0.3]])
        f.step(state, 2.0, [Observation(2.0, 0, [0.3]), [0.3]])
    # Two sensors that are made alike are one sensor.
    sensor = distance([0], std=0.5, origin=[-1.0])
    twin = distance([0], std=0.5, origin=[-1.0])
    entries = [Observation(1.0, 0, [0.5], s) for s in (sensor, twin)]
    with pytest.warns(RuntimeWarning, match="'?distance sensor"):
        f.step(start_of(f), 1.0, [entries, None])


# Likelihoods for log-weights ---------------------------------------------------------------


LIKELIHOODS = [
    [0.9, 0.0001, 0.02, 0.03],
    [0.75, 0.25],
    [0.5, 0.3, 0.2],
    [3.9, 1e-3, 0.02, 0.0, 0.1],
]


def members_of(weights: np.ndarray) -> np.ndarray:
    """Return members 0, 1, 2, ... of one component, one for each weight."""
    places = np.arange(float(len(weights)))
    return places[:, None]


def correct_members(weights: np.ndarray) -> np.ndarray:
    x = members_of(weights)
    return coupling.correct_moments(x, x, weights)


@pytest.mark.parametrize("values", LIKELIHOODS)
@pytest.mark.parametrize(
    "call",
    [
        effective_size,
        lambda w: coupling.transform_ensemble(members_of(w), w),
        lambda w: coupling.transport_plans(members_of(w), w),
        correct_members,
    ],
)
def test_likelihoods_in_place_of_logarithms(call: Any, values: list[float]) -> None:
    weights = np.array(values)
    with pytest.warns(RuntimeWarning, match="log_weights must be logarithms"):
        call(weights)
    # Also where they no longer sum to exactly one
    almost = weights * (1 - 1e-6)
    with pytest.warns(RuntimeWarning, match="log_weights must be logarithms"):
        call(almost)


@pytest.mark.parametrize(
    "logs",
    [
        np.log([0.5, 0.25, 0.25]),
        np.zeros(4),
        np.full(3, 0.3),
        [0.0, -1.0, -1e4],
        # Densities of a small noise are high, and their logarithms positive.
        18.0 - 0.5 * np.linspace(0.0, 3.0, 20) ** 2,
        [1.4, -3.0, 0.2],
    ],
)
def test_logarithms_of_any_normalisation_are_not_doubted(logs: Any) -> None:
    with warnings.catch_warnings(action="error"):
        effective_size(np.asarray(logs))


# Degrees for radians -----------------------------------------------------------------------


STILL = still_model(2, rate=0.01)
ANGLES = {
    "bearing": (bearing([0, 1], std=0.05), [60.0]),
    "line": (line_angle([0, 1], std=0.05), [89.6]),
    "range": (range_bearing([0, 1], std=[0.5, 0.05]), [1.4, 53.0]),
    "stack": (
        stack([component([0], std=0.5), bearing([0, 1], std=0.05)]),
        [1.0, -120.0],
    ),
    "user's": (
        Sensor(
            1,
            lambda x: np.arctan2(x[..., 1:], x[..., :1]),
            [[0.01]],
            residual_function=lambda a, b: (a - b + np.pi) % (2 * np.pi) - np.pi,
        ),
        [53.0],
    ),
}
DEGREES = r"^observations\[0\] must be angles in rad"


@pytest.mark.parametrize("kind", ANGLES)
@pytest.mark.parametrize("n_sensors", [1, 2])
def test_degrees_in_every_way(kind: str, n_sensors: int) -> None:
    sensor, value = ANGLES[kind]
    sensors = sensor if n_sensors == 1 else [component([0], std=1.0), sensor]
    f = GaussianFilter(STILL, [sensors], lag=1)
    number = n_sensors - 1
    start = f.start(([1.0, 1.0], 0.1 * np.eye(2)))
    one = Observation(1.0, 0, value, number)
    later = f.step(start, 1.0, [None])
    calls = {
        "events": lambda: f.run(start, None, [one]),
        "step": lambda: f.step(start, 1.0, [[one]]),
        "list of times": lambda: f.run(start, [1.0], [[[one]]]),
        "steps": lambda: list(f.steps(start, [1.0], [[one]])),
        "delayed": lambda: f.step(later, 2.0, [None], delayed=[one]),
        "delayed in a run": lambda: f.run(
            start, [1.0, 2.0], [None], delayed=[one.replace(arrival_time=2.0)]
        ),
    }
    if n_sensors == 1:
        series = np.array([value])
        calls["array"] = lambda: f.run(start, [1.0], [series])
        calls["list of arrays"] = lambda: f.run(start, [1.0], [[value]])
        calls["value"] = lambda: f.step(start, 1.0, [value])
        calls["with a gap"] = lambda: f.run(
            start, [1.0, 2.0], [np.concatenate([np.nan * series, series])]
        )
    for name, call in calls.items():
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call()
        texts = [str(w.message) for w in caught]
        about_angles = [t for t in texts if t.startswith("observations[0] must be")]
        # One warning, whatever way the observation came
        assert len(about_angles) == 1, (name, texts)


def test_angles_that_are_right_are_not_doubted() -> None:
    """In radians of any turn, and in degrees where the sensor's differences are in degrees."""
    compass = Sensor(
        1,
        lambda x: np.degrees(np.arctan2(x[..., 1:], x[..., :1])),
        [[25.0]],
        residual_function=lambda a, b: (a - b + 180) % 360 - 180,
    )
    declared = compass.replace(residual_function=None, periods=(360.0,))
    radar = range_bearing([0, 1], std=[0.5, 0.05])
    # A range may be 900 m, and a bearing a little more than a turn.
    cases = [(compass, [280.0]), (declared, [280.0]), (radar, [900.0, -3.0])]
    cases.append((bearing([0, 1], std=0.1), [6.5]))
    for sensor, value in cases:
        f = GaussianFilter(STILL, [sensor])
        start = f.start(([1.0, -3.0], 0.1 * np.eye(2)))
        with warnings.catch_warnings(action="error"):
            f.step(start, 1.0, [value])
            f.run(start, None, [Observation(1.0, 0, value)])
            f.run(start, [1.0], [np.array([value])])


# Times of the clock ------------------------------------------------------------------------


NOW = 1.7e9
CLOCK = "must count from the time 0 of the start, got 1700000000.5 first"


@EACH
def test_a_clock_is_noticed_before_the_prior_is_lost(family: str) -> None:
    f = FAMILIES[family](WALK, [EYE])
    start = start_of(f)
    calls = [
        lambda: f.run(start, [NOW + 0.5, NOW + 1], [np.zeros((2, 1))]),
        lambda: f.run(start, None, [Observation(NOW + 0.5, 0, [0.1])]),
        lambda: f.step(start, NOW + 0.5, [[0.1]]),
        lambda: list(f.steps(start, [NOW + 0.5], [np.zeros((1, 1))])),
    ]
    for call in calls:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                call()
            except Exception as error:
                # An error that follows must print the time with all its digits.
                assert "1.7e+09" not in str(error)
        assert [CLOCK in str(w.message) for w in caught].count(True) == 1
    with warnings.catch_warnings(action="error"):
        f.step(start_of(f, t=NOW), NOW + 0.5, [[0.1]])


def test_seconds_of_a_week_beside_short_steps() -> None:
    f = GaussianFilter(WALK, [EYE])
    # Four days after the beginning of a week, as receivers count
    times = 345_600 + 0.1 * np.arange(5)
    with pytest.warns(RuntimeWarning, match="got 345600 first"):
        f.run(start_of(f), times, [np.zeros((5, 1))])
    with warnings.catch_warnings(action="error"):
        f.run(start_of(f), [500.0, 500.5, 501.0], [np.zeros((3, 1))])
        f.run(start_of(f, t=345_599.0), times, [np.zeros((5, 1))])


def test_clocks_elsewhere() -> None:
    with pytest.warns(RuntimeWarning, match=CLOCK):
        simulate(WALK, [0.0, 0.0], [NOW + 0.5], rng=np.random.default_rng(0))
    x = np.r_[np.zeros(6), [0.3, 0.2, 0.1], [1.0, 0.0, 0.0, 0.0]]
    pose = satellite_pose(rate=0.1, sigma=0.1)
    still = pose.replace(
        transition=lambda x, t, dt: x,
        noise_cov=lambda t, dt: np.zeros((13, 13)),
        derivative=None,
    )
    with pytest.warns(RuntimeWarning, match=CLOCK):
        mekf(
            x,
            0.01 * np.eye(12),
            np.zeros((1, 1)),
            chart=QuaternionChart(13, 9),
            model=still,
            sensors=[component([0], std=0.1)],
            times=[NOW + 0.5],
        )


def test_degrees_in_the_multiplicative_filter() -> None:
    x = np.r_[np.ones(3), np.zeros(6), [1.0, 0.0, 0.0, 0.0]]
    pose = satellite_pose(rate=0.1, sigma=0.1)
    with pytest.warns(
        RuntimeWarning, match="must be angles in rad, got some 7 turns off"
    ):
        mekf(
            x,
            0.01 * np.eye(12),
            np.array([[45.0]]),
            chart=QuaternionChart(13, 9),
            model=pose,
            sensors=[bearing([0, 1], std=0.1)],
            times=[0.1],
        )


def test_messages_print_such_times() -> None:
    f = GaussianFilter(WALK, [EYE], lag=2)
    state = f.step(start_of(f, t=NOW), NOW + 0.5, [[1.0]])
    now = Observation(NOW + 0.75, 0, [1.0])
    calls = {
        "delayed must .*, got 1699999999.25": lambda: f.step(
            state, NOW + 1, [None], delayed=[now.replace(t=NOW - 0.75)]
        ),
        "got 1700000000.5 after 1700000001": lambda: f.run(
            start_of(f, t=NOW), [NOW + 1, NOW + 0.5], [np.zeros((2, 1))]
        ),
        "at t = 1700000000.75": lambda: f.step(state, NOW + 1, [now]),
        "at least 1700000000.5": lambda: f.step(state, NOW, [None]),
        "time 1700000000.5 or later, got 1700000000.25": lambda: f.run(
            state, [NOW + 0.25], [None]
        ),
    }
    for text, call in calls.items():
        with pytest.raises(ValueError, match=text):
            call()
    assert repr(state) == "GaussianState(t=1700000000.5, 1 agents)"


# Copies that rounding has changed -----------------------------------------------------------


@EACH
@pytest.mark.parametrize("way", ["events", "step"])
def test_a_copy_in_single_precision_counts_once(family: str, way: str) -> None:
    f = FAMILIES[family](WALK, [EYE])
    value = np.array([0.3])
    single = value.astype(np.float32).astype(np.float64)
    one = Observation(1.0, 0, value)
    two = [one, one.replace(value=single)]
    once = means(f, f.step(start_of(f), 1.0, [[one]]))
    with pytest.warns(RuntimeWarning, match=TWICE):
        if way == "step":
            twice = means(f, f.step(start_of(f), 1.0, [two]))
        else:
            twice = f.run(start_of(f), None, two)["mean"].values[-1]
    assert np.array_equal(once, twice)


def test_two_that_are_close_both_count() -> None:
    """They differ by more than one is rounded by, or neither is in single precision."""
    f = GaussianFilter(WALK, [EYE])
    for other in (0.3 + 1e-9, 0.3 + 1e-6, 0.31):
        two = [Observation(1.0, 0, [0.3]), Observation(1.0, 0, [other])]
        with warnings.catch_warnings(action="error"):
            state = f.step(start_of(f), 1.0, [two])
        # 1/P = 1/(1 + 1 + .03) + 2/.25, with P of the step by hand: F F' + Q
        phi = WALK.F(1.0)
        predicted = phi @ phi.T + WALK.Q(0.0, 1.0)
        precision = 1 / predicted[0, 0] + 2 / 0.25
        variance = f.summarize(state).variance[0, 0]
        assert np.isclose(variance, 1 / precision)


@EACH
@pytest.mark.parametrize("gap", [1e-9, float(np.float32(1.1)) - 1.1])
def test_a_copy_with_a_rounded_time_is_told(family: str, gap: float) -> None:
    f = FAMILIES[family](WALK, [EYE])
    events = [Observation(t, 0, [0.3 * t]) for t in (1.1, 2.0, 3.0)]
    late = events[0].replace(t=1.1 + gap)
    with pytest.warns(RuntimeWarning, match="must have one time to count once"):
        f.run(start_of(f), None, [*events, late])
    # Another value, another sensor, or a longer time between: nothing is said.
    with warnings.catch_warnings(action="error"):
        f.run(start_of(f), None, [*events, late.replace(value=np.array([0.4]))])
        f.run(start_of(f), None, [*events, late.replace(t=1.2)])


@EACH
@pytest.mark.parametrize("later", [1.1 + 1e-9, float(np.float32(1.1)), 1.100004])
def test_a_copy_with_a_rounded_time_in_other_ways(family: str, later: float) -> None:
    """Arrays know how far apart the times usually are, single steps only two of them."""
    f = FAMILIES[family](WALK, [EYE])
    times = [1.1, later, 2.0, 3.0]
    values = np.array([[0.3], [0.3], [0.5], [0.6]])
    message = "must have one time to count once"
    with pytest.warns(RuntimeWarning, match=message):
        f.run(start_of(f), times, [values])
    with pytest.warns(RuntimeWarning, match=message):
        state = f.step(start_of(f), times[0], [values[0]])
        f.step(state, times[1], [values[1]])
    # Another value, one that is missing, or a longer time between: nothing is said.
    with warnings.catch_warnings(action="error"):
        f.run(start_of(f), times, [values + [[0.0], [0.1], [0.0], [0.0]]])
        f.step(state, times[1], [values[1] + 0.1])
        f.step(state, 1.2, [values[1]])
        f.step(f.step(start_of(f), 1.1, [[np.nan]]), later, [[np.nan]])


@EACH
def test_times_in_another_unit_are_told(family: str) -> None:
    f = FAMILIES[family](WALK, [EYE])
    for unit, factor in {"nano": 1e9, "micro": 1e6, "milli": 1e3}.items():
        with pytest.warns(
            RuntimeWarning, match=f"a Unix time in {unit}seconds would be"
        ):
            start_of(f, t=NOW * factor)
    with warnings.catch_warnings(action="error"):
        start_of(f, t=NOW)


def test_dates_are_refused_with_the_way_to_seconds() -> None:
    f = GaussianFilter(WALK, [EYE])
    start = start_of(f)
    now = np.datetime64("2024-03-10T01:00:00")
    dates = now + np.arange(1, 3).astype("timedelta64[s]")
    seconds = r"give seconds since the start, \(x - start\) / np.timedelta64\(1, .s.\)"
    calls = {
        seconds: [
            lambda: f.run(start, dates, [np.zeros((2, 1))]),
            lambda: f.step(start, now, [[0.0]]),
            lambda: Observation(now, 0, [0.0]),
            lambda: f.run(start, dates.astype(object), [np.zeros((2, 1))]),
        ],
        r"give seconds, x / np.timedelta64\(1, .s.\)": [
            lambda: f.run(start, dates - now, [np.zeros((2, 1))]),
            lambda: Observation(dates[0] - now, 0, [0.0]),
        ],
    }
    for text, ways in calls.items():
        for way in ways:
            with pytest.raises(ValueError, match=text):
                way()
