"""The contract of all families, through one list: runs, events, gates, contacts, scores."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
import xarray
from numpy.random import default_rng
from scipy.stats import chi2, multivariate_normal, norm

from distfilt import filters
from distfilt.density import Flooding, FokkerPlanck, Grid
from distfilt.filters.record import final_state
from distfilt.mixtures import GaussianMixture, target_fusion
from distfilt.models import LinearModel, lorenz63, rotating_swarm
from distfilt.network import (
    Channel,
    Faults,
    Graph,
    average_consensus,
    covariance_intersection,
    graphs,
    mean_pull,
)
from distfilt.sensors import Sensor, bearing, component, line_angle

from .families import NOISE, PRIOR, TIMES, Q, data, kalman, model, still_model

EYES = [
    component([0], std=0.6),
    Sensor(2, lambda x: x, NOISE, linear=np.eye),
    component([1], std=0.5),
]
NET = graphs.complete(3)
QUIET = LinearModel.from_transition(2, model().transition_matrix, lambda t, dt: 0 * Q)
SWARM = rotating_swarm("gibbs")
PLACES = default_rng(1).random((9, 2))
LAW = FokkerPlanck(SWARM, Grid((9, 9)))
WITH_SENSORS = {
    "ensemble": partial(filters.EnsembleFilter.exact, members=30, fusion=None),
    "gaussian": filters.GaussianFilter,
    "particle": partial(filters.ParticleFilter, members=300),
    "transport": partial(filters.TransportFilter, members=30),
    "mixture": partial(
        filters.MixtureFilter, target_dim=2, fusion=partial(target_fusion, target_dim=2)
    ),
    "news": partial(filters.InformationIncrementFilter, target_dim=2),
    "consensus": partial(
        filters.InformationConsensusFilter, fusion=average_consensus, average="hybrid"
    ),
    "sum": filters.GaussianSumFilter,
    "likelihood": partial(
        filters.LikelihoodConsensusFilter,
        members=300,
        basis=filters.PolynomialBasis([0, 1]),
        fusion=average_consensus,
    ),
}
EACH = pytest.mark.parametrize("family", [*WITH_SENSORS, "density"])
EACH_WITH_SENSORS = pytest.mark.parametrize("family", WITH_SENSORS)


def make_filter(
    family: str, times: Any = TIMES, **options: Any
) -> tuple[Any, Any, Any, Any]:
    """A filter, its first state, the observations agent by agent, and the truth."""
    if family == "density":
        # Its agents observe their own positions; the truth is the density of the swarm.
        path = SWARM.simulate(PLACES, times, rng=default_rng(2), substeps=2)
        arguments = {"fusion": Flooding(), "bandwidth": 0.15, "rank": 20} | options
        graph = arguments.pop("graph", 0.5)
        f: Any = filters.DensityFilter(LAW, 9, graph, **arguments)
        truth = LAW.evolve(np.ones(81), times)
        return f, f.start(PLACES), path.swapaxes(0, 1), truth
    arguments = {"graph": NET, "sensors": EYES} | options
    sensors = arguments.pop("sensors")
    truth, seen = data(sensors)
    f = WITH_SENSORS[family](model(), sensors, arguments.pop("graph"), **arguments)
    n = len(times)
    seen = [None if s is None else s[:n] for s in seen]
    start = f.start(PRIOR, rng=default_rng(0))
    return f, start, seen, truth[:n]


@EACH
def test_a_run_is_its_steps_whether_saved_or_not(family: str, tmp_path: Path) -> None:
    """With as many times as agents, so that a series cannot be taken for its transpose."""
    times = TIMES[: 9 if family == "density" else 3]
    options: dict[str, Any] = {}
    if family != "transport":
        # This family's agents need every message, or their sets would differ.
        options["faults"] = Faults(loss=0.4, seed=5)
    if family in ("ensemble", "gaussian", "particle"):
        options["lag"] = 1
    f, start, seen, truth = make_filter(family, times, **options)
    run = f.run(start, times, seen, truth=truth)
    state = start
    for k, t in enumerate(times):
        now = [s[k] for s in seen]
        state = f.step(state, t, now)
        state.save(tmp_path / "state.npz")
        state = type(state).load(tmp_path / "state.npz")
        if t < times[-1]:
            # A run from the saved state gives the rest of the record, in blocks of states.
            later = slice(k + 1, None)
            seen_later = [s[later] for s in seen]
            remainder = f.run(state, times[later], seen_later, truth=truth[later])
            expected = run.isel(time=later)
            xarray.testing.assert_allclose(remainder, expected, 1e-9, 1e-12)
            xarray.testing.assert_equal(remainder["mean"], expected["mean"])
        repeated = f.summarize(state)
        mean = run["mean"].values
        variance = run["variance"].values
        assert np.array_equal(mean[k], repeated.mean, equal_nan=True)
        assert np.array_equal(variance[k], repeated.variance, equal_nan=True)
        for name in ("rounds", "messages", "scalars", "bytes", "lost"):
            # The record has the numbers of each step, and their sums.
            total = run[f"{name}_total"].values
            assert np.array_equal(total[k], getattr(state.ledger, name))
            assert np.array_equal(total, np.cumsum(run[name].values, axis=0))
    squared_error = (run["mean"].values - truth[:, None]) ** 2
    assert (run["squared_error"].values == squared_error).all()
    assert len(repr(state)) < 200
    assert f"t={times[-1]:g}" in repr(state)


@EACH_WITH_SENSORS
def test_events_of_any_order_are_the_series(family: str) -> None:
    f, start, seen, _ = make_filter(family)
    events = []
    for agent, series in enumerate(seen):
        for t, y in zip(TIMES, series, strict=True):
            events.append(filters.Observation(t, agent, y))
    order = default_rng(0).permutation(len(events))
    mixed = [events[k] for k in order]
    a = f.run(start, TIMES, seen)
    b = f.run(start, None, mixed)
    xarray.testing.assert_equal(a, b)
    # A table of each agent's series is the series.
    tables = [pandas.DataFrame(s) for s in seen]
    xarray.testing.assert_equal(a, f.run(start, TIMES, tables))
    # None and NaN both mean that nothing was observed.
    gaps = [[None, *s[1:]] for s in seen]
    subset = [s.copy() for s in seen]
    for series in subset:
        series[0] = np.nan
    without = f.run(start, TIMES, gaps)
    xarray.testing.assert_equal(without, f.run(start, TIMES, subset))
    # Times without observations may be added.
    more = f.run(start, [0.05, TIMES[-1] + 1], mixed)
    assert more["time"].size == len(TIMES) + 2
    assert more["mean"][1:2].shape == a["mean"][:1].shape


@pytest.mark.parametrize("options", [{}, {"fusion": partial(mean_pull, gain=0.0)}])
def test_particles_that_hear_all_are_the_joint_filter(options: Any) -> None:
    """Up to the sampling error of their number, with and without a fusion."""
    f, start, seen, _ = make_filter("particle", **options)
    exact, _ = kalman(seen, EYES)
    for k, state in enumerate(f.steps(start, TIMES, seen)):
        result = f.summarize(state)
        mean_error = np.abs(result.mean - exact.means[k])
        covariance_error = np.abs(result.covariance - exact.covariances[k])
        assert mean_error.max() < 0.3
        assert covariance_error.max() < 0.3


@EACH_WITH_SENSORS
def test_units_change_nothing(family: str) -> None:
    """A state in millimetres in place of metres, to the rounding of a long product."""
    big = 1e3
    wide = LinearModel.from_transition(
        2, model().transition_matrix, lambda t, dt: big**2 * dt * Q
    )

    def sensors_in(unit: float) -> list[Sensor]:
        first = component([0], std=0.6 * unit)
        second = component([1], std=0.5 * unit)
        third = component([0], std=0.3 * unit)
        return [first, second, third]

    f, start, seen, _ = make_filter(family, sensors=sensors_in(1.0))
    g = WITH_SENSORS[family](wide, sensors_in(big), NET)
    mean, cov = PRIOR
    first = (big * mean, big**2 * cov)
    a = f.run(start, TIMES, seen)
    begin = g.start(first, rng=default_rng(0))
    b = g.run(begin, TIMES, [big * s for s in seen])
    # Means and standard deviations scale with the unit.
    assert np.allclose(big * a["mean"], b["mean"], rtol=1e-6, atol=1e-6 * big)
    assert np.allclose(big * a["spread"], b["spread"], rtol=1e-6)


@pytest.mark.parametrize("family", ["gaussian", "mixture", "news", "density"])
def test_the_order_of_agents_changes_nothing(family: str) -> None:
    f, start, seen, _ = make_filter(family)
    order = default_rng(4).permutation(len(seen))
    if family == "density":
        g = f
        begin = f.start(PLACES[order])
    else:
        sensors = [EYES[k] for k in order]
        g = WITH_SENSORS[family](model(), sensors, NET)
        begin = g.start(PRIOR)
    a = f.run(start, TIMES, seen)
    seen_in_order = [seen[k] for k in order]
    b = g.run(begin, TIMES, seen_in_order)
    # The same beliefs under other numbers; sums in another order round differently.
    for name in ("mean", "variance"):
        expected = a[name].values[:, order]
        assert np.allclose(expected, b[name].values, atol=1e-10)


@pytest.mark.parametrize("family", WITH_SENSORS)
def test_the_gate_lets_pass_what_its_share_says(family: str) -> None:
    """Just inside the quantile a reading counts, just outside it is left out and counted."""
    sensors = [component([0, 1], std=0.6), None, None]
    f, start, _, _ = make_filter(family, sensors=sensors, gate_probability=0.95)
    # After this step particles differ in weight.
    start = f.step(start, 0.0, [[0.4, np.nan], None, None])
    blind = f.summarize(f.step(start, 0.1, [None] * 3))
    mean = blind.mean[0]
    if blind.covariance is None:
        cov = np.cov(blind.members[0].T)
    else:
        cov = blind.covariance[0]
    # The edge of the gate is νᵀ S⁻¹ ν = χ² with as many degrees of freedom as numbers.
    s = cov + 0.36 * np.eye(2)
    one_number = np.array([np.nan, np.nan])
    one_number[0] = np.sqrt(chi2.ppf(0.95, 1) * s[0, 0])
    # c u has the distance c² uᵀ S⁻¹ u.
    direction = np.array([1.0, -1.0])
    squared = direction @ np.linalg.solve(s, direction)
    length = np.sqrt(chi2.ppf(0.95, 2) / squared)
    both = length * direction
    for edge in (one_number, both):
        for factor, refused in ((0.999, 0), (1.001, 1)):
            y = mean + factor * edge
            after = f.step(start, 0.1, [y, None, None])
            assert after.rejected[0] == refused
            mean_after = f.summarize(after).mean[0]
            same = np.allclose(mean_after, mean, atol=1e-12)
            assert same == bool(refused)
    # Straight behind a direction predictions lie on both sides of where its residuals jump.
    sensors = [bearing([0, 1], std=0.05), None, None]
    options: dict[str, Any] = {"sensors": sensors, "gate_probability": 0.99}
    if family == "gaussian":
        options["linearization"] = "unscented"
    f = make_filter(family, **options)[0]
    prior = (np.array([9.0, 0.0]), 0.2 * np.eye(2))
    start = f.start(prior, rng=default_rng(0))
    after = f.step(start, 0.01, [[np.pi], None, None])
    assert after.rejected[0] == 1


def test_each_reading_is_judged_alone() -> None:
    """Of two observations that an agent has, its own and a neighbour's, only the wild one goes."""
    f, start, _, _ = make_filter("gaussian", gate_probability=0.999)
    plain = make_filter("gaussian")[0]
    good = [0.9]
    # One wild component refuses the observation with both of its numbers.
    wild = [0.8, 40.0]
    a = f.step(start, 0.1, [good, wild, None])
    b = plain.step(start, 0.1, [good, None, None])
    assert a.rejected.tolist() == [1, 1, 1]
    assert np.array_equal(a.means, b.means)
    run = f.run(start, [0.1], [[good], [wild], None])
    assert run["rejected"].values.tolist() == [[1, 1, 1]]
    f, start, _, _ = make_filter("gaussian", gate_probability=0.999, lag=1)
    blind = f.step(start, 0.1, [None] * 3)
    # A delayed observation and one of now are judged apart, and all agents have both.
    late = filters.Observation(0.1, 0, [40.0])
    after = f.step(blind, 0.4, [None, wild, None], delayed=[late])
    assert after.rejected.tolist() == [2, 2, 2]
    # x² of N(0, 1): mean 1 and variance 1 by the points, slope 0
    bowl = Sensor(1, np.square, [[0.5]])
    f = filters.GaussianFilter(
        still_model(1), [bowl], linearization="unscented", gate_probability=0.95
    )
    # S = 1 + R with R = 0.5
    edge = np.sqrt(1.5 * chi2.ppf(0.95, 1))
    start = f.start((np.zeros(1), np.eye(1)))
    assert f.start(norm(1.0, 3.0)).covariances[0, 0, 0] == 9.0
    inside = f.step(start, 1.0, [[1 + 0.97 * edge]])
    outside = f.step(start, 1.0, [[1 + 1.03 * edge]])
    assert inside.rejected.tolist() == [0.0]
    assert outside.rejected.tolist() == [1.0]


