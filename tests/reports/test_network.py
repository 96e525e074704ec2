"""Networks: weights that do not average, parts without a link, labels and directions of graphs.

Situations from public reports, with values made independently (numpy on dense matrices).

==============================  ==========================================================
Report                          Situation here
==============================  ==========================================================
review d_weights_push           column-stochastic weights given to the average
review d_graph_labels           labels from 1 in the order of their edges
ChocoSGD issue 9                a mixing matrix that is not doubly stochastic
networkx issues 3863, 6649      the order of nodes is that of their edges
networkx issue 5312             an edge list of numbers, read in another order
networkx pull requests 1335,    the direction of an entry of the adjacency matrix
3542
LightGraphs.jl issue 466        a digraph flipped on its way through its adjacency
libpysal issue 81               an isolated member: one warning says it
Lomap pull request 154          a network in parts that nobody is told of
cnfgen pull 107, topologic      labels of a file: numbers as text, in the order of its edges
pull 60
fglib issue 8                   belief propagation on a graph with circles
dynesty issue 263               weights of single precision
own                             weights that swap values, and diverge; rounds with faults
own                             diffusion with rows that do not sum to one; edges by names
==============================  ==========================================================
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import networkx as nx
import numpy as np
import pytest

from distfilt import network
from distfilt.filters import GaussianFilter
from distfilt.models import constant_velocity
from distfilt.network import Channel, ConsensusWeights, Faults, Graph, graphs, weights
from distfilt.network.graphs import as_graph
from distfilt.network.weights import UnstableGain
from distfilt.sensors import component

Disconnected = network.Disconnected
RULES: dict[str, Callable[..., Any]] = {
    "average_consensus": lambda v, c: network.average_consensus(v, c, rounds=5),
    "gossip_consensus": lambda v, c: network.gossip_consensus(
        v, c, rounds=5, rng=np.random.default_rng(0)
    ),
    "pi_step": lambda v, c: _two_pi_steps(v, (c, c)),
    "covariance_intersection": lambda v, c: network.covariance_intersection(
        _gaussians(v), c, rounds=2
    ),
    "naive_fusion": lambda v, c: network.naive_fusion(_gaussians(v), c, rounds=2),
    "arithmetic_average": lambda v, c: network.arithmetic_average(
        _gaussians(v), c, rounds=2
    ),
    "consensus_pull": lambda v, c: network.consensus_pull(
        _gaussians(v), c, gain=0.1, rounds=2
    ),
    "mean_pull": lambda v, c: network.mean_pull(_ensembles(v), c, gain=0.1, rounds=2),
    "intersect_ensembles": lambda v, c: network.intersect_ensembles(
        _ensembles(v), c, rounds=2
    ),
    "event_triggered": lambda v, c: network.event_triggered(
        v, c, rounds=5, threshold=0.1
    ),
    "flooding": lambda v, c: network.flooding(v, c),
    "inverse_covariance_intersection": lambda v, c: (
        network.inverse_covariance_intersection(_gaussians(v), c, rounds=2)
    ),
    "ellipsoidal_intersection": lambda v, c: network.ellipsoidal_intersection(
        _gaussians(v), c, rounds=2
    ),
    "covariance_union": lambda v, c: network.covariance_union(
        _gaussians(v), c, rounds=2
    ),
    "diffuse_means": lambda v, c: network.diffuse_means(_gaussians(v), c, rounds=2),
}
"""Every rule that does not refuse a graph in parts."""


def _two_pi_steps(
    values: np.ndarray, channels: tuple[Channel, Channel]
) -> network.PIState:
    state = network.pi_start(values)
    for channel in channels:
        state = network.pi_step(state, values, channel, dt=0.1, alpha=1.0, a=1.0, b=1.0)
    return state


def _gaussians(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return values, np.ones((*values.shape, 1))


def _ensembles(values: np.ndarray) -> np.ndarray:
    return values[:, None] + np.array([[-1.0], [0.0], [1.5]])


def _user_weights(graph: Graph, matrix: np.ndarray) -> ConsensusWeights:
    links = matrix[graph.receivers, graph.senders]
    return ConsensusWeights(graph, matrix.diagonal(), links)


# --- weights ----------------------------------------------------------------------------------


def test_weights_whose_rows_do_not_sum_to_one_are_refused() -> None:
    """d_weights_push: with columns alone agents keep different shares of the sum, for ever."""
    star = graphs.star(4)
    values = np.array([[0.0], [4.0], [8.0], [1.0]])
    push = weights.column_stochastic(star)
    with pytest.raises(ValueError, match="^weights must have rows that sum to 1"):
        network.average_consensus(values, Channel(star), weights=push, rounds=500)
    # What they would have given: shares in proportion to the eigenvector of W.
    limit = np.linalg.matrix_power(push.matrix.toarray(), 500) @ values
    assert np.ptp(limit) > 2
    # And the columns, of row-stochastic weights.
    rows = _user_weights(star, push.matrix.toarray().T)
    with pytest.raises(ValueError, match="^weights must have columns that sum to 1"):
        network.average_consensus(values, Channel(star), weights=rows, rounds=500)


@pytest.mark.parametrize("agents", [6, 500])
def test_weights_that_diverge_or_swap_values_warn(agents: int) -> None:
    ring = graphs.ring(agents)
    laplacian = ring.laplacian.toarray()
    values = np.random.default_rng(0).standard_normal((agents, 1))
    cases = {
        # |1 - 1.2 · 4| = 3.8 a round
        "diverges": (np.eye(agents) - 1.2 * laplacian, True),
        # Each agent takes the mean of its neighbours: signs alternate on an even ring.
        "alternates": (0.5 * ring.links.toarray(), True),
        "converges": (np.eye(agents) - 0.4 * laplacian, False),
        "lazily": (np.eye(agents) - 0.01 * laplacian, False),
        "over-relaxed": (np.eye(agents) - 0.499 * laplacian, False),
    }
    for name, (matrix, is_wrong) in cases.items():
        w = _user_weights(ring, matrix)
        with warnings.catch_warnings(record=True, action="always") as caught:
            network.average_consensus(values, Channel(ring), weights=w, rounds=3)
        expected = [UnstableGain] if is_wrong else []
        assert [one.category for one in caught] == expected, name
        if agents == 6:
            # By the definition: the second largest modulus of the eigenvalues.
            moduli = np.sort(np.abs(np.linalg.eigvals(matrix)))
            largest = moduli[-1] if name == "diverges" else moduli[-2]
            assert w.convergence_factor == pytest.approx(largest, abs=1e-9)


def test_every_maker_of_weights_averages_without_a_warning() -> None:
    values = np.random.default_rng(1).standard_normal((6, 2))
    makers = (
        weights.metropolis,
        weights.best_constant_edge,
        weights.fastest_mixing,
        weights.expected_gossip,
        weights.doubly_stochastic,
    )
    for graph in (graphs.ring(6), graphs.star(6), graphs.grid(2, 3)):
        for make in makers:
            made = make(graph)
            for w in (made, _user_weights(graph, made.matrix.toarray())):
                with warnings.catch_warnings(action="error"):
                    result = network.average_consensus(
                        values, Channel(graph), weights=w, rounds=2000
                    )
                assert np.abs(result - values.mean(axis=0)).max() < 1e-6


def test_weights_of_which_a_bridge_is_missing_warn() -> None:
    """The graph is connected, the weights are not."""
    path = graphs.path(4)
    matrix = np.kron(np.eye(2), np.full((2, 2), 0.5))
    with pytest.warns(UnstableGain, match="^weights must have eigenvalues below 1"):
        network.average_consensus(
            np.arange(4.0)[:, None],
            Channel(path),
            weights=_user_weights(path, matrix),
            rounds=50,
        )


def test_substeps_of_an_estimator_that_diverges_warn() -> None:
    graph = graphs.complete(10)
    values = np.arange(10.0)[:, None]
    step = partial(network.pi_step, dt=1.0, alpha=0.2, a=1.0, b=0.1)
    state = network.pi_start(values)
    with pytest.warns(UnstableGain, match="^substeps must be more"):
        step(state, values, Channel(graph), substeps=2)
    # λ = 10 bounds a step by about 2 / (α + a λ), so that 6 of a second are stable.
    with warnings.catch_warnings(action="error"):
        for _ in range(300):
            state = step(state, values, Channel(graph), substeps=6)
    assert np.abs(state.estimate - 4.5).max() < 0.1


# --- graphs in parts --------------------------------------------------------------------------


def test_all_rules_are_here_or_refuse_a_graph_in_parts() -> None:
    """A new rule has to say that the graph is in parts too."""
    parts = Graph.from_edges(4, [(0, 1), (2, 3)])
    refusing = {
        "finite_time_consensus": network.finite_time_consensus,
        "max_consensus": network.max_consensus,
        "push_sum": partial(network.push_sum, rounds=3),
    }
    rules = {
        name
        for name in network.__all__
        if hasattr(getattr(network, name), "belief_kind")
    }
    # This one exchanges by another rule, which has to say so.
    delegating = {"information_consensus"}
    assert rules <= RULES.keys() | refusing.keys() | delegating
    with pytest.warns(Disconnected, match="got 2 components, each"):
        network.information_consensus(
            _gaussians(np.arange(4.0)[:, None]),
            Channel(parts),
            consensus=partial(network.average_consensus, rounds=2),
        )
    for rule in refusing.values():
        with pytest.raises(ValueError, match=r"must be \(strongly\) connected"):
            rule(np.arange(4.0)[:, None], Channel(parts))


@pytest.mark.parametrize("name", RULES)
def test_every_rule_says_that_the_graph_is_in_parts(name: str) -> None:
    rule = RULES[name]
    values = np.arange(4.0)[:, None]
    parts = Graph.from_edges(4, [(0, 1), (2, 3)])
    with pytest.warns(Disconnected, match="got 2 components, each") as caught:
        rule(values, Channel(parts))
    # At the line of the caller, once.
    assert [one.filename for one in caught] == [__file__]
    with warnings.catch_warnings(action="error"):
        rule(values, Channel(graphs.ring(4)))


@pytest.mark.parametrize("name", RULES)
def test_an_agent_that_is_always_silent_is_a_part_of_its_own(name: str) -> None:
    rule = RULES[name]
    values = np.arange(5.0)[:, None]
    # Without its hub a star has no links at all.
    channel = Channel(graphs.star(5), faults=Faults(silent=[0]))
    with pytest.warns(Disconnected, match=r"5 components with agents \[0\] silent"):
        rule(values, channel)
    # One that is silent for a while can be heard later.
    for faults in (Faults(silent=[0], during=[(0, 2)]), Faults(loss=0.3, seed=3)):
        with warnings.catch_warnings(action="error"):
            rule(values, Channel(graphs.star(5), faults=faults))


def test_a_single_round_says_nothing_since_graphs_change() -> None:
    parts = Channel(Graph.from_edges(4, [(0, 1), (2, 3)]))
    values = np.arange(4.0)[:, None]
    with warnings.catch_warnings(action="error"):
        network.average_consensus(values, parts)
        network.covariance_intersection(_gaussians(values), parts)
        network.mean_pull(_ensembles(values), parts, gain=0.1)


def test_steps_on_graphs_that_change_say_nothing_on_a_fixed_one_they_do() -> None:
    """Two graphs in parts, used in turn, lead every agent of a path to one average."""
    values = np.array([[0.0], [3.0], [1.0], [8.0]])
    pairs = [Graph.from_edges(4, [(0, 1), (2, 3)]), Graph.from_edges(4, [(1, 2)])]
    state = network.pi_start(values)
    with warnings.catch_warnings(action="error"):
        for k in range(500):
            channel = Channel(pairs[k % 2])
            state = network.pi_step(
                state, values, channel, dt=0.1, alpha=0.1, a=2.0, b=1.0
            )
    # (0 + 3 + 1 + 8) / 4 = 3; the averages of the first graph's parts are 1.5 and 4.5.
    assert np.abs(state.estimate - 3.0).max() < 0.15
    # New channels do not make a graph another one.
    with pytest.warns(Disconnected, match="got 2 components"):
        _two_pi_steps(values, (Channel(pairs[0]), Channel(pairs[0])))


# --- labels and directions --------------------------------------------------------------------


def test_labels_from_one_are_numbered_in_their_order() -> None:
    """d_graph_labels: node 1 has the neighbours 2 and 3, whatever the order of the edges."""
    g = nx.Graph([(3, 1), (1, 2), (2, 4)])
    walk = constant_velocity(sigma=0.1, axes=1)
    numbers = ["1", "2", "3", "4"]
    found = [
        Graph.from_networkx(g),
        Graph.from_networkx(g, names=[1, 2, 3, 4]),  # type: ignore[list-item]
        Graph.from_networkx(g, names=numbers),
        GaussianFilter(walk, [None] * 4, g).graph,
        GaussianFilter(walk, [None] * 4, g, names=numbers).graph,
    ]
    for graph in found:
        assert graph.neighbours(0) == (1, 2)
        assert graph.neighbours(3) == (1,)
    # Names in another order are other agents.
    turned = Graph.from_networkx(g, names=numbers[::-1])
    assert turned.neighbours(3) == (1, 2)


def test_numbers_with_gaps_numpy_numbers_and_places_on_a_grid() -> None:
    gaps = nx.Graph([(np.int64(30), np.int64(10)), (np.int64(10), np.int64(20))])
    assert Graph.from_networkx(gaps).neighbours(0) == (1, 2)
    places = nx.Graph()
    places.add_edges_from(reversed(list(nx.grid_2d_graph(2, 3).edges)))
    expected = graphs.grid(2, 3)
    assert (Graph.from_networkx(places).links != expected.links).nnz == 0
    # Strings have no order of their own: that of the graph.
    assert Graph.from_networkx(nx.path_graph(["z", "a", "m"])).neighbours(1) == (0, 2)


@pytest.mark.parametrize(
    "nodes", [["x", "y", "z"], [1, 2, 3], ["a", "b", "d"], ["a", "b", 7]]
)
def test_names_that_match_no_node_are_refused(nodes: list[Any]) -> None:
    g = nx.path_graph(nodes)
    walk = constant_velocity(sigma=0.1, axes=1)
    expected = r"^graph must have the nodes \['a', 'b', 'c'\], got"
    with pytest.raises(ValueError, match=expected):
        Graph.from_networkx(g, names=["a", "b", "c"])
    with pytest.raises(ValueError, match=expected):
        GaussianFilter(walk, [None] * 3, g, names=["a", "b", "c"])
    # The numbers 0 to A - 1 are agents by themselves.
    plain = GaussianFilter(walk, [None] * 3, nx.path_graph(3), names=["a", "b", "c"])
    assert plain.graph.neighbours(1) == (0, 2)


def test_a_digraph_its_adjacency_and_its_edges_are_the_same_graph() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        dense = (rng.random((6, 6)) < 0.4) & ~np.eye(6, dtype=bool)
        digraph = nx.DiGraph(dense.astype(int))
        matrix = nx.to_numpy_array(digraph)
        found = [
            Graph.from_networkx(digraph),
            Graph.from_adjacency(matrix, directed=True),
            Graph.from_adjacency(nx.to_scipy_sparse_array(digraph), directed=True),
            Graph.from_edges(6, list(digraph.edges) or np.zeros((0, 2)), directed=True),
            as_graph(digraph, 6),
        ]
        for graph in found:
            # Row i of the matrix marks the agents that agent i receives from.
            assert (graph.links.toarray() == dense).all()
        # And the way back.
        assert (nx.to_numpy_array(nx.DiGraph(found[0].links)) == dense).all()


# --- rounds with faults -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "faults",
    [
        Faults(loss=0.3, seed=2),
        Faults(loss=0.2, burst_length=5.0, seed=4, during=[(3, 40)]),
        Faults(loss=0.3, seed=7, burst_length=3.0, delay=2)
        | Faults(silent=[0], during=[(2, 9)]),
    ],
)
def test_many_rounds_at_once_are_single_rounds_one_after_the_other(
    faults: Faults,
) -> None:
    """To the bit, the ledger too: losses belong to a round and a link, not to a call."""
    graph = graphs.grid(3, 4)
    w = weights.metropolis(graph)
    values = np.random.default_rng(0).standard_normal((2, 12, 3))
    for on_loss in ("mutual", "metropolis", "keep", "renormalise", "zero"):
        many = Channel(graph, runs=(2,), faults=faults)
        single = Channel(graph, runs=(2,), faults=faults)
        together = many.mix(values, w, rounds=60, on_loss=on_loss)
        apart = values
        for _ in range(60):
            apart = single.mix(apart, w, on_loss=on_loss)
        assert (together == apart).all()
        for field in ("rounds", "messages", "scalars", "bytes", "lost"):
            of_many = np.asarray(getattr(many.ledger, field))
            assert (of_many == getattr(single.ledger, field)).all()


def test_losses_of_many_rounds_are_drawn_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Drawing them round by round made rounds with faults forty times as slow as without."""
    calls = []
    draw = Faults.draw_rounds

    def counted(self: Faults, graph: Graph, rounds: range, *args: Any) -> np.ndarray:
        calls.append(len(rounds))
        return draw(self, graph, rounds, *args)

    monkeypatch.setattr(Faults, "draw_rounds", counted)
    graph = graphs.ring(20)
    values = np.random.default_rng(0).standard_normal((20, 3))
    channel = Channel(graph, faults=Faults(loss=0.1))
    channel.mix(values, weights.metropolis(graph), rounds=400)
    assert sum(calls) == 400
    assert len(calls) <= 2


