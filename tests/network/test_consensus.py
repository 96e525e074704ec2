"""Averages, the maximum, and the minimiser of a sum: what is kept, how fast, and at what cost."""

from __future__ import annotations

import warnings
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt import network
from distfilt.linalg import SolverError
from distfilt.network import (
    Channel,
    Disconnected,
    Faults,
    Graph,
    UnstableGain,
    graphs,
    weights,
)
from distfilt.network.consensus import _distinct
from tests.network.helpers import (
    APART,
    DISK,
    STAR,
    lossy,
    named,
    random_graph,
    rng,
    star,
)


@given(st.integers(0, 1000), st.integers(2, 7), st.floats(0.01, 1.5))
def test_averaging_is_steps_against_the_laplacian(
    seed: int, agents: int, gain: float
) -> None:
    graph = random_graph(seed, agents)
    values = rng(seed).standard_normal((agents, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # too steep, or in parts
        after = network.average_consensus(values, Channel(graph), gain=gain, rounds=3)
    scale = max(1.0, np.abs(after).max())
    by_hand = values
    for _ in range(3):
        by_hand = by_hand - gain * graph.laplacian.toarray() @ by_hand
    assert np.abs(after - by_hand).max() < 1e-12 * scale


def test_a_gain_beyond_the_bound_warns_once_and_names_both() -> None:
    values = np.array([[0.0], [3.0], [-1.5]])
    with pytest.warns(
        UnstableGain, match=r"gain: 0\.7 is above 2/λ_max = 0\.666667"
    ) as caught:
        late = network.average_consensus(values, star(), gain=0.7, rounds=200)
    assert len(caught) == 1 and caught[0].filename == __file__
    assert (
        np.abs(late - values.mean()).max() > 100
    )  # the printed bound 0 < γ < 1 is wrong


@pytest.mark.parametrize(
    "graph", [graphs.path(5), graphs.disk(rng(2).random((250, 2)), 0.15)]
)
def test_the_warning_s_edge_and_what_it_costs(graph: Graph) -> None:
    """No eigenvalue is computed for a gain that degrees clear."""
    values = np.zeros((graph.n_agents, 1))
    network.average_consensus(
        values, Channel(graph), gain=0.99 * graph.degree_bound_gain
    )
    assert "max_stable_gain" not in vars(graph) and "spectrum" not in vars(graph)
    network.average_consensus(
        values, Channel(graph), gain=graph.max_stable_gain * (1 - 1e-6)
    )
    with pytest.warns(UnstableGain):
        network.average_consensus(
            values, Channel(graph), gain=graph.max_stable_gain * (1 + 1e-6)
        )


@pytest.mark.parametrize("lost", ["mutual", "metropolis"])
@given(st.integers(0, 500), st.floats(0, 1))
def test_mutual_rules_keep_the_average_under_loss(
    lost: str, seed: int, loss: float
) -> None:
    values = rng(seed).standard_normal((2, DISK.n_agents, 2))
    channel = Channel(DISK, runs=(2,), faults=Faults(loss=loss, seed=seed))
    after = network.average_consensus(values, channel, rounds=5, lost=lost)
    assert np.abs(after.mean(axis=-2) - values.mean(axis=-2)).max() < 1e-12
    assert loss > 0.5 or (np.ptp(after, axis=-2) < np.ptp(values, axis=-2)).all()


def test_averaging_a_graph_in_parts_warns() -> None:
    """Each part agrees for itself; one round says nothing, as graphs that change may need it."""
    graph = Graph.from_adjacency([[0, 1, 0], [1, 0, 0], [0, 0, 0]])
    values = np.array([[0.0], [2.0], [7.0]])
    with pytest.warns(Disconnected, match="has 2 parts") as caught:
        after = network.average_consensus(values, Channel(graph), rounds=60)
    assert np.allclose(after, [[1.0], [1.0], [7.0]])
    assert len(caught) == 1 and caught[0].filename == __file__
    network.average_consensus(values, Channel(graph))


@named
def test_finite_time_is_exact(graph: Graph) -> None:
    values = rng(4).standard_normal((2, graph.n_agents, 2))
    channel = Channel(graph, runs=(2,))
    after = network.finite_time_consensus(values, channel)
    assert np.abs(after - values.mean(axis=-2, keepdims=True)).max() < 1e-9
    assert (
        graph is DISK
        or np.abs(after - values.mean(axis=-2, keepdims=True)).max() < 1e-12
    )
    assert (
        channel.ledger.rounds == len(np.unique(graph.laplacian_spectrum.round(9))) - 1
    )


def test_finite_time_on_many_eigenvalues_needs_leja_s_order() -> None:
    """A row of forty: ascending and descending orders fail there."""
    graph = graphs.path(40)
    values = rng(4).standard_normal((40, 1))
    assert (
        np.abs(
            network.finite_time_consensus(values, Channel(graph)) - values.mean()
        ).max()
        < 1e-9
    )


def test_finite_time_needs_every_message() -> None:
    for channel, why in (
        (lossy(), "channel must have no faults"),
        (Channel(APART), "connected"),
    ):
        with pytest.raises(ValueError, match=why):
            network.finite_time_consensus(np.zeros((3, 1)), channel)


def test_eigenvalues_count_once_whatever_their_scale() -> None:
    for scale in (1.0, 1e3):
        values = scale * np.array([1.0, 1.0 + 1e-12, 2.0, 3.0, 3.0])
        assert np.allclose(_distinct(values), scale * np.array([1.0, 2.0, 3.0]))
    assert _distinct(np.array([1.0, 1.0 + 1e-6])).size == 2


@named
def test_push_sum_reaches_the_average_through_heavy_loss(graph: Graph) -> None:
    values = 2.16 + rng(2).standard_normal((graph.n_agents, 1))
    for loss in (0.0, 0.3):
        channel = lossy(loss, graph)
        after = network.push_sum(values, channel, rounds=900)
        assert np.abs(after - values.mean()).max() < 1e-10
        assert (channel.ledger.scalars == 2 * 900 * graph.out_degree).all()


def test_averages_on_a_digraph() -> None:
    graph = Graph.from_edges(4, [(1, 0), (2, 1), (3, 2), (0, 3), (2, 0)], directed=True)
    values = rng(2).standard_normal((5, 4, 2))
    balanced = partial(
        network.average_consensus, weights=weights.doubly_stochastic(graph)
    )
    for rule in (network.push_sum, balanced):
        after = rule(values, Channel(graph, runs=(5,)), rounds=400)
        assert np.abs(after - values.mean(axis=1, keepdims=True)).max() < 1e-12


@named
def test_maximum_needs_the_diameter(graph: Graph) -> None:
    values = rng(4).standard_normal((graph.n_agents, 2))
    channel = Channel(graph)
    assert (network.max_consensus(values, channel) == values.max(axis=0)).all()
    assert channel.ledger.rounds == graph.diameter
    through = network.max_consensus(
        values, lossy(0.5, graph), rounds=20 * graph.diameter
    )
    assert (through == values.max(axis=0)).all()


_OWN = np.array([[1.0, 4.0], [2.0, -1.0], [6.0, 0.0]])
_ZERO = np.zeros((3, 2))


def _quadratic(v: np.ndarray, rho: float) -> np.ndarray:
    return (_OWN + rho * v) / (1 + rho)


def _by_hand(rho: float, iterations: int) -> list[tuple[float, float]]:
    """Residuals of every iteration from the printed formulas, with a true average."""
    z = w = _ZERO
    out = []
    for _ in range(iterations):
        u = _quadratic(z - w, rho)
        new = _ZERO + (u + w).mean(axis=0)
        w = w + u - new
        out.append((float(np.abs(u - new).max()), float(rho * np.abs(new - z).max())))
        z = new
    return out


@pytest.mark.parametrize("rho", [0.05, 0.3, 1.0, 8.0])
def test_it_stops_as_soon_as_both_residuals_are_below_the_tolerance(rho: float) -> None:
    """Both residuals, the dual one with its ρ: each is the last to fall for some ρ.

    The decision is paid for: rounds of averaging, and of the maximum of two numbers, which take
    the diameter each.
    """
    series = _by_hand(rho, 600)
    channel = star()
    tolerance = 1e-4
    run = network.admm(_quadratic, _ZERO, channel, rho=rho, tolerance=tolerance)
    n = run.iterations
    assert n == next(
        k for k, pair in enumerate(series, start=1) if max(pair) < tolerance
    )
    assert np.allclose((run.primal, run.dual), series[n - 1], rtol=1e-6, atol=1e-12)
    assert np.abs(run.common - _OWN.mean(axis=0)).max() < 1e-3
    assert channel.ledger.rounds == 2 * n + 2 * n
    assert (channel.ledger.scalars == (2 * 2 * n + 2 * 2 * n) * STAR.out_degree).all()


def test_it_says_when_it_stops_short_and_needs_every_message() -> None:
    primal, dual = _by_hand(1.0, 2)[-1]
    with pytest.raises(
        SolverError, match=f"{primal:.3g} and {dual:.3g} after 2 iterations"
    ):
        network.admm(_quadratic, _ZERO, star(), iterations=2)
    with pytest.raises(ValueError, match="channel must have no faults"):
        network.admm(_quadratic, _ZERO, lossy(), average=network.average_consensus)
