"""A problem without symmetries on which every family runs, and the same one in other names.

A bent model whose noise depends on time, sensors of one and two numbers with other noise, an
agent without a sensor, a digraph, a prior for each agent, missing numbers, and other data in
every run. Without process noise, filters of members draw nothing after their prior.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from distfilt import filters, network
from distfilt.density import Grid
from distfilt.filters import Observation
from distfilt.mixtures import GaussianMixture, target_fusion
from distfilt.models import Model
from distfilt.network import Graph
from distfilt.sensors import Sensor
from distfilt.updates import etkf

Array = np.ndarray
Series = list[Observation]

TIMES = np.array([0.3, 0.7, 0.8, 1.5])
Q = np.array([[0.30, 0.10, -0.05], [0.10, 0.25, 0.04], [-0.05, 0.04, 0.20]])
COVS = np.array([np.eye(3), Q + 0.2 * np.eye(3), 3 * Q, 0.3 * np.eye(3) + Q])
MEANS = np.array(
    [[1.0, -0.5, 0.3], [0.8, -0.2, 0.1], [1.2, -0.6, 0.5], [0.9, -0.4, 0.2]]
)
DIGRAPH = Graph.from_edges(4, [(0, 1), (1, 3), (2, 1), (3, 0), (3, 2)], directed=True)
TREE = Graph.from_edges(4, [(0, 1), (1, 3), (1, 2)])
APART = Graph.from_edges(4, [])


def move(x: Array, t: float, dt: float) -> Array:
    """Bend the first component by the second one, and shear the last with time."""
    columns = [x[..., 0] + dt * np.sin(x[..., 1]), x[..., 1] - 0.1 * dt * x[..., 0]]
    if x.shape[-1] == 3:
        columns.append(x[..., 2] + dt * (0.3 + 0.2 * t) * x[..., 1])
    return np.stack(columns, axis=-1)


def differentiate_move(x: Array, t: float, dt: float) -> Array:
    d = x.shape[-1]
    slope = np.zeros((*x.shape, d))
    slope[...] = np.eye(d)
    slope[..., 0, 1] = dt * np.cos(x[..., 1])
    slope[..., 1, 0] = -0.1 * dt
    if d == 3:
        slope[..., 2, 1] = dt * (0.3 + 0.2 * t)
    return slope


def see_bent(x: Array) -> Array:
    return np.stack([x[..., 0] + 0.2 * x[..., 1] ** 2, x[..., 1] - x[..., -1]], axis=-1)


def differentiate_bent(x: Array) -> Array:
    slope = np.zeros((*x.shape[:-1], 2, x.shape[-1]))
    slope[..., 0, 0] = 1.0
    slope[..., 0, 1] = 0.4 * x[..., 1]
    slope[..., 1, 1] += 1.0
    slope[..., 1, -1] -= 1.0
    return slope


def see_one(x: Array, index: int) -> Array:
    return x[..., [index]]


def select(d: int, index: int) -> Array:
    return np.eye(d)[[index]]


def linear_sensor(index: int, variance: float) -> Sensor:
    return Sensor(
        1,
        partial(see_one, index=index),
        [[variance]],
        linear=partial(select, index=index),
    )


def bent_sensor(covariance: Any) -> Sensor:
    return Sensor(2, see_bent, covariance, derivative=differentiate_bent)


def make_team() -> list[Any]:
    return [
        linear_sensor(0, 0.3),
        [bent_sensor([[0.5, 0.2], [0.2, 0.4]]), linear_sensor(-1, 0.8)],
        None,
        [bent_sensor([[0.3, -0.1], [-0.1, 0.6]])],
    ]


@dataclass(frozen=True)
class Problem:
    """All that a filter is given."""

    model: Model
    sensors: list[Any]
    graph: Graph
    priors: list[tuple[Array, Array]]
    members: Array
    events: Series
    cells: Grid

    @property
    def d(self) -> int:
        return int(self.model.dim)


def make_problem(
    d: int = 3, *, runs: int = 0, noise: bool = True, graph: Graph = DIGRAPH
) -> Problem:
    """Make the problem with d components; without noise for filters of members."""
    rate = float(noise)

    def noise_cov(t: float, dt: float) -> Array:
        return rate * dt * (1 + 0.5 * t) * Q[:d, :d]

    team = make_team()
    rng = np.random.default_rng(5)
    events = []
    for t in TIMES:
        for agent, sensors in enumerate(team):
            listed = [] if sensors is None else sensors
            listed = [listed] if isinstance(listed, Sensor) else listed
            for number, sensor in enumerate(listed):
                value = 0.5 + rng.normal(size=(*[runs] * (runs > 0), sensor.dim))
                # Every third number is missing, but the first of an observation is there.
                lost = rng.random(value.shape) < 1 / 3
                lost[..., 0] = False
                value[lost] = np.nan
                events.append(Observation(t, agent, value, number))
    # One value far off, which a gate refuses.
    far = events[0].value.copy()
    far[..., 0] = 9.0
    events[0] = replace(events[0], value=far)
    return Problem(
        Model(d, move, noise_cov, derivative=differentiate_move),
        team,
        graph,
        [(m[:d], p[:d, :d]) for m, p in zip(MEANS, COVS, strict=True)],
        draw_members()[..., :d],
        events,
        Grid((42, 44, 40)[:d], low=-5.0, high=7.0),
    )


def draw_members() -> Array:
    """Draw members of every agent's prior, (A, 400, 3)."""
    z = np.random.default_rng(8).standard_normal((400, 3))
    return MEANS[:, None] + z @ np.linalg.cholesky(COVS).mT