@pytest.mark.parametrize("t0", [0.0, 1.7e9])
@pytest.mark.parametrize("family", ["gaussian", "news"])
def test_nothing_is_lost_until_the_next_contact(family: str, t0: float) -> None:
    """After it all agents have the belief of one filter of all observations; before, their own."""
    # Without process noise an exchange of increments is exact as well.
    lag = {"lag": 8} if family == "gaussian" else {}
    f = WITH_SENSORS[family](QUIET, EYES, NET, exchange_interval=0.2, **lag)
    g = filters.GaussianFilter(QUIET, EYES, NET)
    private = filters.GaussianFilter(QUIET, EYES, NET, share_observations=False)
    _, seen = data(EYES)
    seen = [s[:5] for s in seen]
    # Multiples of .2 lie in the third step and, rounded, in the fourth, which is once.
    times = t0 + np.array([0.1, 0.15, 0.5, 0.6, 0.65])
    contacts = [2, 3]
    states = list(f.steps(f.start(PRIOR, t=t0), times, seen))
    everything = list(g.steps(g.start(PRIOR, t=t0), times, seen))
    single = list(private.steps(private.start(PRIOR, t=t0), times, seen))
    rounds = np.diff([state.ledger.rounds for state in states], prepend=0)
    assert np.flatnonzero(rounds).tolist() == contacts
    assert rounds.max() == 1
    expected = {k: everything[k] for k in contacts}
    for k in range(contacts[0]):
        expected[k] = single[k]
    for k, wanted in expected.items():
        result = f.summarize(states[k])
        assert np.allclose(result.mean, wanted.means, atol=1e-9)
        assert np.allclose(result.covariance, wanted.covariances, atol=1e-9)


