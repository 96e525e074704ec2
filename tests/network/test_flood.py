"""Flooding: which values agents know after how many rounds, and the cost."""

from __future__ import annotations

import numpy as np

from distfilt import network
from distfilt.network import Channel, Graph, graphs
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


@each_graph
def test_split_horizon_sends_less_and_nothing_else_changes(graph: Graph) -> None:
    values = rng(1).standard_normal((graph.n_agents, 2))
    echo = Channel(graph)
    channel = Channel(graph)
    expected, _ = network.flooding(values, echo)
    average, known = network.flooding(values, channel, split_horizon=True)
    assert known.all()
    assert (average == expected).all()
    # Every reception is one message less, as its receiver need not send it back: each
    # value but the own one has come over one link or more.
    saved = (echo.ledger.scalars - channel.ledger.scalars) / 3
    assert (saved >= graph.n_agents - 1).all()
    # By broadcast a value is sent at most once.
    assert (echo.ledger.broadcast_scalars == 3 * graph.n_agents).all()
    assert (channel.ledger.broadcast_scalars <= 3 * graph.n_agents).all()


def test_on_a_tree_a_value_crosses_each_link_once() -> None:
    channel = Channel(graphs.star(7))
    network.flooding(np.zeros((7, 1)), channel, split_horizon=True)
    assert channel.ledger.scalars.sum() == 2 * 7 * 6


def test_split_horizon_with_links_that_go_one_way() -> None:
    circle = Graph.from_edges(
        4, [(k, k - 1) for k in range(1, 4)] + [(0, 3)], directed=True
    )
    channel = Channel(circle)
    _, known = network.flooding(np.zeros((4, 1)), channel, split_horizon=True)
    assert known.all()
    assert (channel.ledger.scalars == 2 * 4).all()
