"""Consensus weights: sums, symmetry, optimality, and the check that they keep the average."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.network import ConsensusWeights, Graph, graphs, weights
from tests.network.helpers import DISK, STAR, each_graph, random_graph


def _second_modulus(w: ConsensusWeights) -> float:
    """Return the second largest modulus of the eigenvalues of symmetric weights."""
    moduli = np.abs(np.linalg.eigvalsh(w.matrix.toarray()))
    return float(np.sort(moduli)[-2])


@each_graph
def test_metropolis_weights_by_their_definition(graph: Graph) -> None:
    degree = graph.in_degree
    # w_ij = 1 / (1 + max(d_i, d_j))
    larger = np.maximum(degree[graph.receivers], degree[graph.senders])
    w = weights.metropolis(graph)
    assert (w.link_weights == 1 / (1 + larger)).all()
    _check_symmetric_and_stochastic(w)


@each_graph
def test_gossip_weights_are_the_mean_over_all_pairs(graph: Graph) -> None:
    n_agents = graph.n_agents
    mean = np.zeros((n_agents, n_agents))
    for i in range(n_agents):
        for j in graph.neighbours(i):
            # The matrix of one exchange: both ends take their mean.
            pair = np.eye(n_agents)
            pair[np.ix_([i, j], [i, j])] = 0.5
            # Agent i wakes with probability 1/A and chooses each neighbour alike.
            mean += pair / (n_agents * graph.in_degree[i])
    w = weights.expected_gossip(graph)
    assert np.abs(w.matrix.toarray() - mean).max() < 1e-14
    _check_symmetric_and_stochastic(w)


def _check_symmetric_and_stochastic(w: ConsensusWeights) -> None:
    dense = w.matrix.toarray()
    assert (dense >= 0).all()
    assert (dense == dense.T).all()
    assert np.abs(dense.sum(axis=1) - 1).max() < 1e-12


@given(st.integers(0, 1000), st.integers(2, 8))
def test_column_stochastic_weights_of_a_digraph(seed: int, agents: int) -> None:
    graph = random_graph(seed, agents, directed=True)
    columns = weights.column_stochastic(graph).matrix.toarray().sum(axis=0)
    # 1ᵀ W = 1ᵀ: the sum of all values is conserved.
    assert np.abs(columns - 1).max() < 1e-12


@given(st.integers(0, 1000), st.integers(2, 8))
def test_doubly_stochastic_weights_of_a_digraph(seed: int, agents: int) -> None:
    graph = random_graph(seed, agents, directed=True)
    if not graph.is_connected:
        # Positive weights on all links exist only where each link lies on a cycle.
        with pytest.raises(ValueError, match="strongly"):
            weights.doubly_stochastic(graph)
        return
    dense = weights.doubly_stochastic(graph).matrix.toarray()
    for axis in (0, 1):
        assert np.abs(dense.sum(axis=axis) - 1).max() < 1e-12
    of_links = dense[graph.receivers, graph.senders]
    assert (dense >= -1e-12).all()
    assert (of_links > 0).all()
    assert np.isclose(dense.diagonal().min(), 0.5)
    # Proportional to the left null vector, here from a dense decomposition.
    _, _, right_vectors = np.linalg.svd(graph.laplacian.T.toarray())
    p = np.abs(right_vectors[-1])
    ratio = of_links / p[graph.receivers]
    assert np.ptp(ratio) < 1e-9 * ratio.max()


def test_doubly_stochastic_weights_of_other_graphs() -> None:
    """An undirected graph has the Laplacian's; a single agent 1."""
    gain = 0.5 / DISK.in_degree.max()
    expected = weights._laplacian_weights(DISK, gain).link_weights
    w = weights.doubly_stochastic(DISK)
    assert np.allclose(w.link_weights, expected, rtol=1e-14)
    single = graphs.path(1)
    for make in (
        weights.doubly_stochastic,
        weights.metropolis,
        weights.column_stochastic,
    ):
        assert make(single).self_weights == 1


def test_doubly_stochastic_weights_of_a_long_ring_lose_no_digits() -> None:
    """One half of its links goes both ways, the other one way."""
    agents = np.arange(2500)
    forward = np.stack([agents, np.roll(agents, -1)], axis=1)
    edges = np.concatenate([forward, forward[:1250, ::-1]])
    graph = Graph.from_edges(2500, edges, directed=True)
    # Stationary weights span many orders of magnitude along the ring.
    columns = weights.doubly_stochastic(graph).matrix.sum(axis=0)
    assert np.abs(np.asarray(columns) - 1).max() < 1e-12


@each_graph
def test_the_best_constant_reaches_its_bound(graph: Graph) -> None:
    """(λ_max - λ_2) / (λ_max + λ_2) is the smallest modulus with equal weights."""
    w = weights.best_constant_edge(graph)
    low = graph.laplacian_spectrum[1]
    high = graph.laplacian_spectrum[-1]
    bound = (high - low) / (high + low)
    assert np.isclose(_second_modulus(w), bound, atol=1e-9)
    assert (weights.best_constant_edge(graphs.path(1)).matrix.toarray() == 1).all()


@each_graph
def test_the_fastest_weights_reach_the_convex_optimum(graph: Graph) -> None:
    """Against the semidefinite program, solved by cvxpy."""
    cp = pytest.importorskip("cvxpy")
    w = weights.fastest_mixing(graph)
    dense = w.matrix.toarray()
    assert (dense == dense.T).all()
    assert np.abs(dense.sum(axis=0) - 1).max() < 1e-12
    # Minimise the norm of I - B diag(x) Bᵀ - 11ᵀ/A with the oriented incidence
    # matrix B.
    forward = np.flatnonzero(graph.receivers < graph.senders)
    numbers = range(forward.size)
    incidence = np.zeros((graph.n_agents, forward.size))
    incidence[graph.receivers[forward], numbers] = 1
    incidence[graph.senders[forward], numbers] = -1
    x = cp.Variable(forward.size)
    laplacian = incidence @ cp.diag(x) @ incidence.T
    averaging = np.full((graph.n_agents, graph.n_agents), 1 / graph.n_agents)
    matrix = np.eye(graph.n_agents) - averaging - laplacian
    objective = cp.Minimize(cp.norm(matrix, 2))
    optimum = cp.Problem(objective).solve()
    modulus = _second_modulus(w)
    assert optimum - 1e-5 < modulus < optimum + 1e-3
    # Equal weights are feasible, so that they cannot be better.
    best_constant = _second_modulus(weights.best_constant_edge(graph))
    assert modulus <= best_constant + 1e-12


def test_columns_are_checked_relative_to_the_terms_that_cancel() -> None:
    """Rows that sum to one are not enough; the rounding of a large gain is accepted."""
    valid = weights.metropolis(STAR)
    third = np.full(3, 1 / 3)
    wrong = {
        r" 1.* got 2 for agent 0": (np.zeros(3), np.array([0.5, 0.5, 1.0, 1.0])),
        " 1.* got 0.666667": (third, np.ones(4) / 3),
        " 1": (valid.self_weights + [0, 1e-8, 0], valid.link_weights),
    }
    for text, (self_weights, link_weights) in wrong.items():
        w = ConsensusWeights(STAR, self_weights, link_weights)
        with pytest.raises(ValueError, match=f"columns that sum to{text}"):
            weights._check_keeps_average(w)
    # Terms of more than 1e7 cancel to 1: only relative to them is the rounding small.
    weights._check_keeps_average(weights._laplacian_weights(DISK, 1e7 / 3))