def test_numbers_as_text_are_in_their_order() -> None:
    """As nodes of a GML or GraphML file are."""
    graph = nx.Graph([("10", "9"), ("2", "10"), ("9", "1")])
    assert as_graph(graph).neighbours(3) == (1, 2)
    words = nx.Graph([("b", "a"), ("a", "c")])
    assert as_graph(words).neighbours(1) == (0, 2)


def test_edges_between_names() -> None:
    walk = constant_velocity(sigma=0.1, axes=1)
    eyes = [component([0], std=1.0), None, None]
    f = GaussianFilter(walk, eyes, [("a", "c")], names=("a", "b", "c"))
    start = f.start(([0.0, 0.0], np.eye(2)))
    state = f.step(start, 0.0, [[1.0], None, None])
    # With P = R = 1 the gain is one half; the agent without a link learns nothing.
    assert np.allclose(state.means[:, 0], [0.5, 0.0, 0.5])
    with pytest.raises(ValueError, match=r"agents \['a', 'b', 'c'\], got 'd'"):
        GaussianFilter(walk, eyes, [("a", "d")], names=("a", "b", "c"))
    with pytest.raises(ValueError, match=r"between the agents \[\], got 'a'"):
        as_graph([("a", "b")], 3)


def test_diffusion_needs_rows_that_sum_to_one() -> None:
    pair = graphs.complete(2)
    belief = (np.array([[1.0], [1.0]]), np.ones((2, 1, 1)))
    wrong = ConsensusWeights(pair, [0.5, 0.5], [0.6, 0.6])
    with pytest.raises(ValueError, match="rows that sum to 1 .* got 1.1 for agent 0"):
        network.diffuse_means(belief, Channel(pair), weights=wrong)
    # Rows alone suffice: agents that agree stay as they are.
    rows = ConsensusWeights(pair, [0.9, 0.5], [0.1, 0.5])
    means, _ = network.diffuse_means(belief, Channel(pair), weights=rows)
    assert np.allclose(means, 1.0)
    other = weights.metropolis(graphs.path(3))
    with pytest.raises(ValueError, match="weights must"):
        network.diffuse_means(belief, Channel(pair), weights=other)


