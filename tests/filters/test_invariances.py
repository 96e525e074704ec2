"""Results do not depend on names: of runs, agents, components, units and calls.

Every family runs on one problem without symmetries. Source: own.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from distfilt.network import Faults, Graph

from .problems import (
    APART,
    CASES,
    TIMES,
    assert_equal,
    build,
    make_prior,
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
