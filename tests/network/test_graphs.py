"""Graphs: their making, spectra, hops, and what holds at a hundred thousand agents."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse
from scipy.sparse.csgraph import shortest_path

from distfilt.network import Graph, graphs
from distfilt.network.links import linked
from tests.network.helpers import APART, NAN, ONE_WAY, REFERENCE, STAR, random_graph, rng

named = pytest.mark.parametrize("graph", REFERENCE.values(), ids=REFERENCE.keys())
_G = "distfilt.network.graphs."


def _networkx_loop() -> object:
    import networkx as nx

    return nx.Graph([(0, 1), (1, 1)])


BAD_INPUT = {
    "distfilt.network.links.Graph": [
        ("links", lambda: Graph(np.eye(2))),
        ("links", lambda: Graph(sparse.csr_array(np.eye(2)))),
        ("links", lambda: Graph(sparse.csr_array(2.0 * np.eye(2)[::-1]))),
        ("links", lambda: Graph(sparse.csr_array(np.ones((2, 3))))),
        ("links", lambda: Graph(3)),
        ("adjacency", lambda: Graph.from_adjacency([[0, 1]])),
        ("adjacency", lambda: Graph.from_adjacency(np.zeros((0, 0)))),
        ("adjacency", lambda: Graph.from_adjacency([[0, 2], [2, 0]])),
        ("adjacency", lambda: Graph.from_adjacency([[1, 1], [1, 0]])),
        ("adjacency", lambda: Graph.from_adjacency([[0, 1], [0, 0]])),
        ("adjacency", lambda: Graph.from_adjacency([[0, NAN], [NAN, 0]])),
        ("edges", lambda: Graph.from_edges(2, [(0, 0)])),
        ("edges", lambda: Graph.from_edges(2, [(0, 2), (2, 0)])),
        ("edges", lambda: Graph.from_edges(2, [(0, 0.5)])),
        ("edges", lambda: Graph.from_edges(2, [(0, 1)])),
        ("edges", lambda: Graph.from_edges(2, [0, 1, 1])),
        ("agents", lambda: Graph.from_edges(0, [])),
        ("graph", lambda: Graph.from_networkx(3)),
        ("graph", lambda: Graph.from_networkx(_networkx_loop())),
        ("agent", lambda: STAR.neighbours(3)),
        ("agent", lambda: STAR.hops(3)),
        ("graph", lambda: ONE_WAY.spectrum),
        ("graph", lambda: ONE_WAY.fiedler_value),
        ("graph", lambda: APART.diameter),
        ("graph", lambda: APART.diameter_bound),
    ],
    _G + "complete": [("agents", lambda: graphs.complete(0))],
    _G + "disk": [
        ("positions", lambda: graphs.disk([1.0, 2.0], 1.0)),
        ("positions", lambda: graphs.disk([[NAN, 0.0]], 1.0)),
        ("positions", lambda: graphs.disk(np.zeros((0, 2)), 1.0)),
        ("radius", lambda: graphs.disk([[0.0, 0.0]], 0.0)),
    ],
    _G + "grid": [
        ("rows", lambda: graphs.grid(0, 2)),
        ("columns", lambda: graphs.grid(2, 1.5)),
    ],
    _G + "path": [("agents", lambda: graphs.path(0))],
    _G + "random": [
        ("agents", lambda: graphs.random(0, 0.5, rng=rng())),
        ("probability", lambda: graphs.random(3, 1.5, rng=rng())),
        ("rng", lambda: graphs.random(3, 0.5, rng=1)),
    ],
    _G + "ring": [("agents", lambda: graphs.ring(2))],
    _G + "star": [("agents", lambda: graphs.star(0))],
}


def test_shapes_are_networkx_s() -> None:
    import networkx as nx

    pairs = [
        (graphs.path(1), nx.path_graph(1)), (graphs.path(7), nx.path_graph(7)),
        (graphs.ring(3), nx.cycle_graph(3)), (graphs.ring(8), nx.cycle_graph(8)),
        (graphs.star(1), nx.star_graph(0)), (graphs.star(6), nx.star_graph(5)),
        (graphs.grid(1, 4), nx.grid_2d_graph(1, 4)), (graphs.grid(3, 5), nx.grid_2d_graph(3, 5)),
        (graphs.complete(1), nx.complete_graph(1)), (graphs.complete(6), nx.complete_graph(6)),
    ]
    for ours, theirs in pairs:
        assert (ours.links.toarray() == nx.to_numpy_array(theirs)).all()


@given(st.integers(0, 1000), st.integers(1, 8))
def test_networkx_graphs_go_there_and_back(seed: int, agents: int) -> None:
    import networkx as nx

    for directed in (True, False):
        graph = random_graph(seed, agents, directed=directed)
        theirs = graph.to_networkx()
        assert [set(theirs.predecessors(i)) for i in range(agents)] == [
            set(graph.neighbours(i)) for i in range(agents)
        ]
        assert (Graph.from_networkx(theirs).links != graph.links).nnz == 0
        assert graph.connected == nx.is_strongly_connected(theirs)
        if not directed:
            both = Graph.from_networkx(theirs.to_undirected())
            assert (both.links != graph.links).nnz == 0


def test_a_networkx_edge_runs_from_speaker_to_listener() -> None:
    import networkx as nx

    graph = Graph.from_networkx(nx.DiGraph([("camera", "screen"), ("screen", "log")]))
    assert graph.directed and graph.neighbours(1) == (0,) and graph.neighbours(0) == ()
    parallel = Graph.from_networkx(nx.MultiGraph([(5, 7), (5, 7), (7, 9)]))
    assert parallel.senders.size == 4


@given(st.integers(0, 1000), st.integers(1, 8))
def test_laplacian_rows_sum_to_zero(seed: int, agents: int) -> None:
    graph = random_graph(seed, agents, directed=True)
    dense = graph.links.toarray()
    assert (graph.laplacian.toarray() == np.diag(dense.sum(axis=1)) - dense).all()
    assert (graph.listeners == dense.sum(axis=0)).all() and (graph.degrees == dense.sum(1)).all()
    assert (graph.incidence @ np.ones(graph.senders.size) == graph.degrees).all()
    for e, back in enumerate(graph.reverse):
        i, j = graph.receivers[e], graph.senders[e]
        assert (back >= 0) == bool(dense[j, i])
        assert back < 0 or (graph.receivers[back], graph.senders[back]) == (j, i)


def test_spectra_of_the_satellite_networks() -> None:
    assert np.allclose(graphs.star(3).spectrum, [0, 1, 3], atol=1e-12)
    assert np.allclose(graphs.star(5).spectrum, [0, 1, 1, 1, 5], atol=1e-12)
    assert np.isclose(graphs.star(5).largest_gain, 2 / 5)


@named
def test_spectra_agree_with_networkx(graph: Graph) -> None:
    import networkx as nx

    theirs = graph.to_networkx().to_undirected()
    assert np.allclose(graph.spectrum, np.sort(nx.laplacian_spectrum(theirs)), atol=1e-10)
    assert np.isclose(graph.fiedler_value, graph.spectrum[1], rtol=1e-9)
    assert np.isclose(graph.largest_gain, 2 / graph.spectrum[-1], rtol=1e-9)
    assert graph.diameter == nx.diameter(theirs)


def test_sparse_and_dense_ends_of_the_spectrum_agree() -> None:
    graph = graphs.grid(20, 30)
    exact = 2 - 2 * np.cos(np.pi / 30)
    assert np.isclose(graph.fiedler_value, exact, rtol=1e-9)
    assert np.isclose(graph.spectrum[1], exact, rtol=1e-8)
    for other in (graph, graphs.ring(301), graphs.path(400), graphs.star(300), graphs.complete(250),
                  graphs.disk(rng(1).random((500, 2)), 0.1)):
        assert np.isclose(other.largest_gain, 2 / other.spectrum[-1], rtol=1e-9)


@given(st.integers(0, 1000), st.integers(1, 9), st.booleans())
def test_a_gain_from_degrees_is_safe(seed: int, agents: int, directed: bool) -> None:
    """Below the bound every mode but the average shrinks; at 1.001 times the limit one grows."""
    graph = random_graph(seed, agents, directed=directed)
    safe, limit = graph.safe_gain, graph.largest_gain
    assert safe <= limit * (1 + 1e-9)
    if graph.senders.size == 0:
        assert safe == limit == float("inf")
        return
    values = np.linalg.eigvals(graph.laplacian.toarray())
    moving = values[np.abs(values) > 1e-8]
    if moving.size:
        below, above = (np.abs(1 - f * limit * moving).max() for f in (0.999, 1.001))
        assert below < 1 < above


def test_the_degree_bound_is_exact_for_stars_and_even_rings() -> None:
    for graph in (graphs.star(7), graphs.ring(8)):
        assert np.isclose(graph.safe_gain, graph.largest_gain, rtol=1e-12)


@given(st.integers(0, 1000), st.integers(1, 10), st.booleans())
def test_hops_and_diameters(seed: int, agents: int, directed: bool) -> None:
    graph = random_graph(seed, agents, directed=directed)
    # links[i, j] carries news from j to i.
    away = shortest_path(graph.links.T, unweighted=True)
    for agent in range(agents):
        exact = np.where(np.isinf(away[agent]), -1, away[agent])
        assert (graph.hops(agent) == exact).all()
    if graph.connected:
        assert graph.diameter == away.max()
        assert away.max() <= graph.diameter_bound <= 2 * away.max()


@pytest.mark.parametrize("graph", [
    graphs.path(50), graphs.ring(51), graphs.grid(9, 13), graphs.star(30), graphs.complete(12),
    graphs.disk(rng(5).random((300, 2)), 0.12),
])
def test_diameters_of_larger_graphs(graph: Graph) -> None:
    if not graph.connected:
        pytest.fail("needs a connected example")
    exact = int(shortest_path(graph.links, unweighted=True).max())
    assert graph.diameter == exact and exact <= graph.diameter_bound <= 2 * exact


@given(st.integers(0, 1000), st.integers(1, 40), st.floats(0.05, 1.0))
def test_disk_links_are_the_close_pairs(seed: int, agents: int, radius: float) -> None:
    places = rng(seed).random((agents, 2))
    gaps = np.linalg.norm(places[:, None] - places[None], axis=-1)
    wanted = (gaps <= radius) & ~np.eye(agents, dtype=bool)
    assert (graphs.disk(places, radius).links.toarray() == wanted).all()


@pytest.mark.parametrize("directed", [False, True])
def test_random_links_are_one_draw_however_it_is_cut(
    directed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = rng(3).random((20, 20)) < 0.3
    np.fill_diagonal(drawn, False)
    if not directed:
        drawn = np.triu(drawn) | np.triu(drawn).T
    for block in (4_000_000, 65, 1):
        monkeypatch.setattr(graphs, "_BLOCK", block)
        graph = graphs.random(20, 0.3, rng=rng(3), directed=directed)
        assert (graph.links.toarray() == drawn).all()


def test_the_first_one_way_link_is_named_without_a_dense_matrix() -> None:
    size = 50_000
    chain = np.stack([np.arange(1, size), np.arange(size - 1)], axis=1)
    with pytest.raises(ValueError, match="one way only between agents 0 and 1"):
        Graph.from_edges(size, chain)


def test_repeated_links_count_once() -> None:
    assert (linked(2, np.array([[0, 1], [1, 0], [0, 1]])).toarray() == [[0, 1], [1, 0]]).all()
