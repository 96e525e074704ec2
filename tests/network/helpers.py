"""Networks, channels and Gaussians that the tests of this folder share."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.network import Channel, ConsensusWeights, Faults, Graph, graphs

NAN = float("nan")
STAR = graphs.star(3)
APART = Graph.from_adjacency(np.zeros((3, 3)))


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
named = pytest.mark.parametrize("graph", REFERENCE.values(), ids=REFERENCE.keys())


def star(**options: object) -> Channel:
    """A channel on a star of three."""
    return Channel(STAR, **options)


def lossy(loss: float = 0.3, graph: Graph = STAR, **options: object) -> Channel:
    return Channel(graph, faults=Faults(loss=loss, seed=5), **options)


def of_matrix(graph: Graph, matrix: object) -> ConsensusWeights:
    """The weights that stand in a matrix at the graph's links and on its diagonal."""
    dense = np.asarray(matrix, dtype=float)
    return ConsensusWeights(
        graph, dense.diagonal(), dense[graph.receivers, graph.senders]
    )


def random_graph(seed: int, agents: int, *, directed: bool = False) -> Graph:
    """Each link with probability one half."""
    a = rng(seed).random((agents, agents)) < 0.5
    a = np.triu(a, 1) | (np.tril(a, -1) if directed else np.triu(a, 1).T)
    return Graph.from_adjacency(a.astype(float), directed=directed)


def heard(faults: Faults, graph: Graph, round_: int = 0, runs: int = 1) -> np.ndarray:
    """Whose message arrives at whom, (runs, A, A)."""
    out = np.zeros((runs, graph.n_agents, graph.n_agents), dtype=bool)
    out[:, graph.receivers, graph.senders] = ~faults.lost(graph, round_, runs)
    return out


def gaussians(seed: int, *leading: int, d: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Means and full covariances, components of different size."""
    draw = rng(seed)
    a = draw.standard_normal((*leading, d, d))
    size = np.logspace(-1, 1, d)
    covs = (a @ np.swapaxes(a, -1, -2) + 0.2 * np.eye(d)) * np.outer(size, size)
    return draw.standard_normal((*leading, d)) * size, 0.5 * (
        covs + np.swapaxes(covs, -1, -2)
    )
