"""A density filter's results do not depend on names: of agents, axes, units, clocks and calls.

Every protocol runs on one swarm without symmetries: a box that is no square, a drift that depends
on place and time, a diffusion for each axis, an irregular graph, and an agent that is absent for
two steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from distfilt import density
from distfilt.filters import DensityFilter
from distfilt.models import Swarm
from distfilt.network import Graph

Array = np.ndarray

AGENTS = 7
# Uneven steps: a filter that took one step for another would differ.
TIMES = np.array([0.1, 0.25, 0.3, 0.5])
LINKS = [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (1, 4), (2, 6)]
SHAPE = (10, 14)
WIDTH = np.array([1.0, 1.3])
PROTOCOLS = {
    "flooding": density.Flooding(),
    "flooding, forgetful": density.Flooding(forget=0.2),
    "neighbours": density.Neighbours(),
    "pi": density.PIConsensus(),
    "pi, coefficients": density.PIConsensus(modes=25, rate=True),
    "pi, flat": density.PIConsensus(initial_std=0.3),
    "average": density.DynamicAverage(modes=None),
    "average, coefficients": density.DynamicAverage(modes=25),
    "centre": density.Centralised(),
}
each_protocol = pytest.mark.parametrize("name", PROTOCOLS)
each_network = pytest.mark.parametrize("name", [n for n in PROTOCOLS if n != "centre"])
"""The centre needs no links."""


def drift(x: Array, t: float) -> Array:
    """Return a velocity without symmetries, for the box from zero to WIDTH."""
    along = 0.4 * np.sin(3 * x[..., 1] + t)
    across = 0.3 - 0.5 * x[..., 0] * x[..., 1]
    return np.stack([along, across], axis=-1)


def diffusion(x: Array, t: float) -> Array:
    along = 0.03 + 0.02 * x[..., 1]
    across = 0.02 + 0.01 * x[..., 0]
    return np.stack([along, across], axis=-1)


def draw_paths() -> tuple[Array, Array]:
    """Draw positions at the start (A, 2) and at all times (T, A, 2); one agent misses two."""
    rng = np.random.default_rng(3)
    start = rng.random((AGENTS, 2)) * WIDTH
    steps = 0.08 * rng.standard_normal((len(TIMES), AGENTS, 2))
    paths = np.clip(start + steps.cumsum(axis=0), 0.0, WIDTH)
    paths[1:3, 4] = np.nan
    return start, paths


@dataclass(frozen=True)
class Problem:
    """All that a density filter is given, in some coordinates."""

    swarm: Swarm
    shape: tuple[int, int]
    bandwidth: Array
    start: Array
    paths: Array
    graph: Graph
    origin: float = 0.0
    """The time at which the clock starts."""


def make_problem() -> Problem:
    start, paths = draw_paths()
    swarm = Swarm(drift, diffusion, high=WIDTH)
    graph = Graph.from_edges(AGENTS, LINKS)
    return Problem(swarm, SHAPE, np.array([[0.12, 0.15]]), start, paths, graph)


def build(problem: Problem, name: str, **scheme: Any) -> DensityFilter:
    swarm = problem.swarm
    grid = density.Grid(problem.shape, low=swarm.low, high=swarm.high)
    return DensityFilter(
        density.FokkerPlanck(swarm, grid, **scheme),
        AGENTS,
        problem.graph,
        fusion=PROTOCOLS[name],
        bandwidth=problem.bandwidth,
        rank=20,
        process=0.3,
        mass_std=0.1,
    )


def run(problem: Problem, name: str, **scheme: Any) -> Any:
    """Return the record of a run, of densities (T, A, cells) in the problem's coordinates."""
    f = build(problem, name, **scheme)
    state = f.start(problem.start, t=problem.origin)
    times = problem.origin + TIMES
    return f.run(state, times, problem.paths.swapaxes(0, 1))


def assert_close(a: Any, b: Any) -> None:
    """Compare arrays to nine digits of the largest number."""
    assert np.allclose(a, b, rtol=0, atol=1e-9 * np.abs(b).max())


@each_protocol
def test_the_numbers_of_agents_are_names(name: str) -> None:
    problem = make_problem()
    order = [3, 6, 0, 5, 1, 2, 4]
    # Agent k of the new numbers is agent order[k] of the old ones.
    links = problem.graph.links.toarray()[np.ix_(order, order)]
    renamed = replace(
        problem,
        start=problem.start[order],
        paths=problem.paths[:, order],
        graph=Graph.from_adjacency(links),
    )
    a = run(problem, name)
    b = run(renamed, name)
    assert_close(b["mean"].values, a["mean"].values[:, order])
    assert_close(b["variance"].values, a["variance"].values[:, order])
    assert np.array_equal(b["scalars"].values, a["scalars"].values[:, order])


