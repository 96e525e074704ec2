"""Results do not depend on names: of runs, agents, components, units and calls.

Every family runs on one problem without symmetries. Source: own.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from distfilt.filters import EnsembleFilter, Observation
from distfilt.models import Model
from distfilt.network import Faults, Graph

from .problems import (
    APART,
    CASES,
    TIMES,
    Q,
    assert_equal,
    build,
    differentiate_move,
    make_prior,
    make_problem,
    move,
    one_run,
    permute_agents,
    problem_of,
    record,
    transform,
)

each_case = pytest.mark.parametrize("name", CASES)
ignore_collapse = pytest.mark.filterwarnings(
    "ignore::distfilt.filters.ParticleCollapse"
)


@ignore_collapse
@pytest.mark.parametrize("name", [n for n, case in CASES.items() if case.runs])
def test_every_run_of_a_batch_is_that_run_alone(name: str) -> None:
    case = CASES[name]
    problem = problem_of(case, runs=2)
    batch = record(case, problem, runs=2)
    for run in range(2):
        alone = record(case, one_run(problem, run))
        assert_equal(batch.isel(run=run), alone)
        # Messages do not depend on the values, but on the entries that all runs miss.
        assert np.array_equal(batch["messages"], alone["messages"])


@ignore_collapse
@pytest.mark.parametrize("name", [n for n, case in CASES.items() if case.runs])
def test_a_batch_loses_the_messages_of_its_runs(name: str) -> None:
    """The first run of a batch loses the messages that a run alone loses, and the second others."""
    case = CASES[name]
    if case.prior == "common members":
        pytest.skip("members in common need every message")
    problem = problem_of(case, runs=2)
    # Both runs have the first one's observations, so that only their losses differ.
    same = [replace(e, value=e.value[[0, 0]]) for e in problem.events]
    faults = Faults(loss=0.4, seed=2)
    batch = record(case, replace(problem, events=same), runs=2, faults=faults)
    alone = record(case, one_run(problem, 0), faults=faults)
    assert_equal(batch.isel(run=0), alone)
    assert not np.allclose(batch["mean"][:, 0], batch["mean"][:, 1])


@ignore_collapse
@pytest.mark.parametrize("name", [n for n, case in CASES.items() if case.runs])
def test_the_number_of_runs_changes_no_loss(name: str) -> None:
    """The second run of two and of three loses the same messages, and not those of the first."""
    case = CASES[name]
    if case.prior == "common members":
        pytest.skip("members in common need every message")
    problem = problem_of(case, runs=3)
    faults = Faults(loss=0.4, seed=2)
    three = record(case, problem, runs=3, faults=faults)
    first_two = [replace(e, value=e.value[:2]) for e in problem.events]
    two = record(case, replace(problem, events=first_two), runs=2, faults=faults)
    assert_equal(three.isel(run=slice(2)), two)
    # The second run, without its losses, is another one.
    perfect = record(case, replace(problem, events=first_two), runs=2)
    assert not np.allclose(two["mean"][:, 1], perfect["mean"][:, 1])


@ignore_collapse
@each_case
def test_observations_mean_the_same_in_every_form(name: str) -> None:
    """A list of events, an array for each agent, and values or events step by step."""
    case = CASES[name]
    runs = 2 if case.runs else 0
    problem = problem_of(case, runs=runs)
    # Arrays are of agents with one sensor.
    single = []
    for sensors in problem.sensors:
        single.append(sensors[0] if isinstance(sensors, list) else sensors)
    events = [e for e in problem.events if e.sensor == 0]
    problem = replace(problem, sensors=single, events=events)
    arrays: list[Any] = []
    for agent in range(len(single)):
        values = [e.value for e in events if e.agent == agent]
        arrays.append(np.array(values) if values else None)
    by_events = record(case, problem, runs=runs)
    f = build(case, problem)
    start = f.start(
        make_prior(case, problem),
        rng=np.random.default_rng(0),
        runs=(runs,) if runs else (),
    )
    by_arrays = f.run(start, TIMES, arrays)
    # The same bits: both ways end in the same steps.
    assert_equal(by_arrays, by_events, atol=0.0)
    with_values = start
    with_events = start
    for k, t in enumerate(TIMES):
        values = [None if series is None else series[k] for series in arrays]
        with_values = f.step(with_values, t, values)
        now = [e for e in events if e.t == t]
        lists = [[e for e in now if e.agent == agent] for agent in range(len(single))]
        with_events = f.step(with_events, t, lists)
    expected = by_events.isel(time=-1)
    for state in (with_values, with_events):
        summary = f.summarize(state)
        assert np.allclose(summary.mean, expected["mean"], rtol=0, atol=1e-12)
        assert np.allclose(summary.variance, expected["variance"], rtol=0, atol=1e-12)
        sent = state.ledger.scalars
        assert np.array_equal(sent, expected["scalars_total"].values)


@ignore_collapse
@each_case
def test_agents_without_a_network_are_filters_of_one_agent(name: str) -> None:
    case = CASES[name]
    problem = problem_of(case)
    together = record(case, replace(problem, graph=APART))
    one = Graph.from_edges(1, [])
    for agent in range(4):
        # The agent's own events and prior, as those of the only agent
        events = [replace(e, agent=0) for e in problem.events if e.agent == agent]
        place = 0 if case.prior in ("one", "common members") else agent
        single = replace(
            problem,
            sensors=[problem.sensors[agent]],
            priors=[problem.priors[place]],
            members=problem.members[[place]],
            graph=one,
            events=events,
        )
        # Each agent has its own share of consensus only where there is a network.
        alone = record(case, single)
        assert_equal(together.isel(agent=[agent]), alone)


@ignore_collapse
@each_case
def test_a_list_of_events_in_two_calls_is_the_list_in_one(
    name: str, tmp_path: Path
) -> None:
    """Also if the state between them was saved, with its past and what waits for a contact."""
    case = CASES[name]
    problem = problem_of(case)
    f = build(case, problem)
    start = f.start(make_prior(case, problem), rng=np.random.default_rng(0))
    *_, expected = f.steps(start, TIMES, problem.events)
    early = [e for e in problem.events if e.t < TIMES[2]]
    late = [e for e in problem.events if e.t >= TIMES[2]]
    *_, between = f.steps(start, TIMES[:2], early)
    between.save(tmp_path / "between.npz")
    loaded = type(between).load(tmp_path / "between.npz")
    a = f.summarize(expected)
    for state in (between, loaded):
        *_, after = f.steps(state, TIMES[2:], late)
        b = f.summarize(after)
        assert np.array_equal(a.mean, b.mean)
        assert np.array_equal(a.variance, b.variance)
        assert np.array_equal(expected.ledger.scalars, after.ledger.scalars)


def make_model(d: int, now: float | None = None) -> Model:
    """Return a model that moves faster with time; or its motion at one time, `now`, for ever."""

    def stretch(t: float, dt: float) -> float:
        start = t if now is None else now
        return (1 + start) * dt

    return Model(
        d,
        lambda x, t, dt: move(x, 0.0, stretch(t, dt)),
        lambda t, dt: stretch(t, dt) * Q[:d, :d],
        derivative=lambda x, t, dt: differentiate_move(x, 0.0, stretch(t, dt)),
    )


@ignore_collapse
@each_case
def test_a_step_has_the_model_of_the_time_at_which_it_begins(name: str) -> None:
    """There a model that does not depend on time is put in its place, step by step."""
    case = CASES[name]
    problem = make_problem(case.d, graph=case.graph)
    # A mixture looks at the model's derivative only where it splits.
    splits = (
        {"split_threshold": 0.01, "max_components": 16} if name == "mixture" else {}
    )
    f = build(case, replace(problem, model=make_model(case.d)), **splits)
    prior = make_prior(case, problem)
    start = f.start(prior, rng=np.random.default_rng(0))
    state = start
    for expected in f.steps(start, TIMES, problem.events):
        frozen_model = make_model(case.d, state.t)
        frozen = build(case, replace(problem, model=frozen_model), **splits)
        events = [e for e in problem.events if e.t == expected.t]
        (state,) = frozen.steps(state, [expected.t], events)
        a = f.summarize(expected)
        b = f.summarize(state)
        assert np.allclose(a.mean, b.mean, rtol=1e-9, atol=1e-12)
        assert np.allclose(a.variance, b.variance, rtol=1e-9, atol=1e-12)
        if state.nis is not None:
            assert np.allclose(expected.nis, state.nis, rtol=1e-9)


@ignore_collapse
@each_case
def test_every_state_of_a_run_can_be_stepped_again(name: str) -> None:
    """It keeps its beliefs and its generator, so that each attempt ends where the run went."""
    case = CASES[name]
    # With process noise members draw in every step.
    problem = make_problem(case.d, graph=case.graph)
    f = build(case, problem)
    start = f.start(make_prior(case, problem), rng=np.random.default_rng(0))
    state = start
    for expected in f.steps(start, TIMES, problem.events):
        now = [e for e in problem.events if e.t == expected.t]
        listed = [[e for e in now if e.agent == agent] for agent in range(4)]
        a = f.summarize(expected)
        for _attempt in range(2):
            b = f.summarize(f.step(state, expected.t, listed))
            assert np.allclose(a.mean, b.mean, rtol=0, atol=1e-12)
            assert np.allclose(a.variance, b.variance, rtol=0, atol=1e-12)
        state = expected


def spawning_forecast(x: Any, model: Any, t: float, dt: float, *, rng: Any) -> Any:
    """Add draws of a stream of the forecast's own to the members."""
    (stream,) = rng.spawn(1)
    return x + stream.standard_normal(x.shape)