def test_what_was_heard_is_not_told_as_one_s_own() -> None:
    """At first only agent 0 receives, from agent 1; then all receive from all.

    A received increment that is sent on as one's own would be counted twice.
    """
    one_way = Graph.from_edges(3, [(0, 1)], directed=True)
    _, seen = data(EYES)
    seen = [s[:4] for s in seen]
    times = TIMES[:4]

    def graph(t: float) -> Graph:
        return NET if t > 0.95 else one_way

    f = filters.InformationIncrementFilter(QUIET, EYES, graph, target_dim=2)
    g = filters.GaussianFilter(QUIET, EYES, NET)
    result = f.run(f.start(PRIOR), times, seen)["covariance"]
    expected = g.run(g.start(PRIOR), times, seen)["covariance"]
    # Agents 0 and 1 at the last time
    last = (-1, slice(2))
    assert np.allclose(result[last], expected[last], atol=1e-9)


def test_what_waits_survives_on_disk_and_a_lag_has_to_reach_it(tmp_path: Path) -> None:
    f, start, seen, _ = make_filter("gaussian", exchange_interval=1.0, lag=8)
    states = list(f.steps(start, TIMES, seen))
    assert states[0].pending
    assert not states[3].pending
    path = tmp_path / "s.npz"
    states[1].save(path)
    # A buffer that is filled again does not change the pending values.
    for s in seen:
        s[:2] = 9.0
    for resumed in (states[1], type(start).load(path)):
        for k in (2, 3):
            now = [s[k] for s in seen]
            resumed = f.step(resumed, TIMES[k], now)
        assert np.array_equal(resumed.joint_means, states[3].joint_means)
    short, start, seen, _ = make_filter("gaussian", exchange_interval=1.0, lag=1)
    # Pending observations are of earlier times, to which the filter must be able to return.
    message = "lag must be at least 1 for observations that wait"
    with pytest.raises(ValueError, match=message):
        make_filter("gaussian", exchange_interval=1.0)
    with pytest.raises(ValueError, match="lag must reach back to t = 0"):
        short.run(start, TIMES, seen)


