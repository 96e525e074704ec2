"""Averages, the maximum, and the minimiser of a sum: properties, speed and cost."""

from __future__ import annotations

import warnings
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt import network
from distfilt.linalg import SolverError
from distfilt.network import (
    Channel,
    Disconnected,
    Faults,
    Graph,
    UnstableGain,
    graphs,
    weights,
)
from distfilt.network.consensus import _drop_repeated
from tests.network.helpers import (
    DISK,
    GRID,
    STAR,
    UNLINKED,
    each_graph,
    lossy,
    random_graph,
    rng,
    star,
)

# Averaging and its warnings.


@given(st.integers(0, 1000), st.integers(2, 7), st.floats(0.01, 1.5))
def test_averaging_is_steps_against_the_laplacian(
    seed: int, agents: int, gain: float
) -> None:
    """x <- x - γ L x, also with gains that are too large and on graphs of several components."""
    graph = random_graph(seed, agents)
    values = rng(seed).standard_normal((agents, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        averaged = network.average_consensus(
            values, Channel(graph), gain=gain, rounds=3
        )
    expected = values
    for _ in range(3):
        expected = expected - gain * graph.laplacian.toarray() @ expected
    # An unstable gain makes values grow: errors are relative to the largest one.
    scale = max(1.0, np.abs(averaged).max())
    assert np.abs(averaged - expected).max() < 1e-12 * scale


def test_a_gain_beyond_the_bound_warns_once_with_both_numbers() -> None:
    """The bound 0 < γ < 1 that is printed elsewhere is wrong: 0.7 diverges on a star of three."""
    values = np.array([[0.0], [3.0], [-1.5]])
    text = r"^gain must be at most 2/λ_max = 0\.666667.* got 0\.7"
    with pytest.warns(UnstableGain, match=text) as caught:
        averaged = network.average_consensus(values, star(), gain=0.7, rounds=200)
    # One warning for all 200 rounds, at the line of the caller.
    assert len(caught) == 1
    assert caught[0].filename == __file__
    # λ_max = 3: the mode of this eigenvalue grows by |1 - 0.7 · 3| = 1.1 a round.
    assert np.abs(averaged - values.mean()).max() > 100


@pytest.mark.parametrize(
    "graph", [graphs.path(5), graphs.disk(rng(2).random((250, 2)), 0.15)]
)
def test_the_warning_s_edge_and_its_cost(graph: Graph) -> None:
    """No eigenvalue is computed for a gain below the bound from degrees."""
    values = np.zeros((graph.n_agents, 1))
    average = partial(network.average_consensus, values, Channel(graph))
    average(gain=0.99 * graph.degree_bound_gain)
    # The bound from degrees is at most 2/λ_max and needs no spectrum.
    assert "max_stable_gain" not in vars(graph)
    assert "laplacian_spectrum" not in vars(graph)
    # The exact edge is 2/λ_max: no warning just below it, one just above.
    average(gain=graph.max_stable_gain * (1 - 1e-6))
    with pytest.warns(UnstableGain):
        average(gain=graph.max_stable_gain * (1 + 1e-6))


@pytest.mark.parametrize("on_loss", ["mutual", "metropolis"])
@given(st.integers(0, 500), st.floats(0, 1))
def test_mutual_rules_keep_the_average_under_loss(
    on_loss: str, seed: int, loss: float
) -> None:
    values = rng(seed).standard_normal((2, DISK.n_agents, 2))
    channel = Channel(DISK, runs=(2,), faults=Faults(loss=loss, seed=seed))
    averaged = network.average_consensus(values, channel, rounds=5, on_loss=on_loss)
    # Both ends of a link use it or neither does, so that the weights stay symmetric:
    # 1ᵀ W = 1ᵀ.
    error = averaged.mean(axis=-2) - values.mean(axis=-2)
    assert np.abs(error).max() < 1e-12
    # With few losses the values come closer, too.
    if loss <= 0.5:
        range_before = np.ptp(values, axis=-2)
        range_after = np.ptp(averaged, axis=-2)
        assert (range_after < range_before).all()


def test_averaging_on_a_disconnected_graph_warns() -> None:
    """Each component reaches its own average. One round gives no warning, as graphs may change."""
    graph = Graph.from_adjacency([[0, 1, 0], [1, 0, 0], [0, 0, 0]])
    values = np.array([[0.0], [2.0], [7.0]])
    with pytest.warns(Disconnected, match="got 2 components") as caught:
        averaged = network.average_consensus(values, Channel(graph), rounds=60)
    # (0 + 2) / 2 = 1 for the pair; the single agent keeps its 7.
    assert np.allclose(averaged, [[1.0], [1.0], [7.0]])
    assert len(caught) == 1
    assert caught[0].filename == __file__
    network.average_consensus(values, Channel(graph))


# The exact average in finite time.


@each_graph
def test_finite_time_is_exact(graph: Graph) -> None:
    values = rng(4).standard_normal((2, graph.n_agents, 2))
    channel = Channel(graph, runs=(2,))
    averaged = network.finite_time_consensus(values, channel)
    mean = values.mean(axis=-2, keepdims=True)
    error = np.abs(averaged - mean).max()
    # The disk graph has thirty different eigenvalues, which cost digits.
    assert error < (1e-9 if graph is DISK else 1e-12)
    # Π (I - L/λ) over the distinct eigenvalues λ > 0 removes every mode but the mean:
    # one round for each of them.
    distinct = np.unique(graph.laplacian_spectrum.round(9))
    assert channel.ledger.rounds == len(distinct) - 1


def test_finite_time_on_many_eigenvalues_needs_leja_s_order() -> None:
    """On a row of forty: ascending and descending orders fail there."""
    values = rng(4).standard_normal((40, 1))
    averaged = network.finite_time_consensus(values, Channel(graphs.path(40)))
    assert np.abs(averaged - values.mean()).max() < 1e-9


def test_finite_time_needs_every_message() -> None:
    # A loss leaves a factor I - L/λ incomplete; without links nothing is averaged.
    cases = (
        (lossy(), "channel must have no faults"),
        (Channel(UNLINKED), "connected"),
    )
    for channel, text in cases:
        with pytest.raises(ValueError, match=text):
            network.finite_time_consensus(np.zeros((3, 1)), channel)


@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_eigenvalues_count_once_at_any_scale(scale: float) -> None:
    values = scale * np.array([1.0, 1.0 + 1e-12, 2.0, 3.0, 3.0])
    # Copies differ by 1e-12 of the value, which is rounding; 1e-6 is a difference.
    expected = scale * np.array([1.0, 2.0, 3.0])
    assert np.allclose(_drop_repeated(values), expected)
    assert _drop_repeated(np.array([1.0, 1.0 + 1e-6])).size == 2


# Push-sum and digraphs.


@each_graph
@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_push_sum_reaches_the_average_through_heavy_loss(
    graph: Graph, loss: float
) -> None:
    values = 2.16 + rng(2).standard_normal((graph.n_agents, 1))
    channel = lossy(loss, graph)
    averaged = network.push_sum(values, channel, rounds=900)
    # Running sums: the next message that arrives makes up for the lost ones.
    assert np.abs(averaged - values.mean()).max() < 1e-10
    # Value and weight on each link and round.
    assert (channel.ledger.scalars == 2 * 900 * graph.out_degree).all()


@pytest.mark.parametrize(
    ("rounds", "vanished"),
    [
        (60, []),
        (300, [0, 2, 3, 4]),
        (700, [0, 1, 2, 3, 4]),
        (1500, [0, 1, 2, 3, 4]),
    ],
)
def test_push_sum_names_agents_whose_weights_vanish(
    rounds: int, vanished: list[int]
) -> None:
    values = np.array([[0.0], [3.0], [6.0], [9.0], [12.0]])
    channel = Channel(graphs.ring(5), faults=Faults(silent=[1]))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        ratios = network.push_sum(values, channel, rounds=rounds).ravel()
    # The silent agent keeps its value. The others agree on a weighted mean of theirs, which has
    # converged after 60 rounds, long before rounding reaches it.
    assert abs(ratios[1] - 3.0) < 1e-12
    assert np.abs(ratios[[0, 2, 3, 4]] - 7.635255).max() < 1e-5
    messages = [str(warning.message) for warning in caught]
    assert {warning.category for warning in caught} == {Disconnected}
    assert "agents [1] silent" in messages[0]
    if vanished:
        assert f"weights of agents {vanished} that vanish in rounding" in messages[1]
    assert len(messages) == 1 + bool(vanished)


def test_push_sum_recovers_after_a_long_silence() -> None:
    values = np.array([[0.0], [3.0], [6.0], [9.0], [12.0]])
    faults = Faults(silent=[1], during=[(5, 800)])
    with warnings.catch_warnings(action="error"):
        ratios = network.push_sum(
            values, Channel(graphs.ring(5), faults=faults), rounds=1000
        )
    # The running sums that arrive after the silence bring everything that was pushed in vain.
    assert np.abs(ratios - 6.0).max() < 1e-9


def test_averages_on_a_digraph() -> None:
    edges = [(1, 0), (2, 1), (3, 2), (0, 3), (2, 0)]
    graph = Graph.from_edges(4, edges, directed=True)
    values = rng(2).standard_normal((5, 4, 2))
    doubly_stochastic = weights.doubly_stochastic(graph)
    average = partial(network.average_consensus, weights=doubly_stochastic)
    mean = values.mean(axis=1, keepdims=True)
    # Push-sum needs columns that sum to one; plain averaging needs rows, too.
    for rule in (network.push_sum, average):
        averaged = rule(values, Channel(graph, runs=(5,)), rounds=400)
        error = np.abs(averaged - mean).max()
        assert error < 1e-12


@each_graph
def test_the_maximum_needs_the_diameter(graph: Graph) -> None:
    values = rng(4).standard_normal((graph.n_agents, 2))
    channel = Channel(graph)
    largest = values.max(axis=0)
    # A value travels one hop a round, and the farthest agent is a diameter away.
    assert (network.max_consensus(values, channel) == largest).all()
    assert channel.ledger.rounds == graph.diameter
    # Losses cost time alone.
    rounds = 20 * graph.diameter
    late = network.max_consensus(values, lossy(0.5, graph), rounds=rounds)
    assert (late == largest).all()


# ADMM on a sum of quadratics |u - c_l|² / 2, which the mean of the c_l minimises.

_CENTRES = np.array([[1.0, 4.0], [2.0, -1.0], [6.0, 0.0]])
_ZERO = np.zeros((3, 2))


def _local_solve(target: np.ndarray, rho: float) -> np.ndarray:
    # argmin_u |u - c|² / 2 + ρ |u - target|² / 2
    return (_CENTRES + rho * target) / (1 + rho)


def _residuals(rho: float, iterations: int) -> list[tuple[float, float]]:
    """Return residuals of every iteration from the printed formulas, with an exact average."""
    z = _ZERO
    w = _ZERO
    residuals = []
    for _ in range(iterations):
        # u_l = argmin f_l + ρ/2 |u - z + w_l|², z⁺ = mean(u + w), w⁺ = w + u - z⁺
        u = _local_solve(z - w, rho)
        new = _ZERO + (u + w).mean(axis=0)
        w = w + u - new
        # Primal residual u - z⁺, dual residual ρ (z⁺ - z).
        primal = float(np.abs(u - new).max())
        dual = float(rho * np.abs(new - z).max())
        residuals.append((primal, dual))
        z = new
    return residuals


@pytest.mark.parametrize("rho", [0.05, 0.3, 1.0, 8.0])
def test_admm_stops_once_both_residuals_are_below_the_tolerance(rho: float) -> None:
    """Both residuals, the dual one with its ρ: each is the last to fall for some ρ.

    The decision is paid for: rounds of averaging, and of the maximum of two numbers,
    which take the diameter each.
    """
    series = _residuals(rho, 600)
    tolerance = 1e-4
    below = [max(pair) < tolerance for pair in series]
    first = below.index(True) + 1
    channel = star()
    result = network.admm(_local_solve, _ZERO, channel, rho=rho, tolerance=tolerance)
    assert result.iterations == first
    residuals = (result.primal, result.dual)
    assert np.allclose(residuals, series[first - 1], rtol=1e-6, atol=1e-12)
    # The minimiser of the sum is the mean of the centres.
    minimiser = _CENTRES.mean(axis=0)
    assert np.abs(result.common - minimiser).max() < 1e-3
    # Two rounds for the average of 2 numbers and two for the maximum of 2, in each
    # iteration.
    assert channel.ledger.rounds == 2 * first + 2 * first
    scalars = 2 * 2 * first + 2 * 2 * first
    assert (channel.ledger.scalars == scalars * STAR.out_degree).all()


def test_admm_reports_residuals_and_needs_every_message() -> None:
    # Two iterations are too few for the tolerance: the error names both residuals.
    primal, dual = _residuals(1.0, 2)[-1]
    text = f"{primal:.3g} and {dual:.3g} after 2 iterations"
    with pytest.raises(SolverError, match=text):
        network.admm(_local_solve, _ZERO, star(), iterations=2)
    with pytest.raises(ValueError, match="channel must have no faults"):
        average = network.average_consensus
        network.admm(_local_solve, _ZERO, lossy(), average=average)


def test_user_functions_of_admm_call_the_library_with_checks() -> None:
    """A wrong argument of a nested call is refused, although the outer call is checked."""

    def average(values: np.ndarray, channel: Channel) -> np.ndarray:
        return network.average_consensus(values, channel, gain=-1.0)

    with pytest.raises(ValueError, match="^gain must be positive, got -1.0"):
        network.admm(_local_solve, _ZERO, star(), average=average)


# Symmetries of all rules that need no random numbers.

RULES = {
    "average": partial(network.average_consensus, rounds=3),
    "push-sum": partial(network.push_sum, rounds=3),
    "maximum": partial(network.max_consensus, rounds=2),
    "events": partial(network.event_triggered, rounds=4, threshold=0.5),
    "flooding": lambda values, channel: network.flooding(values, channel, rounds=2)[0],
    "finite time": network.finite_time_consensus,
}


@pytest.mark.parametrize("name", RULES)
def test_the_agents_order_does_not_matter(name: str) -> None:
    """With other numbers the same agents reach the same values and send as much."""
    values = rng(1).standard_normal((GRID.n_agents, 2))
    order = rng(2).permutation(GRID.n_agents)
    # P L Pᵀ for a permutation P: rules commute with renumbering.
    links = GRID.links.toarray()
    permuted = Graph.from_adjacency(links[np.ix_(order, order)])
    channel = Channel(GRID)
    other = Channel(permuted)
    result = RULES[name](values, channel)
    other_result = RULES[name](values[order], other)
    assert np.abs(result[order] - other_result).max() < 1e-9
    assert (channel.ledger.scalars[order] == other.ledger.scalars).all()


@pytest.mark.parametrize("name", RULES)
def test_units_do_not_matter(name: str) -> None:
    """Rules are homogeneous; a threshold is scaled with the values."""
    values = rng(1).standard_normal((GRID.n_agents, 2))
    result = RULES[name](values, Channel(GRID))
    options = {"threshold": 0.5e5} if name == "events" else {}
    scaled = RULES[name](1e5 * values, Channel(GRID), **options)
    tolerance = 1e-9 if name == "finite time" else 1e-12
    assert np.allclose(scaled, 1e5 * result, rtol=tolerance)
