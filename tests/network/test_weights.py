"""Weights: sums, symmetry, optimality, and what keeps the average."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.network import Graph, Weights, _links, graphs, weights
from tests.network.helpers import REFERENCE, STAR, random_graph, rng

named = pytest.mark.parametrize("graph", REFERENCE.values(), ids=REFERENCE.keys())


def _slowest(w: Weights) -> float:
    """The second largest modulus of the eigenvalues of symmetric weights."""
    return float(np.sort(np.abs(np.linalg.eigvalsh(w.matrix.toarray())))[-2])


@named
def test_metropolis_and_maximum_degree_are_doubly_stochastic(graph: Graph) -> None:
    d = graph.degrees
    pair = np.maximum(d[graph.receivers], d[graph.senders])
    assert (weights.metropolis(graph).links == 1 / (1 + pair)).all()
    for w in (weights.metropolis(graph), weights.gossip(graph)):
        dense = w.matrix.toarray()
        assert (dense >= 0).all() and (dense == dense.T).all()
        assert np.abs(dense.sum(axis=1) - 1).max() < 1e-12


@given(st.integers(0, 1000), st.integers(2, 8))
def test_balanced_weights_of_a_digraph(seed: int, agents: int) -> None:
    graph = random_graph(seed, agents, directed=True)
    if not graph.connected:
        with pytest.raises(ValueError, match="strongly connected"):
            weights.balanced(graph)
        return
    dense = weights.balanced(graph).matrix.toarray()
    for axis in (0, 1):
        assert np.abs(dense.sum(axis=axis) - 1).max() < 1e-12
    assert (dense >= -1e-12).all() and (dense[graph.receivers, graph.senders] > 0).all()
    assert np.isclose(dense.diagonal().min(), 0.5)
    # Proportional to the left null vector, from a dense decomposition.
    p = np.abs(np.linalg.svd(graph.laplacian.T.toarray())[2][-1])
    ratio = dense[graph.receivers, graph.senders] / p[graph.receivers]
    assert np.ptp(ratio) < 1e-9 * ratio.max()
    assert np.abs(weights.push(graph).matrix.toarray().sum(axis=0) - 1).max() < 1e-12


def test_balanced_weights_of_an_undirected_graph_are_the_laplacian_s() -> None:
    graph = REFERENCE["disk"]
    expected = weights._laplacian(graph, 0.5 / graph.degrees.max())
    assert np.allclose(weights.balanced(graph).links, expected.links, rtol=1e-14)
    alone = graphs.path(1)
    assert weights.balanced(alone).own == weights.metropolis(alone).own == weights.push(alone).own


def test_balanced_weights_of_links_across(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sparse factor of random links fills up, so that a walk finds the null vector."""
    n, ring = 2500, np.arange(2500)
    heard = [np.roll(ring, -1), *rng(4).integers(n, size=(2, n))]
    edges = np.concatenate([np.stack([ring, who], axis=1) for who in heard])
    graph = Graph.from_edges(n, edges[edges[:, 0] != edges[:, 1]], directed=True)
    walked = _links._walked(graph.laplacian)
    assert walked is not None and np.ptp(walked) > 0.5
    assert np.array_equal(_links.left_null_vector(graph.laplacian), walked)
    w = weights.balanced(graph).matrix
    for axis in (0, 1):
        assert np.abs(np.asarray(w.sum(axis=axis)) - 1).max() < 1e-12
    monkeypatch.setattr(_links, "_LARGE", n)
    factored = _links.left_null_vector(graph.laplacian)
    assert np.abs(walked / factored - 1).max() < 1e-11


def test_a_walk_along_a_ring_is_given_up() -> None:
    n, ring = 2500, np.arange(2500)
    both = np.stack([ring, np.roll(ring, -1)], axis=1)
    edges = np.concatenate([both, both[: n // 2, ::-1]])
    graph = Graph.from_edges(n, edges, directed=True)
    assert _links._walked(graph.laplacian) is None
    w = weights.balanced(graph).matrix
    assert np.abs(np.asarray(w.sum(axis=0)) - 1).max() < 1e-12


@named
def test_the_best_constant_is_no_worse_than_any(graph: Graph) -> None:
    best = weights.best_constant(graph)
    low, high = graph.spectrum[1], graph.spectrum[-1]
    assert np.isclose(_slowest(best), (high - low) / (high + low), atol=1e-9)
    for factor in (0.97, 1.03):
        other = weights._laplacian(graph, factor * best.links[0])
        assert _slowest(other) > _slowest(best) or low == high
    assert (weights.best_constant(graphs.path(1)).matrix.toarray() == 1).all()


@pytest.mark.parametrize("name", ["star", "grid", "disk", "ring"])
def test_the_fastest_weights_reach_the_convex_optimum(name: str) -> None:
    """Against the semidefinite program, solved by cvxpy."""
    cp = pytest.importorskip("cvxpy")
    graph = REFERENCE[name]
    w = weights.fastest(graph)
    dense = w.matrix.toarray()
    assert np.abs(dense - dense.T).max() == 0 and np.abs(dense.sum(axis=0) - 1).max() < 1e-12
    at = np.flatnonzero(graph.receivers < graph.senders)
    ends = np.zeros((graph.size, at.size))
    ends[graph.receivers[at], range(at.size)] = 1
    ends[graph.senders[at], range(at.size)] = -1
    x = cp.Variable(at.size)
    matrix = np.eye(graph.size) - ends @ cp.diag(x) @ ends.T - 1 / graph.size
    optimum = cp.Problem(cp.Minimize(cp.norm(matrix, 2))).solve()
    assert optimum - 1e-5 < _slowest(w) < optimum + 1e-3
    assert _slowest(w) <= _slowest(weights.best_constant(graph)) + 1e-12


@named
def test_gossip_weights_are_the_mean_of_all_meetings(graph: Graph) -> None:
    total = np.zeros((graph.size, graph.size))
    for i in range(graph.size):
        near = graph.neighbours(i)
        for j in near:
            meeting = np.eye(graph.size)
            meeting[np.ix_([i, j], [i, j])] = 0.5
            total += meeting / (graph.size * len(near))
    assert np.abs(weights.gossip(graph).matrix.toarray() - total).max() < 1e-14


def test_keeping_looks_at_columns_relative_to_what_cancels_in_them() -> None:
    """Rows that sum to one are not enough; a steep gain's rounding is no fault."""
    uneven = Weights(STAR, np.zeros(3), np.array([0.5, 0.5, 1.0, 1.0]))
    with pytest.raises(ValueError, match=r"columns that sum to 1.* got 2 for agent 0"):
        weights._keeping(uneven)
    slightly = Weights(STAR, np.full(3, 1 / 3), np.array([1, 1, 1, 1]) / 3)
    with pytest.raises(ValueError, match="columns"):
        weights._keeping(slightly)
    steep = weights._laplacian(REFERENCE["disk"], 1e7 / 3)
    assert weights._keeping(steep) is steep
    off = weights.metropolis(STAR)
    with pytest.raises(ValueError, match="columns"):
        weights._keeping(Weights(STAR, off.own + [0, 1e-8, 0], off.links))