@pytest.mark.parametrize("lag", [0, 1])
def test_streams_that_a_forecast_spawns_are_those_of_its_step(lag: int) -> None:
    """A second attempt at a step spawns the same stream, and the next step another one."""
    still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    f = EnsembleFilter(still, [None], members=5, forecast=spawning_forecast, lag=lag)
    start = f.start(([0.0], [[1.0]]), rng=np.random.default_rng(0))
    first = f.step(start, 1.0, [None])
    again = f.step(start, 1.0, [None])
    assert np.array_equal(first.ensembles, again.ensembles)
    second = f.step(first, 2.0, [None])
    draws = first.ensembles - start.ensembles
    assert not np.allclose(draws, second.ensembles - first.ensembles)


NUMBERS = ("rejected", "log_likelihood", "nis", "n_observed")
WITH_LAG = [name for name, case in CASES.items() if "lag" in case.options]


def delay(events: list[Observation]) -> tuple[list[Observation], list[Observation]]:
    """Return the events that come in time, and the others with the time of their arrival.

    Of the latter some come in the next step and some in the one after it, one at its very time
    and one between two; the first to be observed is the last to arrive.
    """
    arrivals = {0: TIMES[3], 2: TIMES[1], 4: 0.75, 6: TIMES[2], 9: 1.1}
    punctual = []
    late = []
    for k, event in enumerate(events):
        if k in arrivals:
            late.append(replace(event, arrival_time=arrivals[k]))
        else:
            punctual.append(event)
    return punctual, late


