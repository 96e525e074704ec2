"""Networks, channels and Gaussians that the tests of this folder share."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.network import Channel, ConsensusWeights, Faults, Graph, graphs

NAN = float("nan")
STAR = graphs.star(3)
UNLINKED = Graph.from_adjacency(np.zeros((3, 3)))


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


REFERENCE = {
    "ring": graphs.ring(7),
    "star": graphs.star(5),
    "grid": graphs.grid(3, 4),
    "disk": graphs.disk(rng(3).random((30, 2)), 0.4),
}
GRID = REFERENCE["grid"]
DISK = REFERENCE["disk"]
each_graph = pytest.mark.parametrize("graph", REFERENCE.values(), ids=REFERENCE.keys())


def star(**options: object) -> Channel:
    """Return a channel on a star of three."""
    return Channel(STAR, **options)


def lossy(loss: float = 0.3, graph: Graph = STAR, **options: object) -> Channel:
    """Return a channel that loses messages."""
    return Channel(graph, faults=Faults(loss=loss, seed=5), **options)


def weights_of_matrix(graph: Graph, matrix: object) -> ConsensusWeights:
    """Return the weights that a matrix has at the graph's links and on its diagonal."""
    dense = np.asarray(matrix, dtype=float)
    link_weights = dense[graph.receivers, graph.senders]
    return ConsensusWeights(graph, dense.diagonal(), link_weights)


def random_graph(seed: int, agents: int, *, directed: bool = False) -> Graph:
    """Return a graph that has each link with probability one half."""
    links = rng(seed).random((agents, agents)) < 0.5
    upper = np.triu(links, 1)
    # An undirected graph has the links of the upper triangle in both directions.
    lower = np.tril(links, -1) if directed else upper.T
    return Graph.from_adjacency((upper | lower).astype(float), directed=directed)


def arrivals(
    faults: Faults, graph: Graph, round_: int = 0, runs: int = 1
) -> np.ndarray:
    """Return whether agent i receives the message of agent j, (runs, A, A)."""
    arrived = np.zeros((runs, graph.n_agents, graph.n_agents), dtype=bool)
    lost = faults.draw_losses(graph, round_, runs)
    arrived[:, graph.receivers, graph.senders] = ~lost
    return arrived


def gaussians(seed: int, *leading: int, d: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return means and full covariances, with components of different size."""
    draw = rng(seed)
    factors = draw.standard_normal((*leading, d, d))
    scale = np.logspace(-1, 1, d)
    # S (F Fᵀ + 0.2 I) S with S = diag(scale) is positive definite.
    covs = factors @ np.swapaxes(factors, -1, -2)
    covs = covs + 0.2 * np.eye(d)
    covs = covs * np.outer(scale, scale)
    # Products are rounded differently in both triangles.
    covs = 0.5 * (covs + np.swapaxes(covs, -1, -2))
    means = draw.standard_normal((*leading, d)) * scale
    return means, covs
