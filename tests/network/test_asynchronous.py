"""Gossip, sending on events, and flooding: what is kept, how fast, and what it costs."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.network import Channel, Faults, Graph, graphs, weights
from distfilt.network.asynchronous import event_triggered, flood, gossip
from tests.network.helpers import NAN, ONE_WAY, REFERENCE, STAR, lossy, rng, star

named = pytest.mark.parametrize("graph", REFERENCE.values(), ids=REFERENCE.keys())
_A = "distfilt.network.asynchronous."
_ZERO = np.zeros((3, 1))


def _late() -> Channel:
    return star(faults=Faults(delay=1))


def _event(values: object = _ZERO, channel: object = None, **change: object) -> np.ndarray:
    options: dict[str, object] = {"rounds": 2, "threshold": 0.1} | change
    return event_triggered(values, channel or star(), **options)


BAD_INPUT = {
    _A + "gossip": [
        ("values", lambda: gossip(np.zeros(3), star(), rounds=1, rng=rng())),
        ("values", lambda: gossip(NAN * _ZERO, star(), rounds=1, rng=rng())),
        ("channel", lambda: gossip(_ZERO, STAR, rounds=1, rng=rng())),
        ("channel", lambda: gossip(_ZERO, Channel(ONE_WAY), rounds=1, rng=rng())),
        ("channel", lambda: gossip(_ZERO, _late(), rounds=1, rng=rng())),
        ("rounds", lambda: gossip(_ZERO, star(), rounds=0, rng=rng())),
        ("rng", lambda: gossip(_ZERO, star(), rounds=1, rng=3)),
    ],
    _A + "event_triggered": [
        ("values", lambda: _event(np.zeros(3))),
        ("channel", lambda: _event(channel=STAR)),
        ("channel", lambda: _event(np.zeros((2, 3, 1)), star(runs=(2,)))),
        ("channel", lambda: _event(channel=Channel(ONE_WAY))),
        ("channel", lambda: _event(channel=_late())),
        ("rounds", lambda: _event(rounds=0)),
        ("threshold", lambda: _event(threshold=-1.0)),
        ("decay", lambda: _event(decay=0.0)),
        ("decay", lambda: _event(decay=1.1)),
        ("weights", lambda: _event(weights=np.eye(3))),
        ("weights", lambda: _event(
            channel=Channel(graphs.ring(3)),
            weights=weights.Weights.from_matrix(graphs.ring(3), [
                [0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]]))),
    ],
    _A + "flood": [
        ("values", lambda: flood(np.zeros(3), star())),
        ("channel", lambda: flood(_ZERO, None)),
        ("channel", lambda: flood(np.zeros((2, 3, 1)), star(runs=(2,)))),
        ("channel", lambda: flood(_ZERO, _late())),
        ("rounds", lambda: flood(_ZERO, star(), rounds=0)),
    ],
}


@named
def test_gossip_keeps_the_average_and_two_change_at_a_time(graph: Graph) -> None:
    values = rng(1).standard_normal((graph.size, 2))
    before = values.copy()
    draw = rng(3)
    for _ in range(30):
        channel = Channel(graph)
        new = gossip(values, channel, rounds=1, rng=draw)
        moved = np.flatnonzero((new != values).any(axis=1))
        assert moved.size == 2 and moved[1] in graph.neighbours(int(moved[0]))
        assert (new[moved] == values[moved].mean(axis=0)).all()
        assert (channel.ledger.messages[moved] == 1).all() and channel.ledger.messages.sum() == 2
        assert channel.ledger.scalars.sum() == 4 and channel.ledger.rounds == 1
    assert (values == before).all()
    whole = gossip(values, Channel(graph), rounds=4000, rng=rng(5))
    assert np.abs(whole - values.mean(axis=0)).max() < 1e-6
    assert np.abs(whole.mean(axis=0) - values.mean(axis=0)).max() < 1e-13


@pytest.mark.parametrize("name", ["ring", "star", "complete"])
def test_gossip_contracts_as_its_mean_matrix(name: str) -> None:
    """For a matrix W of one meeting W'W = W: the mean square after a round is a quadratic form."""
    graph = REFERENCE[name]
    mean = weights.gossip(graph).matrix.toarray()
    values, vectors = np.linalg.eigh(mean)
    for k in (0, -2):
        start = vectors[:, k, None]
        draw = rng(2)
        squares = np.array([
            (gossip(start, Channel(graph), rounds=1, rng=draw) ** 2).sum() for _ in range(1500)
        ])
        error = squares.std() / np.sqrt(squares.size)
        assert abs(squares.mean() - values[k]) < 3.5 * error + 1e-12


def test_meetings_are_drawn_evenly() -> None:
    """Each agent wakes with probability 1 / A and chooses its neighbours alike, at 99.9%."""
    from scipy.stats import chisquare

    graph, meetings = graphs.path(4), 2000
    values, counts = np.arange(4.0)[:, None] ** 2, np.zeros(3)
    draw = rng(8)
    for _ in range(meetings):
        moved = gossip(values, Channel(graph), rounds=1, rng=draw) != values
        counts[np.flatnonzero(moved)[0]] += 1
    expected = meetings * np.array([1 + 0.5, 0.5 + 0.5, 0.5 + 1]) / 4
    assert chisquare(counts, expected).pvalue > 1e-3