def test_diffusion_of_angles_keeps_the_weight_of_a_lost_mean() -> None:
    channel = Channel(graphs.complete(2))
    channel.periods = (2 * np.pi,)
    belief = (np.array([[3.1], [-3.1]]), np.ones((2, 1, 1)))
    with pytest.raises(ValueError, match="on_loss must be 'keep' for circular"):
        network.diffuse_means(belief, channel, on_loss="renormalise")


def test_weights_of_single_precision_say_by_how_much() -> None:
    pair = graphs.complete(2)
    single = ConsensusWeights(pair, np.float32([0.9, 0.9]), np.float32([0.1, 0.1]))
    with pytest.raises(ValueError, match=r"got one that is 2\.\de-08 off"):
        network.average_consensus(np.ones((2, 1)), Channel(pair), weights=single)


@pytest.mark.parametrize("coupling", [0.2, 0.6])
def test_belief_propagation_in_circles(coupling: float) -> None:
    """J = 1 + c off the diagonal: the rounds converge for c = .2, and not for .6."""
    graph = graphs.complete(3)
    h = np.array([1.0, 2.0, 3.0])
    couplings = np.full((6, 1, 1), coupling)
    matrix = coupling * np.ones((3, 3)) + (1 - coupling) * np.eye(3)

    def run(rounds: int) -> np.ndarray:
        means, _ = network.gaussian_belief_propagation(
            np.ones((3, 1, 1)), h[:, None], couplings, Channel(graph), rounds=rounds
        )
        return means.ravel()

    with pytest.warns(RuntimeWarning, match="enough for the means to converge"):
        run(1)
    if coupling < 0.5:
        with warnings.catch_warnings(action="error"):
            assert np.allclose(run(40), np.linalg.solve(matrix, h))
    else:
        with pytest.warns(RuntimeWarning, match="not converge"):
            run(60)
