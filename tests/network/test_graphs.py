"""Graphs: shapes, spectra, hops, gains from degrees, and descriptions of graphs."""

from __future__ import annotations

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse
from scipy.sparse.csgraph import shortest_path

from distfilt.network import Channel, Graph, graphs
from distfilt.network.graphs import as_graph
from tests.network.helpers import DISK, random_graph, rng

SHAPES = {
    "row of one": (graphs.path(1), nx.path_graph(1)),
    "row": (graphs.path(50), nx.path_graph(50)),
    "ring": (graphs.ring(51), nx.cycle_graph(51)),
    "star of one": (graphs.star(1), nx.star_graph(0)),
    "star": (graphs.star(30), nx.star_graph(29)),
    "grid of a row": (graphs.grid(1, 4), nx.grid_2d_graph(1, 4)),
    "grid": (graphs.grid(9, 13), nx.grid_2d_graph(9, 13)),
    "complete": (graphs.complete(12), nx.complete_graph(12)),
    "disk": (DISK, nx.Graph(DISK.links.toarray())),
}
# More agents than the dense solver is used for.
LARGE = {
    "ring": graphs.ring(301),
    "path": graphs.path(400),
    "star": graphs.star(300),
    "complete": graphs.complete(250),
    "disk": graphs.disk(rng(1).random((500, 2)), 0.1),
}


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_and_spectra_are_networkx_s(name: str) -> None:
    graph, reference = SHAPES[name]
    assert (graph.links.toarray() == nx.to_numpy_array(reference)).all()
    assert graph.diameter == nx.diameter(reference)
    if graph.n_agents > 1:
        spectrum = np.sort(nx.laplacian_spectrum(reference))
        assert np.allclose(graph.laplacian_spectrum, spectrum, atol=1e-10)
        # |1 - γ λ| < 1 for all modes needs γ < 2/λ_max.
        gain = 2 / graph.laplacian_spectrum[-1]
        assert np.isclose(graph.max_stable_gain, gain, rtol=1e-9)


@pytest.mark.parametrize("graph", LARGE.values(), ids=LARGE.keys())
def test_sparse_and_dense_solvers_agree(graph: Graph) -> None:
    gain = 2 / graph.laplacian_spectrum[-1]
    assert np.isclose(graph.max_stable_gain, gain, rtol=1e-9)


@given(st.integers(0, 1000), st.integers(1, 10), st.booleans())
def test_links_and_laplacian_by_their_definition(
    seed: int, agents: int, directed: bool
) -> None:
    graph = random_graph(seed, agents, directed=directed)
    dense = graph.links.toarray()
    degrees = dense.sum(axis=1)
    # L = D - A with the in-degrees: links[i, j] leads from j to i.
    laplacian = np.diag(degrees) - dense
    assert (graph.laplacian.toarray() == laplacian).all()
    assert (graph.in_degree == degrees).all()
    assert (graph.out_degree == dense.sum(axis=0)).all()
    # Each row of the incidence matrix counts the links that end at its agent.
    ones = np.ones(graph.senders.size)
    assert (graph.incidence @ ones == degrees).all()
    for agent in range(agents):
        assert graph.neighbours(agent) == tuple(np.flatnonzero(dense[agent]))
    if not graph.is_directed:
        # The opposite link has receiver and sender exchanged.
        assert (graph.receivers[graph.reverse] == graph.senders).all()
        assert (graph.senders[graph.reverse] == graph.receivers).all()


@given(st.integers(0, 1000), st.integers(1, 10), st.booleans())
def test_hops_are_scipy_s_shortest_paths(
    seed: int, agents: int, directed: bool
) -> None:
    graph = random_graph(seed, agents, directed=directed)
    # links[i, j] leads from j to i, against scipy's convention.
    distances = shortest_path(graph.links.T, unweighted=True)
    reachable = np.isfinite(distances)
    expected = np.where(reachable, distances, -1)
    for agent in range(agents):
        assert (graph.hops(agent) == expected[agent]).all()
    assert graph.is_connected == reachable.all()
    if graph.is_connected:
        assert graph.diameter == distances.max()


@given(st.integers(0, 1000), st.integers(1, 9), st.booleans())
def test_a_gain_from_degrees_is_stable(seed: int, agents: int, directed: bool) -> None:
    """Below the bound every mode but the average shrinks; at 1.001 times it one grows."""
    graph = random_graph(seed, agents, directed=directed)
    bound = graph.degree_bound_gain
    limit = graph.max_stable_gain
    # Degrees bound the eigenvalues: by Merris, for a digraph by Gershgorin's discs.
    assert bound <= limit * (1 + 1e-9)
    assert graph.senders.size or bound == limit == float("inf")
    eigenvalues = np.linalg.eigvals(graph.laplacian.toarray())
    # Modes of eigenvalue zero are the averages of the components.
    moving = eigenvalues[np.abs(eigenvalues) > 1e-8]
    if moving.size:
        # A mode of eigenvalue λ is multiplied by 1 - γ λ in each round.
        assert np.abs(1 - 0.999 * limit * moving).max() < 1
        assert np.abs(1 - 1.001 * limit * moving).max() > 1


