"""Weights: sums, symmetry, optimality, and what keeps the average."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.network import ConsensusWeights, Graph, graphs, weights
from tests.network.helpers import DISK, STAR, named, random_graph


def _slowest(w: ConsensusWeights) -> float:
    """The second largest modulus of the eigenvalues of symmetric weights."""
    return float(np.sort(np.abs(np.linalg.eigvalsh(w.matrix.toarray())))[-2])


@named
def test_metropolis_and_gossip_weights_by_their_definition(graph: Graph) -> None:
    """The latter are the mean of all meetings; both are symmetric with unit sums."""
    d = graph.in_degree
    size = graph.n_agents
    pair = np.maximum(d[graph.receivers], d[graph.senders])
    assert (weights.metropolis(graph).links == 1 / (1 + pair)).all()
    meetings = np.zeros((size, size))
    for i in range(size):
        for j in graph.neighbours(i):
            meeting = np.eye(size)
            meeting[np.ix_([i, j], [i, j])] = 0.5
            meetings += meeting / (size * d[i])
    assert (
        np.abs(weights.expected_gossip(graph).matrix.toarray() - meetings).max() < 1e-14
    )
    for w in (weights.metropolis(graph), weights.expected_gossip(graph)):
        dense = w.matrix.toarray()
        assert (dense >= 0).all() and (dense == dense.T).all()
        assert np.abs(dense.sum(axis=1) - 1).max() < 1e-12


@given(st.integers(0, 1000), st.integers(2, 8))
def test_balanced_weights_of_a_digraph(seed: int, agents: int) -> None:
    graph = random_graph(seed, agents, directed=True)
    assert (
        np.abs(weights.column_stochastic(graph).matrix.toarray().sum(axis=0) - 1).max()
        < 1e-12
    )
    if not graph.connected:
        with pytest.raises(ValueError, match="strongly"):
            weights.doubly_stochastic(graph)
        return
    dense = weights.doubly_stochastic(graph).matrix.toarray()
    for axis in (0, 1):
        assert np.abs(dense.sum(axis=axis) - 1).max() < 1e-12
    assert (dense >= -1e-12).all() and (dense[graph.receivers, graph.senders] > 0).all()
    assert np.isclose(dense.diagonal().min(), 0.5)
    # Proportional to the left null vector, from a dense decomposition.
    p = np.abs(np.linalg.svd(graph.laplacian.T.toarray())[2][-1])
    ratio = dense[graph.receivers, graph.senders] / p[graph.receivers]
    assert np.ptp(ratio) < 1e-9 * ratio.max()


def test_balanced_weights_of_other_graphs() -> None:
    """Undirected ones have the Laplacian's, one agent 1, and long rings lose no digits."""
    expected = weights._laplacian(DISK, 0.5 / DISK.in_degree.max())
    assert np.allclose(
        weights.doubly_stochastic(DISK).links, expected.links, rtol=1e-14
    )
    alone = graphs.path(1)
    assert (
        weights.doubly_stochastic(alone).own
        == weights.metropolis(alone).own
        == weights.column_stochastic(alone).own
    )
    both = np.stack([np.arange(2500), np.roll(np.arange(2500), -1)], axis=1)
    edges = np.concatenate([both, both[:1250, ::-1]])
    w = weights.doubly_stochastic(Graph.from_edges(2500, edges, directed=True)).matrix
    assert np.abs(np.asarray(w.sum(axis=0)) - 1).max() < 1e-12


@named
def test_the_best_constant_is_no_worse_than_any(graph: Graph) -> None:
    best = weights.best_constant_edge(graph)
    low = graph.laplacian_spectrum[1]
    high = graph.laplacian_spectrum[-1]
    assert np.isclose(_slowest(best), (high - low) / (high + low), atol=1e-9)
    assert (weights.best_constant_edge(graphs.path(1)).matrix.toarray() == 1).all()


@named
def test_the_fastest_weights_reach_the_convex_optimum(graph: Graph) -> None:
    """Against the semidefinite program, solved by cvxpy."""
    cp = pytest.importorskip("cvxpy")
    w = weights.fastest_mixing(graph)
    dense = w.matrix.toarray()
    assert (
        np.abs(dense - dense.T).max() == 0
        and np.abs(dense.sum(axis=0) - 1).max() < 1e-12
    )
    at = np.flatnonzero(graph.receivers < graph.senders)
    ends = np.zeros((graph.n_agents, at.size))
    ends[graph.receivers[at], range(at.size)] = 1
    ends[graph.senders[at], range(at.size)] = -1
    x = cp.Variable(at.size)
    matrix = np.eye(graph.n_agents) - ends @ cp.diag(x) @ ends.T - 1 / graph.n_agents
    optimum = cp.Problem(cp.Minimize(cp.norm(matrix, 2))).solve()
    assert optimum - 1e-5 < _slowest(w) < optimum + 1e-3
    assert _slowest(w) <= _slowest(weights.best_constant_edge(graph)) + 1e-12


def test_keeping_looks_at_columns_relative_to_what_cancels_in_them() -> None:
    """Rows that sum to one are not enough; a steep gain's rounding is no fault."""
    off = weights.metropolis(STAR)
    bad = {
        r" 1.* got 2 for agent 0": ConsensusWeights(
            STAR, np.zeros(3), np.array([0.5, 0.5, 1.0, 1.0])
        ),
        " 1.* got 0.666667": ConsensusWeights(
            STAR, np.full(3, 1 / 3), np.array([1, 1, 1, 1]) / 3
        ),
        " 1": ConsensusWeights(STAR, off.own + [0, 1e-8, 0], off.links),
    }
    for text, w in bad.items():
        with pytest.raises(ValueError, match=f"columns that sum to{text}"):
            weights._keeping(w)
    steep = weights._laplacian(DISK, 1e7 / 3)
    assert weights._keeping(steep) is steep