@ignore_collapse
@pytest.mark.parametrize("name", WITH_LAG)
def test_a_run_with_late_observations_is_its_steps(name: str) -> None:
    """So is a smoothed one: the beliefs are those of later steps, but all counts the steps' own."""
    case = CASES[name]
    problem = problem_of(case)
    f = build(case, problem, lag=3)
    start = f.start(make_prior(case, problem), rng=np.random.default_rng(0))
    punctual, late = delay(problem.events)
    assert all(e.t < e.arrival_time for e in late)
    # In the order of their arrival, each in the first step that is not before it
    state = start
    states = []
    before = start.t
    for t in TIMES.tolist():
        now = [e for e in punctual if e.t == t]
        listed = [[e for e in now if e.agent == agent] for agent in range(4)]
        arrived = [e for e in late if before < e.arrival_time <= t]
        arrived.sort(key=lambda e: e.arrival_time)
        state = f.step(state, t, listed, delayed=arrived)
        states.append(state)
        before = t
    run = f.run(start, TIMES, punctual, delayed=late[::-1])
    smooth = f.smooth(start, TIMES, punctual, delayed=late[::-1])
    smoothed = [*states[-1].lagged_states, states[-1]]
    for k, one in enumerate(states):
        for record_, belief in ((run, one), (smooth, smoothed[k])):
            summary = f.summarize(belief)
            assert np.allclose(record_["mean"][k], summary.mean, rtol=0, atol=1e-9)
            variance = record_["variance"][k]
            assert np.allclose(variance, summary.variance, rtol=0, atol=1e-9)
            total = record_["scalars_total"][k]
            assert np.array_equal(total, one.ledger.scalars)
            for number in NUMBERS:
                if number in record_:
                    expected = getattr(one, number)
                    assert np.allclose(record_[number][k], expected, atol=1e-9)


