"""Gaussian belief propagation: against the solution of the joint system."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.network import Channel, Faults, Graph, gaussian_belief_propagation, graphs
from tests.network.helpers import rng

Array = np.ndarray
TREES = {
    "path": graphs.path(6),
    "star": graphs.star(6),
    "fork": Graph.from_edges(7, [(0, 1), (1, 2), (1, 3), (3, 4), (3, 5), (5, 6)]),
    "alone": graphs.path(1),
}
each_tree = pytest.mark.parametrize("tree", TREES.values(), ids=TREES.keys())


def system(
    graph: Graph, d: int = 2, seed: int = 0, slack: float = 0.0
) -> tuple[Array, ...]:
    """Return blocks of a random positive definite J, h, and J as a whole.

    Each link adds |a x_i - b x_j|², each agent a weak prior; `slack` makes the blocks dominant.
    """
    draw = rng(seed)
    n = graph.n_agents
    joint = 0.1 * np.eye(n * d)
    for i, j in zip(graph.receivers, graph.senders, strict=True):
        if i < j:
            # |B_i x_i + B_j x_j|² with two random blocks
            row = np.zeros((d, n * d))
            first = draw.standard_normal((d, d)) + 2 * np.eye(d)
            second = draw.standard_normal((d, d)) - 2 * np.eye(d)
            row[:, i * d : (i + 1) * d] = first
            row[:, j * d : (j + 1) * d] = second
            joint += row.T @ row
    # A larger diagonal makes rounds converge on any graph.
    if slack:
        joint += slack * np.diag(np.abs(joint).sum(axis=1))
    # J_ii of agents, and J_ij in the order of the links
    blocks = joint.reshape(n, d, n, d)
    matrices = np.array([blocks[k, :, k] for k in range(n)])
    links = zip(graph.receivers, graph.senders, strict=True)
    couplings = np.array([blocks[i, :, j] for i, j in links])
    vectors = draw.standard_normal((n, d))
    # Without links too there are three axes.
    return matrices, vectors, couplings.reshape(-1, d, d), joint


@each_tree
@pytest.mark.parametrize("d", [1, 3])
def test_marginals_on_a_tree_are_exact_after_the_diameter(tree: Graph, d: int) -> None:
    matrices, vectors, couplings, joint = system(tree, d)
    channel = Channel(tree)
    means, covs = gaussian_belief_propagation(matrices, vectors, couplings, channel)
    expected = np.linalg.solve(joint, vectors.ravel()).reshape(-1, d)
    inverse = np.linalg.inv(joint).reshape(tree.n_agents, d, tree.n_agents, d)
    assert np.allclose(means, expected, rtol=1e-8)
    for k in range(tree.n_agents):
        assert np.allclose(covs[k], inverse[k, :, k], rtol=1e-8)
    # A vector and the upper triangle of a matrix on each link and round
    sent = (d + d * (d + 1) // 2) * max(tree.diameter, 1) * tree.out_degree
    assert (channel.ledger.scalars == sent).all()


@pytest.mark.parametrize("graph", [graphs.ring(6), graphs.grid(3, 3)])
def test_with_circles_means_are_exact_and_covariances_are_not(graph: Graph) -> None:
    matrices, vectors, couplings, joint = system(graph, slack=0.2)
    means, covs = gaussian_belief_propagation(
        matrices, vectors, couplings, Channel(graph), rounds=200
    )
    expected = np.linalg.solve(joint, vectors.ravel()).reshape(-1, 2)
    assert np.allclose(means, expected, rtol=1e-8, atol=1e-10)
    # Covariances are near, but not equal to, those of the whole.
    inverse = np.linalg.inv(joint).reshape(graph.n_agents, 2, graph.n_agents, 2)
    error = [
        np.abs(covs[k] / inverse[k, :, k] - 1).max() for k in range(graph.n_agents)
    ]
    assert 1e-4 < max(error) < 0.5


def test_a_round_reaches_one_link_farther() -> None:
    """Another value at one end of a path changes only agents within reach."""
    path = TREES["path"]
    matrices, vectors, couplings, _ = system(path)
    other = vectors.copy()
    other[0] += 1.0
    for rounds in range(1, 6):
        a, b = [
            gaussian_belief_propagation(
                matrices, v, couplings, Channel(path), rounds=rounds
            )[0]
            for v in (vectors, other)
        ]
        changed = np.abs(a - b).max(axis=1) > 0
        assert changed.tolist() == [k <= rounds for k in range(6)]


def test_lost_messages_only_cost_time_run_by_run() -> None:
    path = TREES["path"]
    matrices, vectors, couplings, joint = system(path)
    faults = Faults(loss=0.5, seed=1)
    factors = np.arange(4)[:, None, None]
    runs = (np.tile(matrices, (4, 1, 1, 1)), factors * vectors)
    channel = Channel(path, runs=(4,), faults=faults)
    means, _ = gaussian_belief_propagation(*runs, couplings, channel, rounds=60)
    # Run k has k times the vector, and so k times the solution.
    expected = np.linalg.solve(joint, vectors.ravel()).reshape(-1, 2)
    for k in range(4):
        assert np.allclose(means[k], k * expected, atol=1e-9)
    assert channel.ledger.lost.sum() > 0
    # After a few rounds some run still lacks a message.
    few, _ = gaussian_belief_propagation(
        *runs, couplings, Channel(path, runs=(4,), faults=faults), rounds=5
    )
    assert np.abs(few - factors * expected).max() > 1e-3


def test_what_is_refused() -> None:
    path = TREES["path"]
    matrices, vectors, couplings, _ = system(path)
    wrong = couplings.copy()
    wrong[0] += 1.0
    with pytest.raises(ValueError, match=r"^couplings must be transposed on opposite"):
        gaussian_belief_propagation(matrices, vectors, wrong, Channel(path))
    circle = Graph.from_edges(3, [(0, 2), (1, 0), (2, 1)], directed=True)
    with pytest.raises(ValueError, match="links both ways"):
        gaussian_belief_propagation(
            matrices[:3], vectors[:3], couplings[:3], Channel(circle)
        )