def test_gossip_through_losses_keeps_the_average() -> None:
    graph = REFERENCE["grid"]
    values = rng(1).standard_normal((6, graph.size, 1))
    channel = Channel(graph, runs=(6,), faults=Faults(loss=0.4, seed=2))
    out = gossip(values, channel, rounds=1500, rng=rng(3))
    assert np.abs(out.mean(axis=1) - values.mean(axis=1)).max() < 1e-13
    assert np.ptp(out, axis=1).max() < 1e-3
    assert (np.ptp(out[:, :, 0], axis=1) > 0).all() and channel.ledger.messages.sum() == 4 * 1500
    assert (gossip(values, Channel(graph, runs=(6,), faults=Faults(loss=1.0)), rounds=50,
                   rng=rng(3)) == values).all()


def test_gossip_with_a_lone_agent() -> None:
    graph = Graph.from_adjacency([[0, 1, 0], [1, 0, 0], [0, 0, 0]])
    channel = Channel(graph)
    out = gossip([[0.0], [2.0], [7.0]], channel, rounds=30, rng=rng(1))
    assert (out.ravel() == [1.0, 1.0, 7.0]).all() and channel.ledger.messages[2] == 0


@named
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_events_keep_the_average_and_their_bound(graph: Graph, loss: float) -> None:
    values = 10 * rng(1).standard_normal((graph.size, 2))
    before = values.copy()
    channel = Channel(graph, faults=Faults(loss=loss, seed=4))
    limit = 0.05
    out = event_triggered(values, channel, rounds=600, threshold=limit)
    assert np.abs(out.mean(axis=0) - values.mean(axis=0)).max() < 1e-12
    assert (values == before).all()
    if loss == 0:
        dense = weights.metropolis(graph).matrix.toarray()
        slow = np.sort(np.abs(np.linalg.eigvalsh(dense)))[-2]
        gain = np.linalg.norm(np.eye(graph.size) - dense, 2) / (1 - slow)
        bound = np.sqrt(out.size) * gain * limit
        assert np.linalg.norm(out - values.mean(axis=0)) <= bound + 1e-9
        assert channel.ledger.messages.sum() < 0.5 * 600 * graph.senders.size


def test_without_a_threshold_events_are_plain_averaging() -> None:
    graph = REFERENCE["grid"]
    values = rng(1).standard_normal((graph.size, 2))
    channel, plain = Channel(graph), Channel(graph)
    out = event_triggered(values, channel, rounds=25, threshold=0.0)
    exact = plain.combine(values, weights.metropolis(graph), rounds=25)
    assert np.abs(out - exact).max() < 1e-13
    assert (channel.ledger.scalars == plain.ledger.scalars).all()
    chosen = weights.best_constant(graph)
    out = event_triggered(values, Channel(graph), rounds=25, threshold=0.0, weights=chosen)
    assert np.abs(out - Channel(graph).combine(values, chosen, rounds=25)).max() < 1e-12


def test_a_shrinking_threshold_leads_to_agreement() -> None:
    graph = REFERENCE["grid"]
    values = rng(1).standard_normal((graph.size, 1))
    fixed, shrinking = (
        event_triggered(values, Channel(graph), rounds=300, threshold=0.3, decay=d)
        for d in (1.0, 0.93)
    )
    gaps = [np.abs(v - values.mean()).max() for v in (shrinking, fixed)]
    assert gaps[0] < 1e-6 < 1e-3 < gaps[1]


def test_only_what_moved_is_sent() -> None:
    """All equal but one: after the first round only it and its neighbours have news."""
    graph, values = graphs.path(5), np.array([[0.0], [0.0], [0.0], [0.0], [9.0]])
    channel = Channel(graph)
    event_triggered(values, channel, rounds=2, threshold=0.5)
    # All send once, both ends of four links; then agents 3 (two links) and 4 (one).
    assert (channel.ledger.messages == [1, 2, 2, 4, 2]).all()
    assert channel.ledger.rounds == 2


def test_an_event_that_was_lost_is_sent_again() -> None:
    graph, values = graphs.path(2), np.array([[0.0], [4.0]])
    faults = Faults(loss=1.0, during=[(0, 3)])
    channel = Channel(graph, faults=faults)
    assert (event_triggered(values, channel, rounds=3, threshold=1.0) == values).all()
    again = Channel(graph, faults=faults)
    assert (event_triggered(values, again, rounds=4, threshold=1.0) == 2.0).all()
    assert (again.ledger.lost == 3).all()
    assert (again.ledger.messages == 2 * 4).all()  # an acknowledgement for each


@named
def test_flooding_tells_everybody_everything(graph: Graph) -> None:
    values = rng(1).standard_normal((graph.size, 2))
    channel = Channel(graph)
    mean, known = flood(values, channel)
    assert known.all() and np.abs(mean - values.mean(axis=0)).max() < 1e-14
    # Each agent says each thing once to each of its listeners.
    assert (channel.ledger.scalars == 3 * graph.size * graph.listeners).all()
    assert channel.ledger.rounds == graph.diameter + 1
    some, known = flood(values, Channel(graph), rounds=1)
    near = graph.links.toarray().astype(bool) | np.eye(graph.size, dtype=bool)
    assert (known == near).all()
    assert np.allclose(some, np.stack([values[row].mean(axis=0) for row in near]))


def test_flooding_loses_what_is_lost() -> None:
    _, known = flood(np.zeros((3, 1)), lossy(1.0))
    assert (known == np.eye(3, dtype=bool)).all()


@given(st.integers(0, 100))
def test_one_seed_one_result(seed: int) -> None:
    values = rng(seed).standard_normal((7, 1))
    a, b = (gossip(values, Channel(REFERENCE["ring"]), rounds=9, rng=rng(seed)) for _ in range(2))
    assert (a == b).all()
