"""Graphs: their making, spectra, hops, and what describes one."""

from __future__ import annotations

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse
from scipy.sparse.csgraph import shortest_path

from distfilt.network import Graph, graphs
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


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_and_spectra_are_networkx_s(name: str) -> None:
    graph, theirs = SHAPES[name]
    assert (graph.links.toarray() == nx.to_numpy_array(theirs)).all()
    assert graph.diameter == nx.diameter(theirs)
    if graph.n_agents > 1:
        assert np.allclose(
            graph.laplacian_spectrum, np.sort(nx.laplacian_spectrum(theirs)), atol=1e-10
        )
        assert np.isclose(
            graph.max_stable_gain, 2 / graph.laplacian_spectrum[-1], rtol=1e-9
        )


def test_sparse_and_dense_ends_of_the_spectrum_agree() -> None:
    for other in (
        graphs.ring(301),
        graphs.path(400),
        graphs.star(300),
        graphs.complete(250),
        graphs.disk(rng(1).random((500, 2)), 0.1),
    ):
        assert np.isclose(
            other.max_stable_gain, 2 / other.laplacian_spectrum[-1], rtol=1e-9
        )


@given(st.integers(0, 1000), st.integers(1, 10), st.booleans())
def test_links_laplacian_and_hops_by_their_definition(
    seed: int, agents: int, directed: bool
) -> None:
    graph = random_graph(seed, agents, directed=directed)
    dense = graph.links.toarray()
    assert (graph.laplacian.toarray() == np.diag(dense.sum(axis=1)) - dense).all()
    assert (graph.out_degree == dense.sum(axis=0)).all() and (
        graph.in_degree == dense.sum(1)
    ).all()
    assert (graph.incidence @ np.ones(graph.senders.size) == graph.in_degree).all()
    if not graph.directed:
        assert (graph.receivers[graph.reverse] == graph.senders).all()
        assert (graph.senders[graph.reverse] == graph.receivers).all()
    # links[i, j] carries news from j to i.
    away = shortest_path(graph.links.T, unweighted=True)
    for agent in range(agents):
        assert (
            graph.hops(agent) == np.where(np.isinf(away[agent]), -1, away[agent])
        ).all()
        assert graph.neighbours(agent) == tuple(np.flatnonzero(dense[agent]))
    assert graph.connected == np.isfinite(away).all()
    if graph.connected:
        assert graph.diameter == away.max()


@given(st.integers(0, 1000), st.integers(1, 9), st.booleans())
def test_a_gain_from_degrees_is_safe(seed: int, agents: int, directed: bool) -> None:
    """Below the bound every mode but the average shrinks; at 1.001 times the limit one grows."""
    graph = random_graph(seed, agents, directed=directed)
    safe = graph.degree_bound_gain
    limit = graph.max_stable_gain
    assert safe <= limit * (1 + 1e-9)
    values = np.linalg.eigvals(graph.laplacian.toarray())
    moving = values[np.abs(values) > 1e-8]
    if moving.size:
        below, above = (np.abs(1 - f * limit * moving).max() for f in (0.999, 1.001))
        assert below < 1 < above
    assert graph.senders.size or safe == limit == float("inf")


def test_the_degree_bound_is_exact_for_stars_and_even_rings() -> None:
    for graph in (graphs.star(7), graphs.ring(8), graphs.ring(10_000)):
        assert np.isclose(graph.degree_bound_gain, graph.max_stable_gain, rtol=1e-12)


@given(st.integers(0, 1000), st.integers(1, 40), st.floats(0.05, 1.0))
def test_disk_links_are_the_close_pairs(seed: int, agents: int, radius: float) -> None:
    places = rng(seed).random((agents, 2))
    gaps = np.linalg.norm(places[:, None] - places[None], axis=-1)
    wanted = (gaps <= radius) & ~np.eye(agents, dtype=bool)
    assert (graphs.disk(places, radius).links.toarray() == wanted).all()


def test_edges_count_once_and_run_from_speaker_to_listener() -> None:
    for edges in ([(0, 1), (1, 2)], [(0, 1), (1, 0), (2, 1), (1, 2), (0, 1)]):
        assert (Graph.from_edges(3, edges).links != graphs.path(3).links).nnz == 0
    one_way = Graph.from_edges(3, [(0, 1), (1, 2)], directed=True)
    assert one_way.directed and one_way.neighbours(2) == ()
    named = Graph.from_networkx(nx.DiGraph([("camera", "screen"), ("screen", "log")]))
    assert named.directed and named.neighbours(1) == (0,) and named.neighbours(0) == ()
    assert (
        Graph.from_networkx(nx.MultiGraph([(5, 7), (5, 7), (7, 9)])).senders.size == 4
    )
    for a, b, c in ((0, 1, 2), "abc"):
        assert as_graph(nx.Graph([(c, a), (a, b)]), 3, "abc").neighbours(0) == (1, 2)
    with pytest.raises(
        ValueError, match=r"graph must be the nodes \['a', 'b', 'c'\], got"
    ):
        as_graph(nx.path_graph(["a", "b", "d"]), 3, "abc")


@given(st.integers(0, 1000), st.integers(1, 8))
def test_a_graph_is_read_from_what_describes_it(seed: int, agents: int) -> None:
    graph = random_graph(seed, agents)
    dense = graph.links.toarray()
    edges = np.argwhere(np.triu(dense))
    forms = [
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
    for value in forms:
        assert (as_graph(value, agents).links != graph.links).nnz == 0
    assert (
        as_graph([(0, 1), (1, 0)]).n_agents == 2
        and as_graph([(0, 1), (1, 2)]).n_agents == 3
    )
    assert as_graph([(0, 1), (1, 0)], 3).in_degree.tolist() == [1.0, 1.0, 0.0]


def test_what_describes_no_graph_is_refused_with_the_ways_to_make_one() -> None:
    refused = {
        "both ways .*directed=True.* one way only between 0 and 1": np.eye(3, k=-1),
        "a graph of 3 agents, got 4": graphs.path(4),
    }
    for text, value in refused.items():
        with pytest.raises(ValueError, match=f"graph must .*{text}"):
            as_graph(value, 3)