@ignore_collapse
@each_case
def test_a_run_counts_from_its_own_start(name: str) -> None:
    """Messages of a run that goes on from another: of each step its own, in total those of both."""
    case = CASES[name]
    problem = problem_of(case)
    f = build(case, problem)
    start = f.start(make_prior(case, problem), rng=np.random.default_rng(0))
    whole = f.run(start, TIMES, problem.events)
    early = [e for e in problem.events if e.t < TIMES[2]]
    late = [e for e in problem.events if e.t >= TIMES[2]]
    between = f.final_state(f.run(start, TIMES[:2], early))
    rest = f.run(between, TIMES[2:], late)
    for number in ("messages", "scalars", "bytes", "rounds"):
        for variable in (number, f"{number}_total"):
            assert np.array_equal(rest[variable], whole[variable][2:])
    assert rest["scalars"].values.sum() > 0


@ignore_collapse
@each_case
def test_the_numbers_of_agents_are_names(name: str) -> None:
    case = CASES[name]
    problem = problem_of(case)
    order = [2, 3, 1, 0]
    if case.prior in ("one", "common members"):
        # One prior for all agents, whatever their order
        problem = replace(
            problem,
            priors=[problem.priors[0]] * 4,
            members=problem.members[[0, 0, 0, 0]],
        )
    a = record(case, problem)
    b = record(case, permute_agents(problem, order))
    atol = 1e-6 if name in ("mixture", "increments") else 1e-9
    assert_equal(a.isel(agent=order), b, atol=atol)
    assert np.array_equal(a["scalars"].values[:, order], b["scalars"].values)


@ignore_collapse
@pytest.mark.parametrize("name", [n for n, case in CASES.items() if case.turns])
def test_the_order_of_components_changes_nothing(name: str) -> None:
    case = CASES[name]
    problem = problem_of(case)
    order = [2, 0, 1] if case.d == 3 else [1, 0]
    a = record(case, problem)
    b = record(case, transform(problem, np.eye(case.d)[order]))
    moments = {"mean", "variance", "covariance"} & set(a.variables)
    a = a.isel(component=order)
    if "column" in a.dims:
        a = a.isel(column=order)
    # Iterations of weights stop within their tolerance.
    tolerance = 1e-6
    assert_equal(a, b, atol=tolerance)
    assert moments


@ignore_collapse
@pytest.mark.parametrize("name", [n for n, case in CASES.items() if case.scales])
def test_units_of_single_components_change_nothing(name: str) -> None:
    """A length in mm, a velocity in km/s: means and covariances have the units of the state."""
    case = CASES[name]
    problem = problem_of(case)
    units = np.array([1e3, 1e-3, 20.0])[: case.d]
    a = record(case, problem)
    b = record(case, transform(problem, np.diag(units)))
    assert np.allclose(a["mean"] * units, b["mean"], rtol=1e-5, atol=1e-6 * units)
    assert np.allclose(a["variance"] * units**2, b["variance"], rtol=1e-5)
    scores = [n for n in ("rejected", "log_likelihood", "nis") if n in a]
    for score in scores:
        assert np.allclose(a[score], b[score], rtol=1e-5, atol=1e-6)


@ignore_collapse
@pytest.mark.parametrize("name", [n for n in WITH_LAG if "waiting" not in n])
def test_a_filter_without_lag_drops_the_past_when_time_goes_on(name: str) -> None:
    """In a step of no length it keeps the past of its state, as a filter with a lag does."""
    case = CASES[name]
    problem = problem_of(case)
    f = build(case, problem, lag=3)
    g = f.replace(lag=0)
    start = f.start(make_prior(case, problem), rng=np.random.default_rng(0))
    *_, state = f.steps(
        start, TIMES[:2], [e for e in problem.events if e.t <= TIMES[1]]
    )
    more = [[Observation(TIMES[1], 0, [0.9])], [], [], []]
    a = f.step(state, TIMES[1], more)
    b = g.step(state, TIMES[1], more)
    assert b.times == a.times == (0.0, TIMES[0])
    for one, other in zip((*a.lagged_states, a), (*b.lagged_states, b), strict=True):
        first = f.summarize(one)
        second = g.summarize(other)
        assert np.array_equal(first.mean, second.mean)
        assert np.array_equal(first.variance, second.variance)
    assert g.step(b, TIMES[2], [None] * 4).times == ()
