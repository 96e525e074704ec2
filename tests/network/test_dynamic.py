"""Agreement in time: lags, stability, gossip, sending on events, flooding, and what they cost."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.stats import chisquare

from distfilt import network
from distfilt.network import Channel, Faults, Graph, graphs, weights
from tests.network.helpers import GRID, named, rng

GAINS = {"alpha": 0.2, "a": 0.4, "b": 0.04}


@pytest.mark.parametrize(("rate", "lag"), [(0.0, 1 / GAINS["alpha"]), (1.0, 0.0)])
def test_the_lag_behind_a_ramp(rate: float, lag: float) -> None:
    """1 / α without the derivative, none with it, through losses: inputs u_i = i + t for 100 s."""
    graph = graphs.ring(5)
    base = np.arange(5.0)[:, None]
    state = network.pi_start(base)
    ledger = None
    slope = rate * np.ones_like(base) if rate else None
    for k in range(1000):
        channel = Channel(graph, ledger=ledger, faults=Faults(loss=0.2, seed=4))
        state = network.pi_step(
            state, base + 0.1 * k, channel, dt=0.1, rate=slope, **GAINS
        )
        ledger = channel.ledger
    behind = (base.mean() + 100.0) - state.estimate.mean()
    assert abs(behind - lag) < (1e-6 if lag else 1e-10)


@pytest.mark.parametrize("with_rate", [False, True])
def test_a_step_of_substeps_by_its_equations(with_rate: bool) -> None:
    """Euler steps of (25) with the inputs moving on inside the step, or standing still."""
    n = 7
    dt = 0.3
    draw = rng(2)
    u, nu, eta = draw.standard_normal((3, GRID.n_agents, 2))
    slope = draw.standard_normal(u.shape) if with_rate else np.zeros_like(u)
    laplacian = GRID.laplacian.toarray()
    h = dt / n
    wanted_nu = nu
    wanted_eta = eta
    for j in range(n):
        now = u + j * h * slope
        change = (
            -GAINS["alpha"] * (wanted_nu - now)
            - GAINS["a"] * laplacian @ wanted_nu
            + GAINS["b"] * laplacian.T @ wanted_eta
            + slope
        )
        wanted_nu, wanted_eta = (
            wanted_nu + h * change,
            wanted_eta - h * GAINS["b"] * laplacian @ wanted_nu,
        )
    channel = Channel(GRID)
    rate = slope if with_rate else None
    state = network.PIState(nu, eta)
    state = network.pi_step(state, u, channel, dt=dt, rate=rate, substeps=n, **GAINS)
    assert np.abs(state.estimate - wanted_nu).max() < 1e-13
    assert np.abs(state.integral - wanted_eta).max() < 1e-13
    assert (
        channel.ledger.rounds == n
        and (channel.ledger.scalars == 4 * n * GRID.out_degree).all()
    )


@pytest.mark.parametrize(
    ("graph", "dt", "gains", "limit"),
    [
        (graphs.complete(100), 9.9, (0.2, 0.4, 0.04), 2 / (0.2 + 0.4 * 198)),
        (graphs.path(2), 5.0, (0.3, 0.1, 0.14), 2 / (0.3 + 0.1 * 2)),
        (graphs.path(2), 5.0, (0.3, 0.1, 0.2), (0.3 + 0.1 * 2) / (0.2 * 2) ** 2),
        (graphs.path(2), 1e-6, (0.3, 0.1, 0.2), 1.0),
    ],
)
def test_substeps_are_half_as_long_as_the_bound(
    graph: Graph, dt: float, gains: tuple[float, float, float], limit: float
) -> None:
    """2 / (α + a λ), or (α + a λ) / (b λ)² where 2 b λ exceeds that, with λ twice the degree."""
    chosen = network.stable_substeps(
        Channel(graph), dt, **dict(zip(GAINS, gains, strict=True))
    )
    assert chosen == np.ceil(2 * dt / limit)


@named
def test_gossip_keeps_the_average_and_two_change_at_a_time(graph: Graph) -> None:
    values = rng(1).standard_normal((graph.n_agents, 2))
    draw = rng(3)
    for _ in range(30):
        channel = Channel(graph)
        new = network.gossip_consensus(values, channel, rounds=1, rng=draw)
        moved = np.flatnonzero((new != values).any(axis=1))
        assert moved.size == 2 and moved[1] in graph.neighbours(int(moved[0]))
        assert (new[moved] == values[moved].mean(axis=0)).all()
        assert (
            channel.ledger.messages[moved] == 1
        ).all() and channel.ledger.messages.sum() == 2
        assert channel.ledger.scalars.sum() == 4 and channel.ledger.rounds == 1
    whole = network.gossip_consensus(values, Channel(graph), rounds=4000, rng=rng(5))
    assert np.abs(whole - values.mean(axis=0)).max() < 1e-6
    assert np.abs(whole.mean(axis=0) - values.mean(axis=0)).max() < 1e-13


def test_meetings_are_drawn_evenly() -> None:
    """Each agent wakes with probability 1 / A and chooses its neighbours alike, at 99.9%."""
    graph = graphs.path(4)
    meetings = 2000
    values = np.arange(4.0)[:, None] ** 2
    counts = np.zeros(3)
    draw = rng(8)
    for _ in range(meetings):
        moved = (
            network.gossip_consensus(values, Channel(graph), rounds=1, rng=draw)
            != values
        )
        counts[np.flatnonzero(moved)[0]] += 1
    expected = meetings * np.array([1 + 0.5, 0.5 + 0.5, 0.5 + 1]) / 4
    assert chisquare(counts, expected).pvalue > 1e-3


def test_gossip_through_losses_keeps_the_average() -> None:
    values = rng(1).standard_normal((6, GRID.n_agents, 1))
    channel = Channel(GRID, runs=(6,), faults=Faults(loss=0.4, seed=2))
    out = network.gossip_consensus(values, channel, rounds=1500, rng=rng(3))
    assert np.abs(out.mean(axis=1) - values.mean(axis=1)).max() < 1e-13
    assert np.ptp(out, axis=1).max() < 1e-3
    assert (
        np.ptp(out[:, :, 0], axis=1) > 0
    ).all() and channel.ledger.messages.sum() == 4 * 1500
    silent = Channel(GRID, runs=(6,), faults=Faults(loss=1.0))
    assert (
        network.gossip_consensus(values, silent, rounds=50, rng=rng(3)) == values
    ).all()


@named
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_events_keep_the_average_and_agree_as_the_threshold_falls(
    graph: Graph, loss: float
) -> None:
    values = 10 * rng(1).standard_normal((graph.n_agents, 2))
    channel = Channel(graph, faults=Faults(loss=loss, seed=4))
    out = network.event_triggered(
        values, channel, rounds=600, threshold=1.0, decay=0.98
    )
    assert np.abs(out.mean(axis=0) - values.mean(axis=0)).max() < 1e-12
    assert 1e-9 < np.ptp(out, axis=0).max() < 1e-3
    assert loss > 0 or channel.ledger.messages.sum() < 0.5 * 600 * graph.senders.size


def test_without_a_threshold_events_are_plain_averaging() -> None:
    values = rng(1).standard_normal((GRID.n_agents, 2))
    channel = Channel(GRID)
    plain = Channel(GRID)
    out = network.event_triggered(values, channel, rounds=25, threshold=0.0)
    exact = plain.mix(values, weights.metropolis(GRID), rounds=25)
    assert np.abs(out - exact).max() < 1e-13
    assert (channel.ledger.scalars == plain.ledger.scalars).all()


def test_only_what_moved_is_sent() -> None:
    """All equal but one: after the first round only it and its neighbours have news."""
    channel = Channel(graphs.path(5))
    network.event_triggered(
        [[0.0], [0.0], [0.0], [0.0], [9.0]], channel, rounds=2, threshold=0.5
    )
    # All send once, both ends of four links; then agents 3 (two links) and 4 (one).
    assert (channel.ledger.messages == [1, 2, 2, 4, 2]).all()
    assert channel.ledger.rounds == 2


def test_an_event_that_was_lost_is_sent_again() -> None:
    graph = graphs.path(2)
    values = np.array([[0.0], [4.0]])
    faults = Faults(loss=1.0, during=[(0, 3)])
    for rounds, expected in ((3, values), (4, 2.0)):
        channel = Channel(graph, faults=faults)
        out = network.event_triggered(values, channel, rounds=rounds, threshold=1.0)
        assert (out == expected).all()
        assert (channel.ledger.lost == 3).all()
        assert (
            channel.ledger.messages == 2 * rounds
        ).all()  # an acknowledgement for each


@named
def test_flooding_tells_everybody_everything(graph: Graph) -> None:
    values = rng(1).standard_normal((graph.n_agents, 2))
    channel = Channel(graph)
    mean, known = network.flooding(values, channel)
    assert known.all() and np.abs(mean - values.mean(axis=0)).max() < 1e-14
    # Each agent says each thing once to each of its listeners.
    assert (channel.ledger.scalars == 3 * graph.n_agents * graph.out_degree).all()
    assert channel.ledger.rounds == graph.diameter + 1
    some, known = network.flooding(values, Channel(graph), rounds=1)
    near = graph.links.toarray().astype(bool) | np.eye(graph.n_agents, dtype=bool)
    assert (known == near).all()
    assert np.allclose(some, np.stack([values[row].mean(axis=0) for row in near]))


RULES = {
    "average": partial(network.average_consensus, rounds=3),
    "push-sum": partial(network.push_sum, rounds=3),
    "maximum": partial(network.max_consensus, rounds=2),
    "events": partial(network.event_triggered, rounds=4, threshold=0.5),
    "flooding": lambda values, channel: network.flooding(values, channel, rounds=2)[0],
    "finite time": network.finite_time_consensus,
}


@pytest.mark.parametrize("name", RULES)
def test_the_agents_order_and_units_do_not_matter(name: str) -> None:
    """Numbered otherwise, the same agents reach the same values and send as much."""
    values = rng(1).standard_normal((GRID.n_agents, 2))
    order = rng(2).permutation(GRID.n_agents)
    dense = GRID.links.toarray()[np.ix_(order, order)]
    channels = Channel(GRID), Channel(Graph.from_adjacency(dense))
    plain = RULES[name](values, channels[0])
    other = RULES[name](values[order], channels[1])
    assert np.abs(plain[order] - other).max() < 1e-9
    assert (channels[0].ledger.scalars[order] == channels[1].ledger.scalars).all()
    coarse = {"threshold": 0.5e5} if name == "events" else {}
    scaled = RULES[name](1e5 * values, Channel(GRID), **coarse)
    assert np.allclose(
        scaled, 1e5 * plain, rtol=1e-9 if name == "finite time" else 1e-12
    )
