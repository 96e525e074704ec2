"""Observations that travel over several links: who has them, and their cost."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng

from distfilt.filters import EnsembleFilter, GaussianFilter, Observation
from distfilt.network import Faults, Graph, graphs
from distfilt.sensors import component, distance
from distfilt.updates import etkf, serially
from tests.filters.families import FAMILIES, PRIOR, TIMES, data, model, still_model

SHARING = [
    name for name in FAMILIES if name not in ("ensemble, common", "ensemble, exact")
]
"""Families that share observations and do not fuse beliefs by default."""
NETWORKS = {
    "path": graphs.path(6),
    "ring": graphs.ring(6),
    "star": graphs.star(6),
    "grid": graphs.grid(2, 3),
    # Neighbours that are equally far from others, as on no graph above.
    "kite": Graph.from_edges(6, [(0, 1), (1, 2), (2, 0), (2, 3), (3, 4), (4, 5)]),
}
each_network = pytest.mark.parametrize("graph", NETWORKS.values(), ids=NETWORKS.keys())


def team(agents: int = 6) -> list[Any]:
    """Sensors of one number, the last agent without one."""
    sensors: list[Any] = []
    for k in range(agents):
        sensors.append(component([k % 2], std=0.5 + 0.1 * k))
    return [*sensors[:-1], None]


def last_state(
    graph: Graph, hops: Any, family: str = "gaussian", **options: Any
) -> Any:
    """Return the state after a run of a team."""
    sensors = team(graph.n_agents)
    _, seen = data(sensors, options.pop("runs", ()))
    runs = seen[0].shape[1:-1]
    # Every family is made alike, and draws from the same stream.
    f = FAMILIES[family](model(), sensors, graph, hops=hops, **options)
    state = f.start(PRIOR, rng=default_rng(3), runs=runs)
    *_, last = f.steps(state, TIMES, seen)
    return last


def beliefs(state: Any) -> np.ndarray:
    for name in ("joint_means", "ensembles", "particles"):
        if hasattr(state, name):
            return np.asarray(getattr(state, name))
    raise AssertionError(name)


@pytest.mark.parametrize("family", SHARING)
def test_flooding_any_connected_graph_is_one_hop_on_a_complete_one(family: str) -> None:
    """The same observations in the same order: the same numbers."""
    flooded = last_state(NETWORKS["grid"], "all", family)
    complete = last_state(graphs.complete(6), 1, family)
    assert (beliefs(flooded) == beliefs(complete)).all()


@each_network
@pytest.mark.parametrize("hops", [1, 2, 3, "all"])
def test_observations_come_as_many_links_far(graph: Graph, hops: Any) -> None:
    """After one step an agent's information is that of the sensors within reach."""
    sensors = [component([0], std=1.0)] * 6
    f = GaussianFilter(still_model(1), sensors, graph, hops=hops)
    state = f.start(([0.0], [[1.0]]))
    state = f.step(state, 1.0, [[1.0]] * 6)
    # 1 / P = 1 + number of observations
    count = 1 / state.covariances.ravel() - 1
    reach = 6 if hops == "all" else hops
    expected = [(graph.hops(agent) <= reach).sum() for agent in range(6)]
    assert np.allclose(count, expected)


@pytest.mark.parametrize("agents", [3, 4, 5, 8])
def test_a_ring_costs_half_of_an_echo(agents: int) -> None:
    """Own observation on two links, each other one onward: A messages of two numbers."""
    f = GaussianFilter(
        still_model(1),
        [component([0], std=1.0)] * agents,
        graphs.ring(agents),
        hops="all",
    )
    start = f.start(([0.0], [[1.0]]))
    ledger = f.step(start, 0.0, [[1.0]] * agents).ledger
    # The farthest agents of an odd ring have it from one side, and send it to each other.
    assert (ledger.scalars == 2 * (agents + agents % 2)).all()
    # By broadcast each observation is sent once, unless all neighbours have it.
    assert (ledger.broadcast_scalars == 2 * (agents - 1 + agents % 2)).all()


@each_network
def test_each_agent_forwards_an_observation_once(graph: Graph) -> None:
    """To all neighbours but those that are one link nearer to the agent that made it."""
    f = GaussianFilter(still_model(1), [component([0], std=1.0)] * 6, graph, hops="all")
    start = f.start(([0.0], [[1.0]]))
    ledger = f.step(start, 0.0, [[1.0]] * 6).ledger
    for agent in range(6):
        count = 0
        for maker in range(6):
            hops = graph.hops(maker)
            near = graph.neighbours(agent)
            count += sum(hops[j] >= hops[agent] for j in near)
        # The value, and the number of its maker
        assert ledger.scalars[agent] == 2 * count


