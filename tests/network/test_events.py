"""Event-triggered averaging: the average, the threshold, and which values are sent."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt import network
from distfilt.network import Channel, Faults, Graph, graphs, weights
from tests.network.helpers import GRID, each_graph, rng


@each_graph
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_the_average_is_kept_and_reached_as_the_threshold_falls(
    graph: Graph, loss: float
) -> None:
    values = 10 * rng(1).standard_normal((graph.n_agents, 2))
    channel = Channel(graph, faults=Faults(loss=loss, seed=4))
    averaged = network.event_triggered(
        values, channel, rounds=600, threshold=1.0, decay=0.98
    )
    # Both ends of a link use values that both know: updates cancel in the sum.
    error = averaged.mean(axis=0) - values.mean(axis=0)
    assert np.abs(error).max() < 1e-12
    # The threshold ends at 0.98^600 = 5e-6: agents agree to about that, not exactly.
    assert 1e-9 < np.ptp(averaged, axis=0).max() < 1e-3
    # Less than half of the messages of plain averaging.
    if loss == 0:
        assert channel.ledger.messages.sum() < 0.5 * 600 * graph.senders.size


def test_without_a_threshold_it_is_plain_averaging() -> None:
    values = rng(1).standard_normal((GRID.n_agents, 2))
    channel = Channel(GRID)
    averaged = network.event_triggered(values, channel, rounds=25, threshold=0.0)
    plain = Channel(GRID)
    # Every change exceeds a threshold of zero.
    expected = plain.mix(values, weights.metropolis(GRID), rounds=25)
    assert np.abs(averaged - expected).max() < 1e-13
    assert (channel.ledger.scalars == plain.ledger.scalars).all()


def test_only_changed_values_are_sent() -> None:
    """All equal but one: after the first round only it and its neighbour have changed."""
    values = [[0.0], [0.0], [0.0], [0.0], [9.0]]
    channel = Channel(graphs.path(5))
    network.event_triggered(values, channel, rounds=2, threshold=0.5)
    # All send once, both ends of four links; then agents 3 (two links) and 4 (one).
    assert (channel.ledger.messages == [1, 2, 2, 4, 2]).all()
    assert channel.ledger.rounds == 2


@pytest.mark.parametrize(
    ("rounds", "expected"), [(3, [[0.0], [4.0]]), (4, [[2.0], [2.0]])]
)
def test_a_lost_value_is_sent_again(rounds: int, expected: list[list[float]]) -> None:
    """All messages of the first three rounds are lost; the fourth is enough for two agents."""
    faults = Faults(loss=1.0, during=[(0, 3)])
    channel = Channel(graphs.path(2), faults=faults)
    averaged = network.event_triggered(
        [[0.0], [4.0]], channel, rounds=rounds, threshold=1.0
    )
    assert (averaged == expected).all()
    assert (channel.ledger.lost == 3).all()
    # An acknowledgement for each message.
    assert (channel.ledger.messages == 2 * rounds).all()
