"""Valid calls, which no doctest makes, for ``fuzz.py``: filters, networks, sensors, studies."""

from __future__ import annotations

from typing import Any

import networkx
import numpy as np

from distfilt import filters, models, network, published, sensors, studies
from distfilt.density import Flooding, FokkerPlanck, Grid, PIConsensus
from distfilt.mixtures import GaussianMixture, fuse

RNG = np.random.default_rng
PATH = network.graphs.path(2)
WALK = models.Model(2, lambda x, t, dt: x, lambda t, dt: 0.1 * dt * np.eye(2))
STILL = models.LinearModel.from_transition(
    2, lambda dt: np.eye(2), lambda t, dt: dt * np.eye(2), names=("x", "y"), units=("m", "m")
)
EYES = [sensors.direct([0], std=0.5), sensors.direct([1], std=0.5)]
PRIOR = np.zeros(2), np.eye(2)
TIMES = np.array([1.0, 2.0])
SERIES = [np.array([[0.8], [0.7]]), np.array([[-0.8], [-0.6]])]
LATE = [filters.Late(0, 1.0, [0.7], arrived=2.0)]


def trial(seed: Any) -> float:
    return float(np.random.default_rng(seed).normal())


def with_sensors() -> None:
    """Every family of the filters that read sensors: stepped, run, smoothed, kept."""
    for kind, options in (
        (filters.GaussianFilter, {}), (filters.EnsembleFilter, {"members": 8}),
        (filters.ParticleFilter, {"members": 20}), (filters.TransportFilter, {"members": 8}),
    ):  # fmt: skip
        f = kind(WALK, EYES, PATH, lag=2, **options)
        state = f.start(PRIOR, rng=RNG(0))
        list(f.steps(state, TIMES, SERIES, late=LATE))
        done = f.run(state, TIMES, SERIES, truth=np.zeros((2, 2)), late=LATE)
        f.smooth(state, TIMES, SERIES, truth=np.zeros((2, 2)), late=LATE)
        last = filters.final_state(done)
        f.summary(last)
        f.past(last)
        f.series(SERIES, TIMES)
        f.observed(last, [[0.5], None])
        f.elapsed(last, 3.0)
        last.save(f"{kind.__name__}.npz")
        type(last).load(f"{kind.__name__}.npz")
        last.shown(last.belief)
    f.leading((3,), 1)
    f.moments(PRIOR, semidefinite=True)
    f.drawn(PRIOR, 4, (2,), RNG(1))
    f.drawn(np.zeros((4, 2)), 4, (), RNG(1), sets=1)
    f.first(type(last), 0.0, RNG(0), np.zeros((2, 8, 2)))
    filters.State(0.0, network.Ledger.empty(2), None).save("state.npz")
    filters.State.load("state.npz")


def step_by_step() -> None:
    """The parts of a step."""
    f = filters.EnsembleFilter(WALK, EYES, PATH, members=8, lag=1)
    state = f.start(PRIOR, rng=RNG(0))
    step = f.begin(state, type(state), 1.0, [[0.8], [-0.8]], ())
    moved = step.moved(state.belief, 0.0, 2)
    step.settle({}, range(2))
    step.kept(moved, np.zeros(2))
    step.stack(moved)
    step.before(0, [0, 1])
    step.agreed(moved)
    step.end(type(state), moved, history=[(0.0, moved)])


def of_densities_and_mixtures() -> None:
    swarm, rng = models.rotating_swarm(), RNG(1)
    x = rng.random((6, 2))
    for sharing in (Flooding(), PIConsensus()):
        f = filters.DensityFilter(
            FokkerPlanck(swarm, Grid((7, 7))), 6, 0.6, sharing, bandwidth=0.2, rank=9
        )
        begun = f.start(x)
        f.series([x, x], TIMES)
        f.run(begun, [0.1, 0.2], [x, x])
        f.summary(begun)
    swarm.simulate(x, [0.1, 0.2], rng=rng)
    swarm.check(x)
    prior = GaussianMixture.gaussian([0.0, 0.0], [[1.0, 0.5], [0.5, 1.0]])
    g = filters.MixtureFilter(
        [WALK, WALK], EYES, PATH, target_dim=1, agreement=fuse, stretch=0.5, scale=[1.0, 1.0]
    )
    state = g.start([prior, prior])
    done = g.run(state, TIMES, [[[0.8], None], [None, [0.5]]])
    g.summary(state)
    g.series([[[0.8], None]], TIMES[:1])
    g.steps(state, TIMES[:1], [[[0.8], None]])
    g.past(state)
    filters.final_state(done).save("mixtures.npz")
    filters.MixtureState.load("mixtures.npz")


