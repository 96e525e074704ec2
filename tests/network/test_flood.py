"""Flooding: which values agents know after how many rounds, and the cost."""

from __future__ import annotations

import numpy as np

from distfilt import network
from distfilt.network import Channel, Graph
from tests.network.helpers import each_graph, rng


@each_graph
def test_all_agents_know_all_values_in_the_end(graph: Graph) -> None:
    values = rng(1).standard_normal((graph.n_agents, 2))
    channel = Channel(graph)
    average, known = network.flooding(values, channel)
    assert known.all()
    assert np.abs(average - values.mean(axis=0)).max() < 1e-14
    # Each agent sends each value once on each of its links, with the number of its
    # agent.
    sent = 3 * graph.n_agents * graph.out_degree
    assert (channel.ledger.scalars == sent).all()
    # The values that arrive last are still forwarded, in one round more.
    assert channel.ledger.rounds == graph.diameter + 1


@each_graph
def test_one_round_reaches_the_neighbours(graph: Graph) -> None:
    values = rng(1).standard_normal((graph.n_agents, 2))
    average, known = network.flooding(values, Channel(graph), rounds=1)
    # Each agent knows its own value and those of its neighbours.
    linked = graph.links.toarray().astype(bool)
    expected = linked | np.eye(graph.n_agents, dtype=bool)
    assert (known == expected).all()
    means = [values[row].mean(axis=0) for row in expected]
    assert np.allclose(average, means)