def transform(problem: Problem, matrix: Array) -> Problem:
    """Describe the same problem by z = M x, where M scales or permutes components."""
    inverse = np.linalg.inv(matrix)
    model = problem.model

    def step(z: Array, t: float, dt: float) -> Array:
        return move(z @ inverse.T, t, dt) @ matrix.T

    def slope(z: Array, t: float, dt: float) -> Array:
        return matrix @ differentiate_move(z @ inverse.T, t, dt) @ inverse

    def noise_cov(t: float, dt: float) -> Array:
        return matrix @ model.Q(t, dt) @ matrix.T

    known: dict[Sensor, Sensor] = {}

    def change(sensor: Sensor) -> Sensor:
        def h(z: Array) -> Array:
            return sensor.h(z @ inverse.T)

        def derivative(z: Array) -> Array:
            return sensor.jacobian(z @ inverse.T) @ inverse

        def linear(d: int) -> Array:
            return sensor.H(d) @ inverse

        if sensor.linear is None:
            changed = Sensor(sensor.dim, h, sensor.noise_cov, derivative=derivative)
        else:
            changed = Sensor(sensor.dim, h, sensor.noise_cov, linear=linear)
        return known.setdefault(sensor, changed)

    order = np.abs(matrix).argmax(axis=1)
    factors = matrix.sum(axis=1)
    cells = problem.cells
    return replace(
        problem,
        model=Model(problem.d, step, noise_cov, derivative=slope),
        sensors=change_sensors(problem.sensors, change),
        priors=[(matrix @ m, matrix @ p @ matrix.T) for m, p in problem.priors],
        members=problem.members @ matrix.T,
        cells=Grid(
            tuple(cells.shape[k] for k in order),
            low=factors * np.asarray(cells.low)[order],
            high=factors * np.asarray(cells.high)[order],
        ),
    )


def change_sensors(team: list[Any], change: Callable[[Sensor], Sensor]) -> list[Any]:
    changed: list[Any] = []
    for sensors in team:
        if isinstance(sensors, Sensor):
            changed.append(change(sensors))
        else:
            changed.append(sensors and [change(sensor) for sensor in sensors])
    return changed


def permute_agents(problem: Problem, order: Sequence[int]) -> Problem:
    """Number the agents anew: the new agent k is the old agent order[k]."""
    links = problem.graph.links.toarray()[np.ix_(order, order)]
    events = [replace(e, agent=list(order).index(e.agent)) for e in problem.events]
    return replace(
        problem,
        sensors=[problem.sensors[k] for k in order],
        priors=[problem.priors[k] for k in order],
        members=problem.members[order],
        graph=Graph.from_adjacency(links, directed=True),
        events=events,
    )


def two_components(problem: Problem) -> list[Any]:
    """Give each agent a mixture of two Gaussians about its prior."""
    result = []
    for m, p in problem.priors:
        shift = 0.4 * np.sqrt(p.diagonal())
        means = [m - shift, m + 2 * shift]
        result.append(GaussianMixture([0.6, 0.4], means, [p, 0.5 * p]))
    return result


MEMBERS = 60


@dataclass(frozen=True)
class Case:
    """A filter with some options, and the abilities of its family."""

    make: Callable[..., Any]
    options: dict[str, Any]
    prior: str = "list"
    graph: Graph = DIGRAPH
    d: int = 3
    noise: bool = True
    runs: bool = True
    turns: bool = True
    """Whether a permutation of components changes no number, as it does for unscented points."""
    scales: bool = True


