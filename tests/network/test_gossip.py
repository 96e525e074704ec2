"""Gossip: pairs average their values, are drawn evenly, and keep the average through losses."""

from __future__ import annotations

import numpy as np
from scipy.stats import chisquare

from distfilt import network
from distfilt.network import Channel, Faults, Graph, graphs
from tests.network.helpers import GRID, each_graph, rng


@each_graph
def test_two_agents_change_in_each_round(graph: Graph) -> None:
    """They are neighbours, end at the same mean, and send one message each."""
    values = rng(1).standard_normal((graph.n_agents, 2))
    draw = rng(3)
    for _ in range(30):
        channel = Channel(graph)
        averaged = network.gossip_consensus(values, channel, rounds=1, rng=draw)
        # All other agents keep their values to the bit.
        pair = np.flatnonzero((averaged != values).any(axis=1))
        assert pair.size == 2
        assert pair[1] in graph.neighbours(int(pair[0]))
        assert (averaged[pair] == values[pair].mean(axis=0)).all()
        ledger = channel.ledger
        assert ledger.rounds == 1
        assert (ledger.messages[pair] == 1).all()
        assert ledger.messages.sum() == 2
        assert ledger.scalars.sum() == 4


@each_graph
def test_gossip_converges_to_the_average(graph: Graph) -> None:
    """Each pair keeps its sum, so that the average does not change."""
    values = rng(1).standard_normal((graph.n_agents, 2))
    channel = Channel(graph)
    averaged = network.gossip_consensus(values, channel, rounds=4000, rng=rng(5))
    mean = values.mean(axis=0)
    assert np.abs(averaged - mean).max() < 1e-6
    # (x_i + x_j) / 2 twice has the sum x_i + x_j: exact but for rounding.
    assert np.abs(averaged.mean(axis=0) - mean).max() < 1e-13


def test_pairs_are_drawn_evenly() -> None:
    """Each agent wakes with probability 1 / A and chooses its neighbours alike, at 99.9%."""
    graph = graphs.path(4)
    rounds = 2000
    values = np.arange(4.0)[:, None] ** 2
    counts = np.zeros(3)
    draw = rng(8)
    for _ in range(rounds):
        channel = Channel(graph)
        # Values are all different, so that the lower end of the pair names the link.
        averaged = network.gossip_consensus(values, channel, rounds=1, rng=draw)
        counts[np.flatnonzero(averaged != values)[0]] += 1
    # An end has one neighbour, which it always chooses; an inner agent has two.
    probabilities = np.array([1 + 0.5, 0.5 + 0.5, 0.5 + 1]) / 4
    expected = rounds * probabilities
    assert chisquare(counts, expected).pvalue > 1e-3


def test_gossip_through_losses_keeps_the_average() -> None:
    values = rng(1).standard_normal((6, GRID.n_agents, 1))
    channel = Channel(GRID, runs=(6,), faults=Faults(loss=0.4, seed=2))
    averaged = network.gossip_consensus(values, channel, rounds=1500, rng=rng(3))
    # A pair changes only if both messages arrive: no half of an exchange is applied.
    error = averaged.mean(axis=1) - values.mean(axis=1)
    assert np.abs(error).max() < 1e-13
    width = np.ptp(averaged, axis=1)
    assert (width > 0).all()
    assert width.max() < 1e-3
    # Two messages and their acknowledgements in each round.
    assert channel.ledger.messages.sum() == 4 * 1500


def test_gossip_without_any_message_changes_nothing() -> None:
    values = rng(1).standard_normal((GRID.n_agents, 1))
    channel = Channel(GRID, faults=Faults(loss=1.0))
    averaged = network.gossip_consensus(values, channel, rounds=50, rng=rng(3))
    assert (averaged == values).all()