@EACH
def test_truth_of_each_agent_and_of_named_components(family: str) -> None:
    f, start, seen, truth = make_filter(family)
    run = partial(f.run, start, TIMES, seen)
    common = run(truth=truth)
    # The same truth for each agent
    each = np.repeat(truth[:, None], len(seen), axis=1)
    xarray.testing.assert_equal(common, run(truth=each))
    # The columns of a table are found by their names, in any order.
    names = f.components[0]
    table = pandas.DataFrame(truth, columns=names)
    reversed_table = table.iloc[:, ::-1]
    xarray.testing.assert_allclose(common, run(truth=reversed_table))
    # A truth of one component gives its scores alone.
    name = names[1]
    partial_truth = run(truth={name: truth[:, 1]})
    errors = partial_truth["squared_error"]
    one = errors.sel(component=name)
    assert np.array_equal(one, common["squared_error"].sel(component=name))
    assert errors.isel(component=0).isnull().all()
    if "nees" in partial_truth and "covariance" in partial_truth:
        # NEES of one component: its squared error over its variance
        variance = partial_truth["variance"].sel(component=name)
        assert np.allclose(partial_truth["nees"], one / variance)
    for wrong, text in (
        ({"speed": truth[:, 1]}, "have components"),
        (truth[:, :1], "be .*or a dict of"),
    ):
        with pytest.raises(ValueError, match=f"truth must {text}"):
            run(truth=wrong)


