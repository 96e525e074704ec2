"""Results do not depend on names: of runs, agents, components, units and calls.

Every family runs on one problem without symmetries. Source: own.
"""

from __future__ import annotations

from dataclasses import replace

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
@each_case
def test_agents_without_a_network_are_filters_of_one_agent(name: str) -> None:
    case = CASES[name]
    problem = problem_of(case)
    together = record(case, replace(problem, graph=APART))
    one = Graph.from_edges(1, [])
    for agent in range(4):
        mine = [replace(e, agent=0) for e in problem.events if e.agent == agent]
        place = 0 if case.prior in ("one", "common members") else agent
        single = replace(
            problem,
            sensors=[problem.sensors[agent]],
            priors=[problem.priors[place]],
            members=problem.members[[place]],
            graph=one,
            events=mine,
        )
        # Each agent has its own share of consensus only where there is a network.
        alone = record(case, single)
        assert_equal(together.isel(agent=[agent]), alone)


@ignore_collapse
@each_case
def test_a_list_of_events_in_two_calls_is_the_list_in_one(name: str) -> None:
    case = CASES[name]
    problem = problem_of(case)
    f = build(case, problem)
    start = f.start(make_prior(case, problem), rng=np.random.default_rng(0))
    *_, expected = f.steps(start, TIMES, problem.events)
    early = [e for e in problem.events if e.t < TIMES[2]]
    late = [e for e in problem.events if e.t >= TIMES[2]]
    *_, between = f.steps(start, TIMES[:2], early)
    *_, after = f.steps(between, TIMES[2:], late)
    a = f.summarize(expected)
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