CI = partial(network.covariance_intersection, rule="min_determinant")
AVERAGE = partial(network.average_consensus, rounds=2)
MIXED = {"target_dim": 3, "fusion": partial(target_fusion, target_dim=3)}
ALL = {"gate_probability": 0.99, "record_evidence": True}
STILL: dict[str, Any] = {"noise": False, "prior": "members"}
CASES: dict[str, Case] = {
    "gaussian": Case(filters.GaussianFilter, {}),
    "gaussian, all": Case(
        filters.GaussianFilter,
        {**ALL, "lag": 2, "inflation": 1.05, "hops": 2, "iterations": 2},
    ),
    "gaussian, unscented": Case(
        filters.GaussianFilter,
        {**ALL, "linearization": "unscented", "kappa": 0.7, "fusion": CI, "lag": 1},
        turns=False,
    ),
    "gaussian, alone and fused": Case(
        filters.GaussianFilter,
        {"share_observations": False, "fusion": network.covariance_intersection},
    ),
    "gaussian, waiting": Case(
        filters.GaussianFilter, {"lag": 4, "exchange_interval": 0.75}
    ),
    "ensemble": Case(
        filters.EnsembleFilter,
        {
            **ALL,
            "members": MEMBERS,
            "update": partial(etkf, rotation="none"),
            "fusion": network.intersect_ensembles,
            "lag": 2,
        },
        **STILL,
    ),
    "particle": Case(
        filters.ParticleFilter,
        {**ALL, "members": 400, "ess_threshold": 0.0, "lag": 1},
        **STILL,
    ),
    "transport": Case(
        filters.TransportFilter,
        {**ALL, "members": MEMBERS, "lag": 1},
        graph=TREE,
        scales=False,
        **(STILL | {"prior": "common members"}),
    ),
    "likelihood consensus": Case(
        filters.LikelihoodConsensusFilter,
        {
            **ALL,
            "members": 400,
            "ess_threshold": 0.0,
            "fusion": AVERAGE,
            "basis": filters.PolynomialBasis([0, 1, 2], degree=2),
        },
        graph=TREE,
        **STILL,
    ),
    "grid": Case(filters.GridFilter, {**ALL, "grid": None}, d=2),
    "grid, likelihoods": Case(
        filters.GridFilter,
        {
            **ALL,
            "grid": None,
            "share_observations": False,
            "fusion": AVERAGE,
            "fused": "likelihoods",
        },
        d=2,
        graph=TREE,
    ),
    "sum": Case(filters.GaussianSumFilter, {**ALL, "hops": 2}, prior="mixtures"),
    "sum, unscented": Case(
        filters.GaussianSumFilter,
        {**ALL, "linearization": "unscented", "kappa": 0.7, "inflation": 1.1},
        prior="mixtures",
        turns=False,
    ),
    "channel": Case(
        filters.ChannelFilter, {**ALL, "inflation": 1.05}, prior="one", graph=TREE
    ),
    "consensus": Case(
        filters.InformationConsensusFilter, {**ALL, "fusion": AVERAGE}, graph=TREE
    ),
    "consensus, hybrid": Case(
        filters.InformationConsensusFilter,
        {"fusion": AVERAGE, "average": "hybrid", "weight": 2.5},
        graph=TREE,
    ),
    "consensus, measurements": Case(
        filters.InformationConsensusFilter,
        {
            "fusion": AVERAGE,
            "average": "measurements",
            "weight": 2.5,
            "linearization": "unscented",
        },
        graph=TREE,
        turns=False,
    ),
    "mixture": Case(
        filters.MixtureFilter,
        {"target_dim": 3, "fusion": partial(target_fusion, target_dim=3)},
        prior="mixtures",
        runs=False,
        turns=False,
    ),
    "increments": Case(
        filters.InformationIncrementFilter,
        {"target_dim": 3, "gate_probability": 0.99},
        runs=False,
        turns=False,
    ),
}


def make_prior(case: Case, problem: Problem) -> Any:
    number = case.options.get("members", 0)
    return {
        "list": lambda: problem.priors,
        "one": lambda: problem.priors[0],
        "mixtures": lambda: two_components(problem),
        "members": lambda: list(problem.members[:, :number]),
        "common members": lambda: problem.members[0, :number],
    }[case.prior]()


def build(case: Case, problem: Problem, **changes: Any) -> Any:
    options = case.options | changes
    if "grid" in options:
        options["grid"] = problem.cells
    graph = options.pop("graph", problem.graph)
    return case.make(problem.model, problem.sensors, graph, **options)


def record(case: Case, problem: Problem, runs: int = 0, **changes: Any) -> Any:
    """Run a filter on all events, and return its record."""
    f = build(case, problem, **changes)
    start = f.start(
        make_prior(case, problem),
        rng=np.random.default_rng(0),
        runs=(runs,) if runs else (),
    )
    silence: list[Any] = [[None] * len(TIMES)] * len(problem.sensors)
    return f.run(start, TIMES, problem.events or silence)


def problem_of(case: Case, runs: int = 0) -> Problem:
    return make_problem(case.d, runs=runs, noise=case.noise, graph=case.graph)


def one_run(problem: Problem, run: int) -> Problem:
    events = [replace(e, value=e.value[run]) for e in problem.events]
    return replace(problem, events=events)


def assert_equal(a: Any, b: Any, names: Sequence[str] = (), atol: float = 1e-9) -> None:
    """Compare all beliefs and scores of two records."""
    kinds = ("mean", "variance", "covariance", "rejected", "log_likelihood", "nis")
    present = [name for name in (*kinds, "n_observed", "unseen") if name in a]
    for name in names or present:
        assert np.allclose(
            a[name].values, b[name].values, rtol=1e-7, atol=atol, equal_nan=True
        ), name