@pytest.mark.parametrize("graph", [NETWORKS["path"], NETWORKS["star"]])
def test_on_a_tree_an_observation_crosses_every_link_once(graph: Graph) -> None:
    f = GaussianFilter(still_model(1), [component([0], std=1.0)] * 6, graph, hops="all")
    start = f.start(([0.0], [[1.0]]))
    ledger = f.step(start, 0.0, [[1.0]] * 6).ledger
    assert ledger.scalars.sum() == 6 * 5 * 2


def test_lost_messages_run_by_run() -> None:
    """Each run of a batch has the observations that it would have alone, by a second way too."""
    graph = graphs.ring(6)
    sensors = [component([0], std=1.0)] * 6
    faults = Faults(loss=0.3, seed=4)
    f = GaussianFilter(still_model(1), sensors, graph, hops="all", faults=faults)
    values = default_rng(0).standard_normal((6, 40, 1))
    start = f.start(([0.0], [[1.0]]), runs=(40,))
    state = f.step(start, 1.0, list(values))
    # 1 / P = 1 + number of observations, in each run
    count = 1 / state.covariances[..., 0, 0] - 1
    # From its own plan of losses, by hand.
    expected = np.zeros((40, 6, 6), dtype=bool)
    expected[:] = np.eye(6, dtype=bool)
    fresh = expected.copy()
    sources = np.zeros((40, 6, 6, 6), dtype=bool)
    for round_ in range(6):
        lost = faults.draw_losses(graph, round_, 40)
        received = np.zeros_like(fresh)
        for link, (i, j) in enumerate(zip(graph.receivers, graph.senders, strict=True)):
            # Fresh at j, not from i, and not lost
            is_new = fresh[:, j] & ~sources[:, j, i]
            sent = is_new & ~lost[:, link, None]
            sources[:, i, j] |= sent
            received[:, i] |= sent
        fresh = received & ~expected
        expected |= received
    assert np.allclose(count, expected.sum(axis=2))
    assert 0 < (count < 5.5).mean() < 1


def test_delayed_and_several_observations_are_flooded_too() -> None:
    """Observations that wait for an exchange keep their time and sensor on the way."""
    graph = graphs.path(4)
    sensors = [component([0], std=1.0)] * 4
    options: dict[str, Any] = {"lag": 4, "exchange_interval": 1.0}
    seen = [default_rng(k).standard_normal((4, 1)) for k in range(4)]
    states = []
    for network, hops in ((graph, "all"), (graphs.complete(4), 1)):
        f = GaussianFilter(still_model(1, 0.3), sensors, network, hops=hops, **options)
        start = f.start(([0.0], [[1.0]]))
        *_, last = f.steps(start, [0.3, 0.6, 0.9, 1.2], seen)
        states.append(last)
    assert np.array_equal(states[0].joint_means, states[1].joint_means)
    # All agents have all observations, assimilated in another order.
    assert np.abs(np.diff(states[0].means, axis=0)).max() < 1e-12


@pytest.mark.parametrize(("graph", "hops"), [("complete", 1), ("path", "all")])
def test_agents_that_have_all_observations_take_them_in_one_order(
    graph: str, hops: Any
) -> None:
    """A serial square root depends on the order, so that one agent with all sensors tells it."""
    sensors = [
        component([0], std=0.5),
        component([1], std=1.0),
        distance([0, 1], std=0.3),
    ]
    values = [[0.4], [-0.8], [1.5]]
    make = partial(
        EnsembleFilter, members=8, update=serially(partial(etkf, rotation="none"))
    )
    members = default_rng(0).standard_normal((8, 2)) + [1.0, 0.5]
    f = make(still_model(2), sensors, getattr(graphs, graph)(3), hops=hops)
    state = f.step(f.start(members, rng=default_rng(0)), 1.0, values)
    # The order of the agents is that of the sensors of one.
    for order, is_right in (([0, 1, 2], True), ([1, 0, 2], False)):
        one = make(still_model(2), [[sensors[k] for k in order]])
        seen = [Observation(1.0, 0, values[k], n) for n, k in enumerate(order)]
        alone = one.step(one.start(members, rng=default_rng(0)), 1.0, [seen])
        for agent in range(3):
            ours = state.ensembles[agent]
            assert np.allclose(ours, alone.ensembles[0], atol=1e-12) == is_right