def of_models_and_sensors() -> None:
    x = np.array([[1.0, 2.0], [3.0, 4.5]])
    for model in (WALK, STILL):
        model.jacobian(x, 0.0, 0.5)
        model.sample_step(x, 0.0, 0.5, rng=RNG(0))
    STILL.transition(0.5)
    models.LinearModel(
        2, lambda x, t, dt: x, lambda t, dt: dt * np.eye(2), names=("x", "y"), units=("m", "m"),
        transition_matrix=lambda dt: np.eye(2),
    )
    round_ = models.RotatingMixture()
    round_.density(x, 0.5)
    round_.score(x, 0.5)
    low = np.array([7000.0, 0.0, 0.0, 0.0, 7.5e3, 0.0])
    models.orbit.propagate(low, 60.0)
    models.orbit.rsw_frame(low)
    models.orbit.orbits(2, position_std=0.1, velocity_std=0.1)
    models.orbit.occulted([42164.0, 0.5, 0.5], [-42164.0, 0.5, 0.5])
    for sensor in (EYES[0], sensors.distance([0, 1], std=0.1)):
        sensor.jacobian(x)
        sensor.observe(x, rng=RNG(0))
    change = sensors.differential([0], std=0.1)
    change.jacobian(x, x - 0.5)
    change.observe(x, rng=RNG(0), previous=x - 0.5)
    EYES[0].matrix(2)


def of_networks() -> None:
    network.Graph(PATH.links)
    network.Graph.from_adjacency([[0, 1], [1, 0]])
    network.Graph.from_edges(2, [[0, 1], [1, 0]])
    network.Graph.from_networkx(networkx.path_graph(3))
    PATH.hops(1)
    PATH.neighbours(1)
    PATH.to_networkx()
    faults = network.Faults(loss=0.2, seed=7, silent=[1], during=[(1, 2)], clock="time")
    faults.check(PATH)
    faults.speaking(PATH, 0, 1.5)
    faults.lost(PATH, 0, 2, 1.5)
    weights = network.weights.metropolis(PATH)
    network.Weights(PATH, weights.own, weights.links)
    network.Weights.from_matrix(PATH, np.array([[0.5, 0.5], [0.25, 0.75]]))
    for lossy in (None, faults):
        channel = network.Channel(PATH, runs=(3,), faults=lossy, t=1.5)
        values = RNG(0).standard_normal((3, 2, 2))
        channel.combine(values, weights)
        channel.combine_with_own(values, np.array([[0.5, 0.5], [0.25, 0.75]]))
        channel.broadcast(values)
        channel.carry(values, links=[True, True])
        channel.carry(values)


def of_papers_and_studies() -> None:
    scenario = published.scenario("grange", "table-2")
    reading = scenario.reading()
    reading.cells()
    printed = published.table("grange", "table-2")
    printed.records()
    published.Table(printed.columns, printed.rows, printed.path, printed.lines)
    study = studies.run(trial, studies.spawn(1, 4), workers=1)
    study.metrics(["draw"])
    study.frame(["draw"])
    study.seed(2)
    studies.store(study, "study.csv", parameters={"mean": 0.5}, columns=["draw"])
    kept = studies.load("study.csv")
    kept.metric("draw")
    kept.seed(1)
    studies.check("study.csv", trial)
    studies.check(kept, trial, indices=[0, 1], rough=["draw"], odd=1)
    studies.stored("grange", "figure-2")
    studies.script("lorenz-63")


for each in (with_sensors, step_by_step, of_densities_and_mixtures, of_models_and_sensors,
             of_networks, of_papers_and_studies):  # fmt: skip
    each()