@each_protocol
def test_the_order_of_axes_changes_nothing(name: str) -> None:
    problem = make_problem()
    # The same swarm, with its second axis first
    swarm = Swarm(
        lambda x, t: drift(x[..., ::-1], t)[..., ::-1],
        lambda x, t: diffusion(x[..., ::-1], t)[..., ::-1],
        high=WIDTH[::-1],
    )
    turned = replace(
        problem,
        swarm=swarm,
        shape=SHAPE[::-1],
        bandwidth=problem.bandwidth[:, ::-1],
        start=problem.start[:, ::-1],
        paths=problem.paths[..., ::-1],
    )
    # The split scheme takes one axis after the other; this one takes both at once.
    a = run(problem, name, scheme="backward_euler")
    b = run(turned, name, scheme="backward_euler")
    for field in ("mean", "variance"):
        expected = a[field].values.reshape(-1, *SHAPE)
        result = b[field].values.reshape(-1, *SHAPE[::-1])
        assert_close(result.swapaxes(1, 2), expected)


@pytest.mark.parametrize("name", [n for n in PROTOCOLS if n != "pi, flat"])
def test_units_and_the_origin_of_places_change_nothing(name: str) -> None:
    """z = 50 x + 7: densities have the unit of an inverse area, their variances its square."""
    problem = make_problem()
    unit = 50.0

    def place(z: Array) -> Array:
        return (z - 7.0) / unit

    swarm = Swarm(
        lambda z, t: unit * drift(place(z), t),
        lambda z, t: unit**2 * diffusion(place(z), t),
        low=np.full(2, 7.0),
        high=7.0 + unit * WIDTH,
    )
    scaled = replace(
        problem,
        swarm=swarm,
        bandwidth=unit * problem.bandwidth,
        start=7.0 + unit * problem.start,
        paths=7.0 + unit * problem.paths,
    )
    area = unit**2
    a = run(problem, name)
    b = run(scaled, name)
    assert_close(area * b["mean"].values, a["mean"].values)
    assert_close(area**2 * b["variance"].values, a["variance"].values)
    assert_close(b["mass"].values, a["mass"].values)


@each_protocol
def test_the_zero_of_the_clock_changes_nothing(name: str) -> None:
    problem = make_problem()
    later = Swarm(
        lambda x, t: drift(x, t - 40.0),
        lambda x, t: diffusion(x, t - 40.0),
        high=WIDTH,
    )
    a = run(problem, name)
    b = run(replace(problem, swarm=later, origin=40.0), name)
    assert_close(b["mean"].values, a["mean"].values)
    assert_close(b["variance"].values, a["variance"].values)


@each_protocol
def test_a_run_in_two_calls_is_the_run_in_one(name: str) -> None:
    """The agents' memory is part of the state."""
    problem = make_problem()
    in_one = run(problem, name)
    f = build(problem, name)
    state = f.start(problem.start)
    observed = problem.paths.swapaxes(0, 1)
    *_, between = f.steps(state, TIMES[:2], observed[:, :2])
    *_, after = f.steps(between, TIMES[2:], observed[:, 2:])
    assert np.array_equal(after.estimates, in_one["mean"].values[-1])
    assert np.array_equal(after.variances, in_one["variance"].values[-1])
    assert after.ledger.scalars.sum() == in_one["scalars_total"].values[-1].sum()


@each_network
def test_agents_without_links_do_not_notice_the_others(name: str) -> None:
    """Whatever agents 1 to 6 do, only their number enters, in the noise of the observed density."""
    problem = replace(make_problem(), graph=Graph.from_edges(AGENTS, []))
    # The others are somewhere else at all times.
    mirrored = WIDTH - problem.paths
    mirrored[:, 0] = problem.paths[:, 0]
    a = run(problem, name)
    b = run(replace(problem, paths=mirrored), name)
    for field in ("mean", "variance"):
        one = a[field].values
        other = b[field].values
        assert np.array_equal(one[:, 0], other[:, 0])
        # They do notice themselves.
        assert not np.allclose(one[:, 1], other[:, 1])
