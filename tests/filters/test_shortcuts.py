"""Shortcuts of a step change no number: each beside the long way."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from distfilt.filters import FilterError, GaussianFilter, Observation
from distfilt.filters.step import group_agents
from distfilt.linalg import factor
from distfilt.models import Model, constant_velocity
from distfilt.network import Channel, graphs
from distfilt.network.fusion import _invert
from distfilt.periods import align
from distfilt.sensors import Sensor, bearing, component, distance, range_bearing
from distfilt.validation import check_positive_semidefinite

PRIOR = (np.array([3.0, 4.0, 0.1, 0.2]), np.diag([1.0, 2.0, 0.1, 0.3]))


def test_noise_is_checked_without_a_factor() -> None:
    """A Gaussian filter never uses the factor of Q, which is still refused if it is indefinite."""
    wrong = Model(
        2, lambda x, t, dt: x, lambda t, dt: np.array([[0.0, 1.0], [1.0, 0.0]])
    )
    with pytest.raises(ValueError, match="noise_cov must be a positive semidefinite"):
        wrong.Q(0.0, 1.0)
    right = Model(3, lambda x, t, dt: x, lambda t, dt: dt * np.diag([1.0, 0.0, 4.0]))
    q = right.Q(0.0, 0.25)
    np.testing.assert_array_equal(q, np.diag([0.25, 0.0, 1.0]))
    np.testing.assert_array_equal(right.noise_sqrt(0.0, 0.25), factor(q))
    assert not q.flags.writeable


@pytest.mark.parametrize(
    ("matrix", "is_refused"),
    [
        (np.diag([1.0, 0.0, 2.0]), False),
        (np.zeros((3, 3)), False),
        (np.ones((3, 3)), False),
        # A covariance with a component that has no variance.
        (np.array([[1.0, 0.1, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 1.0]]), True),
        # Diagonal, but for the entries beside the diagonal.
        (np.array([[1.0, 2.0], [2.0, 1.0]]), True),
        (np.array([[1.0, 0.0], [1.0, 1.0]]), True),
        # Indefinite beside a constant.
        (np.array([[1.0, 0.0, 2.0], [0.0, 0.0, 0.0], [2.0, 0.0, 1.0]]), True),
        (np.diag([1.0, 0.0, -1.0]), True),
    ],
)
def test_constants_are_no_excuse(matrix: np.ndarray, is_refused: bool) -> None:
    """Zero rows are left out of the check, and nothing else."""
    if not is_refused:
        check_positive_semidefinite(matrix, "Q")
        return
    with pytest.raises(ValueError, match="Q must be a (positive semidef|symmetric)"):
        check_positive_semidefinite(matrix, "Q")


def test_values_near_a_reference_stay_the_same_object() -> None:
    """Half a period and more turns; less does not, and NaN stays."""
    periods = (2.0, None)
    near = np.array([[0.99, 7.0], [-0.99, -7.0]])
    assert align(near, np.zeros(2), periods) is near
    turned = align(np.array([[1.5, 7.0], [-1.5, 7.0]]), np.zeros(2), periods)
    assert turned[:, 0].tolist() == [-0.5, 0.5]
    far = np.array([[1.01, 7.0], [-1.0, 7.0], [-1.01, 7.0], [np.nan, 7.0]])
    expected = [[-0.99, 7.0], [-1.0, 7.0], [0.99, 7.0], [np.nan, 7.0]]
    np.testing.assert_allclose(align(far, np.zeros(2), periods), expected, rtol=1e-15)


def test_agents_side_by_side_are_a_view() -> None:
    """Neighbouring numbers of agents are a slice, others an index; both are the same agents."""
    sensor = component([0], std=1.0)
    every = np.arange(5)
    for agents, is_slice in (([1, 2, 3], True), ([4], True), ([0, 2], False)):
        pairs: list[list[tuple[Sensor, np.ndarray]]] = [[] for _ in every]
        for agent in agents:
            pairs[agent] = [(sensor, np.array([1.0]))]
        (group,) = group_agents(pairs)
        assert isinstance(group.rows, slice) == is_slice
        assert every[group.rows].tolist() == agents == group.agents.tolist()


def test_a_view_does_not_change_the_state_before() -> None:
    """An update in place must not reach the state that the step began with."""
    f = GaussianFilter(
        constant_velocity(sigma=0.1),
        [distance([0, 1], std=0.1)] * 4,
        share_observations=False,
    )
    state = f.step(f.start(PRIOR), 1.0, [None] * 4)
    kept = state.means.copy(), state.covariances.copy()
    for t in (1.0, 2.0):
        f.step(state, t, [None, [4.0], [5.0], None])
        np.testing.assert_array_equal(state.means, kept[0])
        np.testing.assert_array_equal(state.covariances, kept[1])


def test_agents_that_update_together_do_as_they_do_alone() -> None:
    """Three agents side by side, and each in a filter of its own."""
    model = constant_velocity(sigma=0.1)
    sensors = [range_bearing([0, 1], std=(0.1, 0.02), origin=(k, -k)) for k in range(5)]
    together = GaussianFilter(model, sensors, share_observations=False)
    seen = [None, [4.2, 0.8], [5.1, 1.0], [6.3, 1.1], None]
    state = together.step(together.start(PRIOR), 0.5, seen)
    for agent, (sensor, value) in enumerate(zip(sensors, seen, strict=True)):
        alone = GaussianFilter(model, [sensor])
        expected = alone.step(alone.start(PRIOR), 0.5, [value])
        np.testing.assert_allclose(
            state.means[agent], expected.means[0], rtol=1e-13, atol=1e-14
        )
        np.testing.assert_allclose(
            state.covariances[agent], expected.covariances[0], rtol=1e-12, atol=1e-14
        )


@pytest.mark.parametrize("turns", [0, 1])
def test_bearings_of_several_sensors_turn_as_each_alone(turns: int) -> None:
    """Across the cut at 180 degrees, with a sensor of another kind in the same group."""
    model = constant_velocity(sigma=0.1)
    sensors: list[Sensor] = [
        bearing([0, 1], std=0.1, origin=(9.0, 4.2 - k)) for k in (0, 1)
    ]
    sensors.append(component([0], std=0.1))
    assert sensors[0].predict(PRIOR[0]) < 0 < sensors[1].predict(PRIOR[0])
    angle = np.pi - 0.02 + 2 * np.pi * turns
    seen = [[angle], [angle], [3.1]]
    together = GaussianFilter(model, sensors, share_observations=False)
    state = together.step(together.start(PRIOR), 0.5, seen)
    for agent, (sensor, value) in enumerate(zip(sensors, seen, strict=True)):
        alone = GaussianFilter(model, [sensor])
        expected = alone.step(alone.start(PRIOR), 0.5, [value])
        moved = np.abs(expected.means[0] - PRIOR[0])
        assert moved.max() < 1.0
        np.testing.assert_allclose(
            state.means[agent], expected.means[0], rtol=1e-13, atol=1e-14
        )


@pytest.mark.parametrize("n", [3, 30])
def test_few_matrices_are_inverted_as_many_are(n: int) -> None:
    """One by one, or row after row; a single one that is indefinite is an error."""
    draw = np.random.default_rng(3).standard_normal((n, 4, 4))
    matrices = draw @ draw.mT + np.eye(4)
    inverses = _invert(matrices)
    np.testing.assert_allclose(
        inverses @ matrices, np.broadcast_to(np.eye(4), (n, 4, 4)), atol=1e-12
    )
    matrices[1] *= -1
    with pytest.raises(np.linalg.LinAlgError):
        _invert(matrices)


def test_messages_of_some_agents_are_charged_one_by_one() -> None:
    """Agent 0 of a star sends three numbers to each of four, agent 2 two; the others are silent."""
    channel = Channel(graphs.star(5))
    channel.broadcast([np.zeros(3), None, np.zeros(2), None, None])
    ledger = channel.ledger
    assert ledger.messages.tolist() == [4, 0, 1, 0, 0]
    assert ledger.scalars.tolist() == [12, 0, 2, 0, 0]
    assert ledger.bytes.tolist() == [96, 0, 16, 0, 0]
    assert ledger.transmissions.tolist() == [1, 0, 1, 0, 0]
    assert ledger.broadcast_scalars.tolist() == [3, 0, 2, 0, 0]
    assert ledger.broadcast_bytes.tolist() == [24, 0, 16, 0, 0]
    assert ledger.rounds == 1


@pytest.mark.parametrize("has_graph", [False, True])
def test_the_record_counts_each_step(has_graph: bool) -> None:
    """Silent steps keep the ledger, which is recorded in each of them."""
    graph = graphs.path(2) if has_graph else None
    f = GaussianFilter(
        constant_velocity(sigma=0.1),
        [component([0], std=1.0)] * 2,
        graph,
        share_observations=has_graph,
    )
    series = np.ones((3, 1))
    run = f.run(f.start(PRIOR), [1.0, 2.0, 3.0], [series, series])
    assert run["messages"].values.tolist() == [[has_graph] * 2] * 3
    expected = [[k * has_graph] * 2 for k in (1, 2, 3)]
    assert run["scalars_total"].values.tolist() == expected


def _events(values: Any, **changes: Any) -> list[Observation]:
    return [Observation(1.0, 0, values, **changes)]


@pytest.mark.parametrize(
    ("events", "words"),
    [
        (_events([1.0, 2.0]), "must have shape"),
        (_events([1.0], sensor=1), "of one of the 1 sensors"),
        (_events([1.0], arrival_time=2.0), "must have arrived by"),
        ([Observation(2.0, 0, [1.0])], "at t = 2"),
        ([Observation(1.0, 1, [1.0])], "of agent 1"),
    ],
)
def test_events_that_do_not_fit_are_refused(events: Any, words: str) -> None:
    """The short way is for complete observations only; all others meet the checks."""
    f = GaussianFilter(
        constant_velocity(sigma=0.1),
        [component([0], std=1.0)] * 2,
        share_observations=False,
    )
    with pytest.raises((ValueError, FilterError), match=words):
        f.step(f.start(PRIOR), 1.0, [events, []])


def test_an_event_has_the_size_of_its_own_sensor() -> None:
    """Of an agent with sensors of two numbers and of one, in either order."""
    sensors = [component([0, 1], std=1.0), component([2], std=1.0)]
    for k, team in enumerate((sensors, sensors[::-1])):
        f = GaussianFilter(constant_velocity(sigma=0.1), [team])
        start = f.start(PRIOR)
        for value, number in (([1.0], k), ([1.0, 2.0], 1 - k)):
            event = Observation(1.0, 0, value, number)
            with pytest.raises(ValueError, match="must have shape"):
                f.step(start, 1.0, [[event]])
            with pytest.raises(ValueError, match="must have shape"):
                f.run(start, None, [event])


def test_an_event_that_arrives_later_is_refused_however_it_comes() -> None:
    """Assimilated at its own time, it would be used before anybody knows it."""
    f = GaussianFilter(
        constant_velocity(sigma=0.1),
        [component([0], std=1.0)] * 2,
        share_observations=False,
    )
    start = f.start(PRIOR)
    (late,) = _events([1.0], arrival_time=2.0)
    calls = (
        lambda: f.step(start, 1.0, [[late], []]),
        lambda: f.step(start, 1.0, [late]),
        lambda: f.run(start, None, [late]),
        lambda: f.run(start, [1.0, 3.0], [late]),
        lambda: f.run(start, [1.0], [[[late]], None]),
        lambda: list(f.steps(start, None, [late])),
    )
    for call in calls:
        with pytest.raises(ValueError, match="must have arrived by t = 1"):
            call()


@pytest.mark.parametrize("missing", [1.0, np.nan])
def test_infinity_is_no_observation_however_it_comes(missing: float) -> None:
    """Also beside another number that is there, or missing."""
    f = GaussianFilter(constant_velocity(sigma=0.1), [component([0, 1], std=1.0)])
    start = f.start(PRIOR)
    value = [np.inf, missing]
    calls = (
        lambda: f.step(start, 1.0, [value]),
        lambda: f.step(start, 1.0, [_events(value)]),
        lambda: f.run(start, None, _events(value)),
        lambda: f.run(start, [1.0], [[value]]),
    )
    for call in calls:
        with pytest.raises(ValueError, match="must .*finite"):
            call()


def test_a_missing_event_needs_no_label() -> None:
    """The other one is then the only one, of the agent's first sensor: one number is sent."""
    team = [[component([0], std=1.0), component([1], std=1.0)], None]
    f = GaussianFilter(constant_velocity(sigma=0.1), team, graphs.path(2))
    start = f.start(PRIOR)
    events = [Observation(1.0, 0, [0.3]), Observation(1.0, 0, [np.nan], 1)]
    state = f.step(start, 1.0, [events, None])
    assert state.ledger.scalars.tolist() == [1, 0]
    run = f.run(start, None, events)
    assert run["scalars"].values.tolist() == [[1, 0]]


def test_a_missing_event_is_none() -> None:
    """An event of NaN alone changes nothing but the forecast."""
    f = GaussianFilter(constant_velocity(sigma=0.1), [component([0], std=1.0)])
    missing = f.step(f.start(PRIOR), 1.0, [_events([np.nan])])
    none = f.step(f.start(PRIOR), 1.0, [None])
    np.testing.assert_array_equal(missing.means, none.means)


def test_a_sensor_without_slope_is_left_out_and_a_faint_one_is_not() -> None:
    """A slope whose square underflows is still a slope; zero is none."""
    for slope, is_unseen in ((1e-170, False), (0.0, True)):
        faint = Sensor(
            1,
            lambda x, slope=slope: slope * x[..., :1],
            [[1.0]],
            derivative=lambda x, slope=slope: slope * np.eye(1, 4),
        )
        f = GaussianFilter(constant_velocity(sigma=0.1), [faint])
        state = f.start(PRIOR)
        if is_unseen:
            with pytest.warns(RuntimeWarning, match="singular point"):
                state = f.step(state, 0.0, [[1.0]])
        else:
            state = f.step(state, 0.0, [[1.0]])
        assert (state.unseen is not None) == is_unseen
