"""Graphs, the channel with its ledger, and averaging."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from distfilt.network import Channel, Graph, Ledger
from distfilt.network.consensus import average, mean_pull

STAR = [[0, 1, 1], [1, 0, 0], [1, 0, 0]]
NAN = float("nan")


def _channel(adjacency: object = STAR, **options: object) -> Channel:
    return Channel(Graph.from_adjacency(adjacency), **options)


def _graph(seed: int, agents: int, *, directed: bool = False) -> Graph:
    a = np.random.default_rng(seed).random((agents, agents)) < 0.5
    a = np.triu(a, 1) | (np.tril(a, -1) if directed else np.triu(a, 1).T)
    return Graph.from_adjacency(a.astype(float), directed=directed)


_G = "distfilt.network.graphs."
_H = "distfilt.network.channel."
_N = "distfilt.network.consensus."
BAD_INPUT = {
    _G + "Graph": [
        ("adjacency", lambda: Graph.from_adjacency([[0, 1]])),
        ("adjacency", lambda: Graph.from_adjacency(np.zeros((0, 0)))),
        ("adjacency", lambda: Graph.from_adjacency([[0, 2], [2, 0]])),
        ("adjacency", lambda: Graph.from_adjacency([[1, 1], [1, 0]])),
        ("adjacency", lambda: Graph.from_adjacency([[0, 1], [0, 0]])),
        ("adjacency", lambda: Graph.from_adjacency([[0, NAN], [NAN, 0]])),
        ("agent", lambda: Graph.from_adjacency(STAR).neighbours(3)),
        ("graph", lambda: Graph.from_adjacency([[0, 1], [0, 0]], directed=True).spectrum),
    ],
    _H + "Ledger": [("agents", lambda: Ledger.empty(0))],
    _H + "Channel": [
        ("graph", lambda: Channel(STAR)),
        ("ledger", lambda: _channel(ledger=Ledger.empty(2))),
        ("runs", lambda: _channel(runs=(0,))),
        ("payloads", lambda: _channel().exchange([np.zeros(1)])),
        ("payloads", lambda: _channel(runs=(4,)).exchange([np.zeros(3)] * 3)),
        ("values", lambda: _channel().combine(np.zeros((2, 1)), np.eye(3))),
        ("values", lambda: _channel().combine(np.full((3, 1), NAN), np.eye(3))),
        ("weights", lambda: _channel().combine(np.zeros((3, 1)), np.eye(2))),
        ("weights", lambda: _channel().combine(np.zeros((3, 1)), np.full((3, 3), 1 / 3))),
        ("weights", lambda: _channel().combine(np.zeros((3, 1)), NAN * np.eye(3))),
    ],
    _N + "average": [
        ("values", lambda: average(np.zeros((2, 1)), _channel(), gain=0.1)),
        ("gain", lambda: average(np.zeros((3, 1)), _channel(), gain=0.0)),
        ("rounds", lambda: average(np.zeros((3, 1)), _channel(), gain=0.1, rounds=0)),
    ],
    _N + "mean_pull": [
        ("ensembles", lambda: mean_pull(np.zeros((3, 1)), _channel(), gain=0.1)),
        ("gain", lambda: mean_pull(np.zeros((3, 4, 1)), _channel(), gain=-0.1)),
        ("rounds", lambda: mean_pull(np.zeros((3, 4, 1)), _channel(), gain=0.1, rounds=0)),
    ],
}


def test_spectra_of_the_satellite_networks() -> None:
    five = np.zeros((5, 5))
    five[0, 1:] = five[1:, 0] = 1
    assert np.allclose(Graph.from_adjacency(STAR).spectrum, [0, 1, 3], atol=1e-12)
    assert np.allclose(Graph.from_adjacency(five).spectrum, [0, 1, 1, 1, 5], atol=1e-12)
    assert np.isclose(Graph.from_adjacency(five).largest_gain, 2 / 5)


@given(st.integers(0, 1000), st.integers(1, 8))
def test_laplacian_rows_sum_to_zero_and_networkx_agrees(seed: int, agents: int) -> None:
    import networkx as nx

    graph = _graph(seed, agents, directed=True)
    assert (graph.laplacian.sum(axis=1) == 0).all()
    theirs = graph.to_networkx()
    assert [set(theirs.predecessors(i)) for i in range(agents)] == [
        set(graph.neighbours(i)) for i in range(agents)
    ]
    assert graph.connected == nx.is_strongly_connected(theirs)


def test_messages_follow_the_links_and_cannot_be_changed() -> None:
    channel = _channel()
    own = [np.array([float(i)]) for i in range(3)]
    inbox = channel.exchange(own)
    assert [list(box) for box in inbox] == [[1, 2], [0], [0]]
    with pytest.raises(ValueError, match="read-only"):
        inbox[1][0][0] = 9.0
    assert own[0][0] == 0.0


def test_silence_costs_nothing_and_a_round_is_counted() -> None:
    channel = _channel()
    inbox = channel.exchange([None, (np.zeros(2), np.zeros((2, 2))), None])
    assert inbox[0].keys() == {1} and not inbox[1] and not inbox[2]
    assert (channel.ledger.messages == [0, 1, 0]).all()
    assert (channel.ledger.scalars == [0, 6, 0]).all()
    assert (channel.ledger.bytes == [0, 48, 0]).all()
    assert channel.ledger.rounds == 1


def test_runs_are_not_charged_twice() -> None:
    one, many = _channel(), _channel(runs=(4, 5))
    one.exchange([np.zeros(3)] * 3)
    many.exchange([np.zeros((4, 5, 3))] * 3)
    for name in ("messages", "scalars", "bytes"):
        assert (getattr(one.ledger, name) == getattr(many.ledger, name)).all()


def test_a_ledger_is_replaced_never_changed() -> None:
    before = Ledger.empty(3)
    channel = _channel(ledger=before)
    channel.exchange([np.zeros(1)] * 3)
    assert before.rounds == 0 and (before.messages == 0).all()


@given(st.integers(0, 1000), st.integers(1, 7), st.integers(1, 3))
def test_combine_is_the_matrix_product(seed: int, agents: int, k: int) -> None:
    rng = np.random.default_rng(seed)
    graph = _graph(seed, agents, directed=True)
    weights = rng.standard_normal((agents, agents)) * (graph.links.toarray() + np.eye(agents))
    values = rng.standard_normal((2, agents, k))
    dense = Channel(graph, runs=(2,)).combine(values, weights)
    assert np.allclose(dense, weights @ values, rtol=1e-12, atol=1e-12)
    assert (Channel(graph, runs=(2,)).combine(values, sparse.csr_array(weights)) == dense).all()


def test_combine_charges_the_links_it_uses() -> None:
    channel = _channel()
    channel.combine(np.zeros((3, 4)), np.array([[1, 0.5, 0], [0, 1, 0], [0.5, 0, 1]]))
    assert (channel.ledger.messages == [1, 1, 0]).all()
    assert (channel.ledger.scalars == [4, 4, 0]).all()


@given(st.integers(0, 1000), st.integers(2, 7), st.floats(0.01, 1.5))
def test_averaging_keeps_the_average(seed: int, agents: int, gain: float) -> None:
    graph = _graph(seed, agents)
    values = np.random.default_rng(seed).standard_normal((agents, 2))
    after = average(values, Channel(graph), gain=gain, rounds=3)
    scale = max(1.0, np.abs(after).max())
    assert np.abs(after.mean(axis=0) - values.mean(axis=0)).max() < 1e-12 * scale


@pytest.mark.parametrize(("gain", "agrees"), [(0.30, True), (0.65, True), (0.70, False)])
def test_averaging_agrees_up_to_its_bound(gain: float, agrees: bool) -> None:
    """The printed bound 0 < γ < 1 is wrong: on the star of three the edge is 2/3."""
    values = np.array([[0.0], [3.0], [-1.5]])
    late = [average(values, _channel(), gain=gain, rounds=r) for r in (200, 201)]
    gaps = [np.abs(v - values.mean()).max() for v in late]
    assert (gaps[1] < gaps[0]) == agrees or gaps[0] < 1e-12


def test_mean_pull_moves_means_by_averaging() -> None:
    e = np.random.default_rng(1).standard_normal((3, 20, 2))
    means = average(e.mean(axis=1), _channel(), gain=0.1, rounds=4)
    for include in (True, False):
        pulled = mean_pull(e, _channel(), gain=0.1, rounds=4, include_self=include)
        assert np.allclose(pulled.mean(axis=1), means, atol=1e-13)


@pytest.mark.parametrize("include", [True, False])
def test_mean_pull_shrinks_the_spread(include: bool) -> None:
    """The exact defect of (16): anomalies are multiplied by 1 - γ|Nbs| in every round."""
    e = np.random.default_rng(1).standard_normal((3, 20, 2))
    pulled = mean_pull(e, _channel(), gain=0.05, include_self=include)
    shrink = 1 - 0.05 * (np.array([2, 1, 1]) + include)
    before, after = (v - v.mean(axis=1, keepdims=True) for v in (e, pulled))
    assert np.allclose(after, shrink[:, None, None] * before, atol=1e-13)


def test_mean_pull_sends_means_only_and_nothing_without_gain() -> None:
    channel = _channel()
    e = np.random.default_rng(1).standard_normal((3, 20, 2))
    assert (mean_pull(e, channel, gain=0.0) == e).all() and channel.ledger.rounds == 0
    mean_pull(e, channel, gain=0.1, rounds=2)
    assert (channel.ledger.scalars == 2 * 2 * np.array([2, 1, 1])).all()