def test_the_degree_bound_is_exact_for_stars_and_even_rings() -> None:
    # λ_max = max (d_i + m_i) with the neighbours' mean degree m_i: 7 for a star of 7
    # (6 + 1), 4 for an even ring (2 + 2).
    for graph in (graphs.star(7), graphs.ring(8), graphs.ring(10_000)):
        assert np.isclose(graph.degree_bound_gain, graph.max_stable_gain, rtol=1e-12)


@given(st.integers(0, 1000), st.integers(1, 40), st.floats(0.05, 1.0))
def test_disk_links_are_the_close_pairs(seed: int, agents: int, radius: float) -> None:
    positions = rng(seed).random((agents, 2))
    differences = positions[:, None] - positions[None]
    close = np.linalg.norm(differences, axis=-1) <= radius
    expected = close & ~np.eye(agents, dtype=bool)
    assert (graphs.disk(positions, radius).links.toarray() == expected).all()


def test_edges_count_once_and_run_from_sender_to_receiver() -> None:
    repeated = [(0, 1), (1, 0), (2, 1), (1, 2), (0, 1)]
    for edges in ([(0, 1), (1, 2)], repeated):
        graph = Graph.from_edges(3, edges)
        assert (graph.links != graphs.path(3).links).nnz == 0
    # Agent 2 receives from nobody.
    one_way = Graph.from_edges(3, [(0, 1), (1, 2)], directed=True)
    assert one_way.is_directed
    assert one_way.neighbours(2) == ()


def test_graphs_of_networkx_keep_their_labels_or_their_order() -> None:
    # In the order of the nodes: screen 0, camera 1, log 2; from receiver to sender.
    digraph = nx.DiGraph([("screen", "camera"), ("log", "screen")])
    graph = Graph.from_networkx(digraph)
    assert graph.is_directed
    assert graph.neighbours(0) == (1,)
    assert graph.neighbours(1) == ()
    # Parallel edges count once.
    parallel = nx.MultiGraph([(5, 7), (5, 7), (7, 9)])
    assert Graph.from_networkx(parallel).senders.size == 4
    # Labels that are numbers, or names of agents, count before the order.
    for a, b, c in ((0, 1, 2), "abc"):
        graph = as_graph(nx.Graph([(c, a), (a, b)]), 3, "abc")
        assert graph.neighbours(0) == (1, 2)
    expected = r"graph must have the nodes \['a', 'b', 'c'\], got"
    with pytest.raises(ValueError, match=expected):
        as_graph(nx.path_graph(["a", "b", "d"]), 3, "abc")


def test_a_graph_of_networkx_without_nodes_is_refused() -> None:
    """Also inside a function that has checked its arguments already."""
    for make in (Graph.from_networkx, Channel):
        with pytest.raises(ValueError, match="^graph must have at least one node"):
            make(nx.Graph())


@given(st.integers(0, 1000), st.integers(1, 8))
def test_a_graph_from_each_of_its_descriptions(seed: int, agents: int) -> None:
    graph = random_graph(seed, agents)
    dense = graph.links.toarray()
    # Of an undirected graph each edge once, so that the upper triangle lists them all.
    edges = np.argwhere(np.triu(dense))
    descriptions = [
        graph,
        nx.Graph(dense),
        nx.DiGraph(dense),
        graph.links,
        sparse.coo_matrix(dense),
        dense,
        dense.tolist(),
        dense.astype(bool),
        dense.astype(int),
        edges,
        edges.tolist(),
    ]
    for description in descriptions:
        assert (as_graph(description, agents).links != graph.links).nnz == 0


def test_two_edges_are_no_matrix_of_two_agents() -> None:
    # [[0, 1], [1, 0]] could be an adjacency matrix or two edges.
    assert as_graph([(0, 1), (1, 0)]).n_agents == 2
    assert as_graph([(0, 1), (1, 2)]).n_agents == 3
    # With three agents (0, 1) and (1, 0) are edges, and the third has no links.
    graph = as_graph([(0, 1), (1, 0)], 3)
    assert graph.in_degree.tolist() == [1.0, 1.0, 0.0]


def test_wrong_descriptions_are_refused_with_the_way_to_mend_them() -> None:
    wrong = {
        "both ways .*directed=True.* one way only between 0 and 1": np.eye(3, k=-1),
        "have 3 agents, got 4": graphs.path(4),
    }
    for text, value in wrong.items():
        with pytest.raises(ValueError, match=f"^graph must .*{text}"):
            as_graph(value, 3)