@EACH
def test_a_selection_has_no_wrong_state(family: str) -> None:
    f, start, seen, _ = make_filter(family)
    run = f.run(start, TIMES, seen)
    last = final_state(run)
    assert last.t == TIMES[-1]
    assert final_state(run.copy()) is last
    assert final_state(run.assign(x=1)) is last
    deep = final_state(run.copy(deep=True))
    assert np.array_equal(f.summarize(deep).mean, f.summarize(last).mean)
    assert final_state(run.isel(time=slice(3, None))) is last
    # Without the last time, an agent, the means, or the agents' order, no state fits.
    exchanged = [1, 0, *range(2, len(seen))]
    for part in (
        run.isel(time=slice(2)),
        run.isel(agent=[0]),
        run[["variance"]],
        run.isel(agent=exchanged),
    ):
        with pytest.raises(ValueError, match="one without a state"):
            final_state(part)


def test_a_state_and_a_reading_of_another_are_refused() -> None:
    f, start, seen, _ = make_filter("gaussian")
    with pytest.raises(ValueError, match="state must be a GaussianState"):
        f.step(make_filter("particle")[1], 0.1, seen)
    g = make_filter("ensemble")[0]
    small = filters.EnsembleFilter(model(), EYES, NET, members=7)
    state = small.start(PRIOR, rng=default_rng(0))
    with pytest.raises(ValueError, match="state must have sizes"):
        g.step(state, 0.1, [None] * 3)
    # Of another agent, and of another time
    message = r"observations\[0\] must be an Observation of agent 0 at"
    for observation in (
        filters.Observation(0.1, 1, [0.3]),
        filters.Observation(0.2, 0, [0.3]),
    ):
        with pytest.raises(ValueError, match=message):
            f.step(start, 0.1, [observation, None, None])


