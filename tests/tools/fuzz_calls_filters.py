"""Valid calls, which no doctest makes, for ``fuzz.py``: filters, networks, sensors."""

from __future__ import annotations

from typing import Any

import networkx
import numpy as np

from distfilt import filters, models, network, sensors, updates
from distfilt.coupling import norm
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
    for lossy in (None, faults):
        channel = network.Channel(PATH, runs=(3,), faults=lossy, t=1.5)
        values = RNG(0).standard_normal((3, 2, 2))
        channel.combine(values, weights)
        channel.broadcast(values)
        channel.carry(values, links=[True, True])
        channel.carry(values)


def filters_with_every_option() -> None:
    names = ["left", "right"]
    some = network.Faults(loss=0.1, seed=3)
    team: dict[str, Any] = {"names": names, "faults": some, "share": True, "failures": "keep"}
    for kind, options in (
        (filters.GaussianFilter,
         {"agreement": network.covariance_intersection, "rule": "unscented", "kappa": 0.5}),
        (filters.EnsembleFilter, {"agreement": network.intersection, "members": 8}),
        (filters.ParticleFilter, {"agreement": paired, "members": 20, "jitter": 0.1}),
        (filters.TransportFilter,
         {"agreement": network.finite_time, "members": 8, "rejuvenation": 0.1}),
    ):  # fmt: skip
        f = kind(WALK, EYES, PATH, **team, **options)
        f.start(PRIOR, rng=RNG(0), runs=(2,), t=0.5)
    filters.EnsembleFilter.exact(WALK, EYES, PATH, members=12)
    mixed: dict[str, Any] = {"names": names, "faults": some, "stretch": 0.5, "gate": 3.0}
    for mixture, options in (
        (filters.MixtureFilter, {"agreement": fuse}), (filters.NewsFilter, {"common": [0]})
    ):
        mixture(
            [WALK, WALK], EYES, PATH, target_dim=1, scale=np.array([1.0, 2.0]), **mixed, **options
        )
    grid = Grid((7, 7))
    swarm = FokkerPlanck(models.rotating_swarm(), grid)
    filters.DensityFilter(
        swarm, 6, 0.6, PIConsensus(), bandwidth=0.2, rank=9, local=(0, 2), first=np.ones(49),
        process=0.1, faults=some, names=["a", "b", "c", "d", "e", "f"], mass_std=0.1,
    )
    filters.Summary(
        np.zeros((2, 1)), np.ones((2, 1)), np.ones((2, 1, 1)), np.zeros((2, 4, 1)),
        np.full((2, 4), 0.25), {"size": np.ones(2)},
    )
    step = filters.GaussianFilter(WALK, EYES, PATH, lag=1)
    state = step.step(step.start(PRIOR), 1.0, [[0.5], None])
    step.begin(state, type(state), 2.0, [[0.5], None], [filters.Late(1, 1.0, [0.5], arrived=2.0)])
    step.gather([np.array([0.5]), None], network.Channel(PATH))


def paired(points: Any, logs: Any, channel: Any) -> Any:
    return points, logs


def others_with_every_option() -> None:
    words: dict[str, Any] = {"names": ("x", "y"), "units": ("m", "m")}
    still = lambda t, dt: dt * np.eye(2)  # noqa: E731
    models.Model(2, lambda x, t, dt: x, still, derivative=lambda x, t, dt: np.eye(2), **words)
    models.LinearModel(
        2, lambda x, t, dt: x, still, derivative=lambda x, t, dt: np.eye(2),
        transition_matrix=lambda dt: np.eye(2), **words,
    )
    models.LinearModel.from_transition(2, lambda dt: np.eye(2), still, **words)
    models.coordinated_turn(sigma=0.1, turn_sigma=0.2)
    models.rotating_swarm(mixture=models.RotatingMixture(centre=np.array([0.5, 0.6])))
    models.Swarm(lambda x, t: 0 * x, np.array([0.01, 0.02]), low=[0.0, 0.0], high=[2.0, 1.0])
    sensors.Sensor(
        1, lambda x: x[..., :1], [[0.5]], difference=np.subtract, kind="first",
        linear=lambda d: np.eye(1, d), derivative=lambda x: np.eye(1, 2), units=("m",),
    )
    channel = network.Channel(PATH, ledger=network.Ledger.empty(2), runs=(), t=0.5)
    weights = network.weights.metropolis(PATH)
    x, members = np.array([[1.0], [3.0]]), RNG(0).standard_normal((2, 6, 2))
    means, covs = np.zeros((2, 2)), np.tile(np.eye(2), (2, 1, 1))
    network.covariance_intersection((means, covs), channel, rule="trace")
    network.intersection(members, channel, rule="equal")
    network.average(x, channel, weights=weights, rounds=2)
    network.event_triggered(x, channel, rounds=3, threshold=0.1, weights=weights)
    network.first_order(x, x + 0.5, x, channel, weights=weights)
    network.flood(x, channel, rounds=2)
    network.maximum(x, channel, rounds=2)
    network.pi_step(network.pi_start(x), x, channel, dt=0.1, alpha=0.2, a=0.4, b=0.04,
                    rate=0.5 * x, substeps=3)  # fmt: skip
    network.Faults(loss=0.1, also=(network.Faults(silent=[1]),), burst=3.0, delay=1)
    sensors.angle([0, 1], std=0.1, full=True, origin=np.array([0.5, 1.5]))
    sensors.distance([0, 1], std=0.1, origin=np.array([0.5, 1.5]))
    sensors.line_of_sight(std=1e-4, hidden=models.occulted)
    seen = RNG(0).standard_normal((8, 2))
    given: dict[str, Any] = {"rng": RNG(0)}
    updates.ensemble_transform(seen, seen[:, :1], [0.5], [[1.0]], **given)
    updates.retracted(updates.known_noise, norm([0]), motion=([0], [1]))
    swarm, start = models.rotating_swarm(), np.array([[0.25, 0.5]])
    swarm.diffusion_at(start, 0.0)
    network.Graph.from_adjacency([[0, 1], [0, 0]], directed=True)
    for team in (filters.GaussianFilter(WALK, EYES, PATH),
                 filters.EnsembleFilter(WALK, EYES, PATH, members=4),
                 filters.ParticleFilter(WALK, EYES, PATH, members=4),
                 filters.TransportFilter(WALK, EYES, PATH, members=4)):  # fmt: skip
        team.start(PRIOR, rng=RNG(0), runs=(2,), t=0.5)


for each in (with_sensors, step_by_step, of_densities_and_mixtures, of_models_and_sensors,
             of_networks, filters_with_every_option,
             others_with_every_option):  # fmt: skip
    each()