def test_a_prior_of_any_kind() -> None:
    f, _, _, _ = make_filter("gaussian")
    frozen = multivariate_normal(*PRIOR)
    mixture = GaussianMixture.gaussian(*PRIOR)
    members = frozen.rvs(size=50, random_state=default_rng(0))
    # Moments, a distribution of scipy, a mixture or members: all have a mean and a covariance.
    for prior in (PRIOR, [*PRIOR], frozen, mixture):
        state = f.start(prior)
        assert np.allclose(state.means, PRIOR[0])
        assert np.allclose(state.covariances, PRIOR[1])
    assert np.allclose(f.start(members).covariances, np.cov(members.T))
    flat = (PRIOR[0], np.diag([1.0, 0.0]))
    unscented = filters.GaussianFilter(model(), EYES, NET, linearization="unscented")
    for g, wrong, text in (
        (f, lambda n, rng, leading: None, "got a function"),
        (f, ([0.0, 0.0], [1.0, 1.0]), r"have a covariance of .*, got \(2,\)"),
        (unscented, (PRIOR[0], np.diag([1.0, -1.0])), "semidefinite"),
        (make_filter("mixture")[0], flat, "definite"),
    ):
        with pytest.raises(ValueError, match=f"prior must .*{text}"):
            g.start(wrong)
    # A known constant has no variance; on a linear model sigma points and derivatives agree.
    ends = []
    for g in (filters.GaussianFilter(model(), EYES, NET), unscented):
        start = g.start(flat)
        state = g.step(start, 0.0, [[1.0], [1.0, 2.0], [0.5]])
        assert np.allclose(state.means[:, 1], PRIOR[0][1])
        ends.append(g.step(state, 0.5, [[0.5], [1.0, 2.0], [0.5]]))
    assert np.allclose(ends[0].means, ends[1].means)
    assert np.allclose(ends[0].covariances, ends[1].covariances)
    rng = default_rng(1)
    e = filters.EnsembleFilter(model(), EYES, NET, members=4000)
    message = r"prior must have shape \(3, 4000, 2\), got \(3, 4000, 3\)"
    with pytest.raises(ValueError, match=message):
        e.start(multivariate_normal(np.zeros(3)), rng=rng)
    # Members are draws; their sample covariance is near the prior's.
    means = [[-3.0, 0.0], [3.0, 0.0]]
    two = GaussianMixture([0.5, 0.5], means, [np.eye(2)] * 2)
    for prior, cov in ((PRIOR, PRIOR[1]), (frozen, PRIOR[1]), (two, two.cov)):
        x = e.start(prior, rng=rng, runs=(2,)).ensembles
        assert x.shape == (2, 3, 4000, 2)
        assert np.allclose(np.cov(x[1, 2].T), cov, atol=0.5)
    m = filters.MixtureFilter(model(), EYES, target_dim=2)
    begun = m.start([PRIOR, frozen, two]).mixtures
    assert [b.n_components for b in begun] == [1, 1, 2]


def test_degrees_are_told() -> None:
    angle = line_angle([0, 1], std=0.1)
    f = filters.GaussianFilter(model(), [angle, None, None], NET)
    # 89.6 rad are 14.3 turns, so that the value must be in degrees.
    degrees = np.array([[89.6]])
    message = r"^observations\[0\] must .* rad, got some 14 turns"
    with pytest.warns(RuntimeWarning, match=message):
        f.run(f.start(PRIOR), [1.0], [degrees, None, None])


def test_the_extended_filter_bears_its_own_rounding() -> None:
    chaos = lorenz63()
    f = filters.GaussianFilter(chaos, [component([0, 1, 2], std=1.0)])
    times = np.arange(1, 401) * 0.01
    first = [1.0, 1.0, 20.0]
    x = np.array(first)
    states = []
    for _ in times:
        x = chaos.step(x, 0.0, 0.01)
        states.append(x)
    # Exact observations: any error comes from rounding, which chaos amplifies.
    truth = np.array(states)
    start = f.start((first, np.eye(3)))
    run = f.run(start, times, [truth], truth=truth)
    error = run["total_squared_error"].values
    assert error[-1, 0] < 0.1


def test_inflation_widens_the_forecast_and_goes_with_fusion_and_the_past() -> None:
    wide = filters.GaussianFilter(model(), EYES, NET, inflation=1.3, lag=2)
    plain = filters.GaussianFilter(model(), EYES, NET, lag=2)
    with pytest.raises(ValueError, match="^inflation must be at least 0.5, got 0.05"):
        filters.GaussianFilter(model(), EYES, NET, inflation=0.05)
    nothing = [None] * 3
    a = wide.step(wide.start(PRIOR), 0.5, nothing)
    b = plain.step(plain.start(PRIOR), 0.5, nothing)
    # Members 1.3 times as far from the mean: P by 1.3², its blocks with the past by 1.3.
    now = slice(2)
    past = slice(2, None)
    p = a.joint_covariances
    q = b.joint_covariances
    assert np.allclose(a.covariances, 1.69 * b.covariances)
    assert np.allclose(p[..., now, past], 1.3 * q[..., now, past])
    assert np.allclose(p[..., past, past], q[..., past, past])
    # Fusing equal beliefs changes nothing.
    f = filters.GaussianFilter(
        model(), EYES, NET, inflation=1.3, fusion=covariance_intersection
    )
    c = f.step(f.start(PRIOR), 0.5, nothing)
    assert np.allclose(c.covariances, a.covariances)


def test_the_past_follows_the_fused_present() -> None:
    """By its regression on the present: m + G Δm and P + G ΔP Gᵀ."""
    f = filters.GaussianFilter(
        model(), EYES, NET, lag=1, share_observations=False, fusion=None
    )
    g = replace(f, fusion=covariance_intersection)
    seen = [[0.3], [0.2, 0.4], [0.9]]
    b = f.step(f.start(PRIOR), 0.5, seen)
    c = g.step(g.start(PRIOR), 0.5, seen)
    fused = covariance_intersection((b.means, b.covariances), Channel(NET))
    assert np.allclose(c.means, fused[0])
    assert np.allclose(c.covariances, fused[1])
    now = slice(2)
    past = slice(2, None)
    unfused = b.joint_covariances
    p = c.joint_covariances
    # G = P₂₁ P₁₁⁻¹
    prior = unfused[..., now, now]
    gain = unfused[..., past, now] @ np.linalg.inv(prior)
    present = p[..., now, now]
    assert np.allclose(p[..., past, now], gain @ present)
    change = p - unfused
    expected = gain @ (present - prior) @ gain.mT
    assert np.allclose(change[..., past, past], expected)
    shift = c.joint_means - b.joint_means
    expected = gain @ shift[..., now, None]
    assert np.allclose(shift[..., past, None], expected)
