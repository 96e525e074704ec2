"""Rules on a digraph, with losses, several runs and full matrices, against plain numpy.

In a symmetric example a transpose, a swapped receiver or the data of the first run make no
difference. Here each agent, run and component is different. Source: own.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import network
from distfilt.gaussians import intersect_gaussians, intersection_weights
from distfilt.network import Channel, Faults, Graph, Ledger, graphs
from distfilt.network import weights as weighting
from tests.network.helpers import arrivals, gaussians, rng

Array = np.ndarray
RUNS = (2,)
# Strongly connected; agent 1 hears three others, agent 0 is heard by two.
DIGRAPH = Graph.from_edges(
    4, [(0, 3), (1, 0), (1, 2), (1, 3), (2, 0), (3, 1), (3, 2)], directed=True
)
TREE = Graph.from_edges(5, [(0, 2), (1, 2), (2, 4), (4, 3)])
RING = graphs.ring(5)
GRID = graphs.grid(3, 3)
FAULTS = Faults(loss=0.35, seed=4)
ORDER = [2, 0, 3, 1]


def channel_of(
    graph: Graph, *, runs: tuple[int, ...] = RUNS, lossy: bool = True
) -> Any:
    return Channel(graph, runs=runs, faults=FAULTS if lossy else None)


def permuted(graph: Graph, order: list[int]) -> Graph:
    links = graph.links.toarray()[np.ix_(order, order)]
    return Graph.from_adjacency(links, directed=True)


def sources_of(agent: int, arrived: Array) -> list[int]:
    """Return the agent itself and the senders whose message arrived."""
    return [agent, *np.flatnonzero(arrived[agent]).tolist()]


def information_sum(means: Array, covs: Array, weights: Array) -> tuple[Array, Array]:
    """Return P = (Σ ω_j P_j⁻¹)⁻¹ and m = P Σ ω_j P_j⁻¹ m_j."""
    precisions = weights[:, None, None] * np.linalg.inv(covs)
    vectors = (precisions @ means[..., None])[..., 0]
    cov = np.linalg.inv(precisions.sum(axis=0))
    mean = cov @ vectors.sum(axis=0)
    return mean, cov


def shares(sizes: Array) -> Array:
    return sizes / sizes.sum()


def intersect(means: Array, covs: Array, rule: str) -> tuple[Array, Array]:
    """Intersect the Gaussians of one agent with the weights of a rule."""
    n, d = means.shape
    if rule.startswith("min"):
        weights = intersection_weights(covs, rule=rule)
        return intersect_gaussians(means, covs, weights)
    # Weights are proportional to these.
    sizes = {
        "equal": np.ones(n),
        "trace": 1 / np.trace(covs, axis1=1, axis2=2),
        "determinant": np.linalg.det(covs) ** (-1 / d),
    }
    return information_sum(means, covs, shares(sizes[rule]))


def add(means: Array, covs: Array) -> tuple[Array, Array]:
    return information_sum(means, covs, np.ones(len(means)))


def average(means: Array, covs: Array) -> tuple[Array, Array]:
    # The moments of a mixture with equal weights: P is the mean of P_j + (m_j - m)(m_j - m)ᵀ
    mean = means.mean(axis=0)
    spread = np.cov(means.T, bias=True)
    return mean, covs.mean(axis=0) + spread


RULES = ("equal", "trace", "determinant", "min_trace", "min_determinant")
FUSIONS: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    rule: (
        partial(network.covariance_intersection, rule=rule),
        partial(intersect, rule=rule),
    )
    for rule in RULES
} | {
    "naive": (network.naive_fusion, add),
    "average": (network.arithmetic_average, average),
}


@pytest.mark.parametrize("name", FUSIONS)
def test_each_agent_fuses_what_arrives_in_its_run(name: str) -> None:
    rule, plain = FUSIONS[name]
    means, covs = gaussians(1, *RUNS, 4, d=3)
    channel = channel_of(DIGRAPH)
    new_means, new_covs = rule((means, covs), channel, rounds=2)
    for round_ in range(2):
        arrived = arrivals(FAULTS, DIGRAPH, round_, runs=2)
        # All agents send what they had before the round.
        old_means = means.copy()
        old_covs = covs.copy()
        for run, agent in np.ndindex(2, 4):
            sources = sources_of(agent, arrived[run])
            fused = plain(old_means[run, sources], old_covs[run, sources])
            means[run, agent], covs[run, agent] = fused
    # In units of the standard deviations
    scale = np.sqrt(np.diagonal(covs, axis1=-2, axis2=-1))
    assert np.allclose(new_means / scale, means / scale, atol=1e-5)
    relative = scale[..., :, None] * scale[..., None, :]
    assert np.allclose(new_covs / relative, covs / relative, atol=1e-5)
    # Both rounds lose messages, and other ones in each run.
    arrived = arrivals(FAULTS, DIGRAPH, 0, runs=2)
    assert (arrived[0] != arrived[1]).any()


@pytest.mark.parametrize("include_self", [True, False])
def test_a_pull_by_what_arrives(include_self: bool) -> None:
    """The spread shrinks by the messages that arrived, not by those that were sent."""
    x = rng(2).standard_normal((*RUNS, 4, 6, 3))
    gain = 0.13
    new = network.mean_pull(
        x, channel_of(DIGRAPH), gain=gain, include_self=include_self
    )
    arrived = arrivals(FAULTS, DIGRAPH, runs=2)
    for run, agent in np.ndindex(2, 4):
        own_mean = x[run, agent].mean(axis=0)
        others = x[run, np.flatnonzero(arrived[run, agent])].mean(axis=1)
        # m + γ Σ_j (m_j - m), and deviations times 1 - γ times the number of terms
        mean = own_mean + gain * (others - own_mean).sum(axis=0)
        factor = 1 - gain * (len(others) + include_self)
        expected = mean + factor * (x[run, agent] - own_mean)
        assert np.allclose(new[run, agent], expected, atol=1e-12)


def circular(graph: Graph, periods: tuple[float | None, ...]) -> Any:
    channel = channel_of(graph)
    channel.periods = periods
    return channel


@pytest.mark.parametrize(
    "rule",
    [
        partial(network.consensus_pull, gain=0.2, rounds=2),
        partial(network.diffuse_means, rounds=2),
        network.covariance_intersection,
        network.arithmetic_average,
        network.ellipsoidal_intersection,
        network.information_consensus,
    ],
)
def test_angles_far_from_the_cut_are_numbers_also_with_losses(rule: Any) -> None:
    """And whole turns of some agents change angles by whole turns alone."""
    means, covs = gaussians(3, *RUNS, 5, d=3)
    means *= 0.1
    period = 2.0
    # All means lie within a tenth of the period, so that plain numbers are right.
    plain = rule((means, covs), channel_of(RING))
    turned = means.copy()
    turned[..., 1] += period * np.array([0, 1, 0, -2, 3])
    for start in (means, turned):
        new = rule((start, covs), circular(RING, (None, period, None)))
        difference = new[0] - plain[0]
        difference[..., 1] -= period * np.round(difference[..., 1] / period)
        assert np.allclose(difference, 0.0, atol=1e-9)
        assert np.allclose(new[1], plain[1], rtol=1e-9)


def test_a_mean_pull_of_angles_loses_messages_too() -> None:
    x = 0.1 * rng(2).standard_normal((*RUNS, 5, 6, 3))
    pull = partial(network.mean_pull, gain=0.13, rounds=2)
    expected = pull(x, channel_of(RING))
    assert np.allclose(pull(x, circular(RING, (None, 7.0, None))), expected)


@pytest.mark.parametrize("on_loss", ["mutual", "metropolis", "keep", "renormalise"])
def test_diffusion_puts_the_weight_of_a_lost_mean_where_it_is_told(
    on_loss: Any,
) -> None:
    means, covs = gaussians(3, *RUNS, 9, d=3)
    channel = channel_of(GRID)
    new, _ = network.diffuse_means((means, covs), channel, on_loss=on_loss)
    arrived = arrivals(FAULTS, GRID, runs=2)
    if on_loss in ("mutual", "metropolis"):
        # A lost message cancels its answer.
        arrived &= arrived.mT
    full = weighting.metropolis(GRID).matrix.toarray()
    weights = np.where(arrived, full, 0.0)
    if on_loss == "metropolis":
        degree = arrived.sum(axis=-1)
        larger = np.maximum(degree[..., :, None], degree[..., None, :])
        weights = arrived / (1 + larger)
    # The agent's own mean has the rest, or its usual share of what has come.
    self_weights = 1 - weights.sum(axis=-1)
    if on_loss == "renormalise":
        total = full.diagonal() + weights.sum(axis=-1)
        weights = weights / total[..., None]
        self_weights = full.diagonal() / total
    expected = weights @ means + self_weights[..., None] * means
    assert np.allclose(new, expected, atol=1e-12)


@pytest.mark.parametrize("has_constant", [True, False])
@pytest.mark.parametrize("rule", RULES)
def test_a_scale_is_that_of_divided_components(rule: Any, has_constant: bool) -> None:
    """Members in other units by hand, with an angle, and with a component that all know."""
    x = rng(5).standard_normal((*RUNS, 5, 9, 3)) * [3.0, 0.2, 1.0]
    if has_constant:
        x[..., 2] = 4.0
    scale = np.array([10.0, 0.3, 2.0])
    fuse = partial(network.intersect_ensembles, rule=rule)
    # The period of 0.9 is one of 3 in units of 0.3.
    scaled = fuse(x, circular(RING, (None, 0.9, None)), scale=scale)
    divided = fuse(x / scale, circular(RING, (None, 3.0, None)))
    assert np.allclose(scaled, divided * scale, atol=1e-9)


def test_rounds_of_split_intersection_know_of_the_first() -> None:
    """After a round all of a covariance depends on the others."""
    means, dependent = gaussians(6, *RUNS, 5, d=3)
    independent = gaussians(7, *RUNS, 5, d=3)[1]
    fuse = network.split_covariance_intersection
    two = fuse((means, dependent, independent), channel_of(RING), rounds=2)
    channel = channel_of(RING)
    m, first, second = fuse((means, dependent, independent), channel)
    # The second round is on the same channel, whose losses go on.
    expected = fuse((m, first + second, 0 * second), channel)
    for new, old in zip(two, expected, strict=True):
        assert np.allclose(new, old, rtol=1e-9)


VECTOR_RULES: dict[str, tuple[Graph, Callable[..., Any]]] = {
    "average": (RING, partial(network.average_consensus, rounds=3)),
    "keep": (DIGRAPH, lambda v, c: c.mix(v, digraph_weights(c.graph), on_loss="keep")),
    "max": (DIGRAPH, partial(network.max_consensus, rounds=2)),
    "push": (DIGRAPH, partial(network.push_sum, rounds=3)),
    "pull": (
        DIGRAPH,
        lambda v, c: network.mean_pull(v[..., None, :] + MEMBERS, c, gain=0.1),
    ),
    "gossip": (
        RING,
        lambda v, c: network.gossip_consensus(v, c, rounds=9, rng=rng(0)),
    ),
    "estimator": (
        RING,
        lambda v, c: (
            network.pi_step(
                network.pi_start(v**2),
                v,
                c,
                dt=0.3,
                alpha=0.4,
                a=0.5,
                b=0.3,
                rate=0.1 * v,
                substeps=4,
            ).estimate
        ),
    ),
}
MEMBERS = rng(9).standard_normal((5, 3))


def digraph_weights(graph: Graph) -> Any:
    return weighting.doubly_stochastic(graph)


@pytest.mark.filterwarnings("ignore:channel must have a connected graph")
@pytest.mark.parametrize("name", VECTOR_RULES)
def test_a_run_of_a_batch_is_the_run_alone_with_its_losses(name: str) -> None:
    graph, rule = VECTOR_RULES[name]
    n = graph.n_agents
    values = rng(1).standard_normal((*RUNS, n, 3))
    batch = channel_of(graph)
    together = rule(values, batch)
    lost = []
    for run in range(2):
        of_run = channel_of(graph).for_run(np.array(run), Ledger.empty(n))
        assert np.allclose(together[run], rule(values[run], of_run), atol=1e-12)
        lost.append(of_run.ledger.lost)
    assert np.allclose(batch.ledger.lost, np.mean(lost, axis=0))
    assert not np.array_equal(*lost)


@pytest.mark.parametrize("name", [n for n in VECTOR_RULES if n != "gossip"])
def test_the_numbers_of_agents_are_names_to_rules(name: str) -> None:
    graph, rule = VECTOR_RULES[name]
    n = graph.n_agents
    order = [2, 0, 3, 1, 4][:n] if n == 5 else ORDER
    values = rng(1).standard_normal((*RUNS, n, 3))
    first = channel_of(graph, lossy=False)
    second = channel_of(permuted(graph, order), lossy=False)
    expected = rule(values, first)[:, order]
    assert np.allclose(rule(values[:, order], second), expected, atol=1e-9)
    assert np.array_equal(first.ledger.scalars[order], second.ledger.scalars)


def test_pushed_sums_are_ratios_of_powers() -> None:
    """Agent j splits its mass in 1 + d_j parts, where d_j agents hear it: W^k x / W^k 1."""
    adjacency = DIGRAPH.links.toarray()
    w = (adjacency + np.eye(4)) / (1 + adjacency.sum(axis=0))
    values = rng(3).standard_normal((4, 2))
    power = np.linalg.matrix_power(w, 3)
    expected = power @ values / power.sum(axis=1, keepdims=True)
    new = network.push_sum(values, Channel(DIGRAPH), rounds=3)
    assert np.allclose(new, expected, atol=1e-12)
    weights = weighting.column_stochastic(DIGRAPH).matrix.toarray()
    assert np.allclose(weights, w, atol=1e-15)


def test_weights_of_a_digraph_keep_averages_and_agreement() -> None:
    matrix = weighting.doubly_stochastic(DIGRAPH).matrix.toarray()
    assert np.allclose(matrix.sum(axis=0), 1.0)
    assert np.allclose(matrix.sum(axis=1), 1.0)
    # Weights are on the links alone.
    off_diagonal = matrix - np.diag(matrix.diagonal())
    assert np.array_equal(off_diagonal != 0, DIGRAPH.links.toarray() != 0)
    # The agent that moves most keeps half of its value.
    assert np.isclose(matrix.diagonal().min(), 0.5)


def test_expected_gossip_is_the_mean_of_its_rounds() -> None:
    """Agent i wakes with probability 1 / A, and averages with one of its neighbours."""
    n = TREE.n_agents
    expected = np.zeros((n, n))
    for i in range(n):
        neighbours = TREE.neighbours(i)
        for j in neighbours:
            # I - ½ (e_i - e_j)(e_i - e_j)ᵀ replaces both values by their mean.
            difference = np.eye(n)[i] - np.eye(n)[j]
            mixing = np.eye(n) - 0.5 * np.outer(difference, difference)
            expected += mixing / (n * len(neighbours))
    matrix = weighting.expected_gossip(TREE).matrix.toarray()
    assert np.allclose(matrix, expected)


def test_the_stable_gain_of_a_digraph_is_where_agreement_ends() -> None:
    graph = Graph.from_edges(
        5, [(0, 1), (1, 2), (2, 0), (3, 2), (2, 3), (4, 3), (0, 4)], directed=True
    )
    laplacian = graph.laplacian.toarray()
    for gain, agrees in ((0.999, True), (1.001, False)):
        mixing = np.eye(5) - gain * graph.max_stable_gain * laplacian
        sizes = np.sort(np.abs(np.linalg.eigvals(mixing)))
        # The eigenvalue of agreement is 1, and all others have to be smaller.
        is_stable = sizes[-2] < 1 and np.isclose(sizes[-1], 1)
        assert is_stable == agrees
    assert np.isclose(DIGRAPH.degree_bound_gain, 1 / 3)
    assert np.array_equal(graph.hops(0), [0, 2, 1, 2, 3])


def test_losses_belong_to_a_receiver_or_to_a_link() -> None:
    by_receiver = arrivals(Faults(loss=[0.0, 1.0, 0.0, 0.0]), DIGRAPH)[0]
    is_lost = ~by_receiver[DIGRAPH.receivers, DIGRAPH.senders]
    # All links to agent 1, and no others
    assert np.array_equal(is_lost, DIGRAPH.receivers == 1)
    # A matrix has the receiver first: from agent 2 to agent 3
    matrix = np.zeros((4, 4))
    matrix[3, 2] = 1.0
    by_link = arrivals(Faults(loss=matrix), DIGRAPH)[0]
    missing = DIGRAPH.links.toarray().astype(bool) & ~by_link
    assert np.argwhere(missing).tolist() == [[3, 2]]


def test_windows_begin_at_their_start_and_end_before_their_stop() -> None:
    faults = Faults(loss=1.0, during=[(1, 3), (4, 5)])
    lost = faults.draw_rounds(DIGRAPH, range(6), 1)[:, 0]
    assert lost.all(axis=1).tolist() == [False, True, True, False, True, False]
    assert not lost[[0, 3, 5]].any()
    # With a time, rounds do not matter.
    assert faults.draw_losses(DIGRAPH, 0, 1, 2.5).all()
    assert not faults.draw_losses(DIGRAPH, 2, 1, 3.0).any()


def test_bursts_are_as_long_as_they_are_told() -> None:
    """Mean lengths over 4 runs of 20 000 rounds: s/√n is 0.6 %, and the fraction is lost."""
    pair = Graph.from_edges(2, [(0, 1)], directed=True)
    faults = Faults(loss=0.4, burst_length=5.0, seed=3)
    lost = faults.draw_rounds(pair, range(20_000), 4)[:, :, 0]
    # A burst begins where a loss follows a message that arrived.
    begins = np.diff(lost.astype(int), axis=0) == 1
    mean_length = lost.sum() / begins.sum()
    assert abs(mean_length - 5.0) < 0.2
    assert abs(lost.mean() - 0.4) < 0.02


def test_delays_add_up_and_windows_silence_nobody_for_good() -> None:
    faults = Faults(delay=2) | Faults(delay=3) | Faults(silent=[1], during=[(2, 4)])
    assert faults.total_delay == 5
    assert faults.always_silent == frozenset()
    assert (faults | Faults(silent=[2])).always_silent == {2}


def test_a_reply_is_in_both_bills() -> None:
    channel = Channel(DIGRAPH)
    values = np.zeros((DIGRAPH.senders.size, 2))
    channel.send_on_links(values, acknowledged=True, is_broadcast=True)
    ledger = channel.ledger
    out_degree = DIGRAPH.out_degree
    in_degree = DIGRAPH.in_degree
    # A reply has a byte and no scalar.
    assert np.array_equal(ledger.messages, out_degree + in_degree)
    assert np.array_equal(ledger.scalars, 2 * out_degree)
    assert np.array_equal(ledger.bytes, 16 * out_degree + in_degree)
    sends = out_degree > 0
    assert np.array_equal(ledger.transmissions, sends + in_degree)
    assert np.array_equal(ledger.broadcast_scalars, 2 * sends)
    assert np.array_equal(ledger.broadcast_bytes, 16 * sends + in_degree)


def test_a_gossip_that_loses_one_message_keeps_both_values() -> None:
    """The sum over agents stays in every run, whatever is lost in one or the other."""
    values = rng(4).standard_normal((3, 5, 2))
    channel = Channel(RING, runs=(3,), faults=Faults(loss=0.5, seed=1))
    new = network.gossip_consensus(values, channel, rounds=20, rng=rng(0))
    assert np.allclose(new.sum(axis=1), values.sum(axis=1), atol=1e-12)
    # Every run has moved by itself.
    assert (np.abs(new - values).max(axis=(1, 2)) > 0.1).all()


def test_an_event_is_one_component_above_the_threshold() -> None:
    """Of changes (0.6, 0) the mean is below 0.5 and the largest above."""
    channel = Channel(TREE)
    network.event_triggered(np.zeros((5, 2)), channel, rounds=1, threshold=0.5)
    first = channel.ledger.messages.sum()
    values = np.zeros((5, 2))
    values[2, 0] = 2.4
    channel = Channel(TREE)
    # Agents 0 and 1 move by 2.4 / 4 = 0.6 in the first round; agents 2 and 4 more or as much.
    network.event_triggered(values, channel, rounds=2, threshold=0.5)
    assert first == TREE.senders.size
    assert (channel.ledger.messages - TREE.out_degree).tolist() == [1, 1, 3, 0, 2]
    # One transmission serves all neighbours.
    assert channel.ledger.transmissions.tolist() == [2, 2, 2, 1, 2]


def test_fusion_on_a_tree_creates_no_information() -> None:
    """Σ Y_i - Σ Y_link over agents and links is constant, also where one message is lost."""
    n_links = TREE.senders.size
    means, covs = gaussians(1, *RUNS, 5, d=3)
    # The common information of a link is the same at both ends, and less than both know.
    common = np.broadcast_to(500.0 * np.eye(3), (*RUNS, n_links, 3, 3)).copy()
    common_means = np.zeros((*RUNS, n_links, 3))
    common_means[...] = [0.3, -0.2, 0.5]
    channel = channel_of(TREE)
    belief = (means, covs)
    link = (common_means, common)

    def totals(belief: Any, link: Any) -> list[Array]:
        result = []
        for vector in (False, True):
            parts = []
            for m, p in (belief, link):
                # Y = P⁻¹ and y = P⁻¹ m
                precision = np.linalg.inv(p)
                information_vector = (precision @ m[..., None])[..., 0]
                parts.append(information_vector if vector else precision)
            of_agents, of_links = parts
            # Each undirected link has two entries.
            result.append(of_agents.sum(axis=1) - 0.5 * of_links.sum(axis=1))
        return result

    before = totals(belief, link)
    for _ in range(3):
        belief, link = network.fuse_on_tree(belief, link, channel)
        for new, old in zip(totals(belief, link), before, strict=True):
            assert np.allclose(new, old, rtol=1e-7, atol=1e-9)
        # Both ends know the same of their link.
        for part in link:
            assert np.allclose(part, part[:, TREE.reverse], rtol=1e-9)
    assert channel.ledger.lost.sum() > 0


def joint_matrix(diagonal: Array, couplings: Array) -> Array:
    """Return the matrix with blocks J_ii and J_ij, where agent i receives from j."""
    n, d = diagonal.shape[:2]
    joint = np.zeros((n, d, n, d))
    joint[np.arange(n), :, np.arange(n)] = diagonal
    joint[TREE.receivers, :, TREE.senders] = couplings
    return joint.reshape(n * d, n * d)


def test_beliefs_on_a_tree_are_marginals_of_couplings_that_are_not_symmetric() -> None:
    d = 2
    # J_ji = J_ijᵀ
    couplings = 0.4 * rng(3).standard_normal((TREE.senders.size, d, d))
    first = TREE.receivers < TREE.senders
    couplings[TREE.reverse[first]] = couplings[first].mT
    diagonal = gaussians(4, 5, d=d)[1] + 3 * np.eye(d)
    vectors = rng(5).standard_normal((5, d))
    joint = joint_matrix(diagonal, couplings)
    # The joint Gaussian has the covariance J⁻¹ and the mean J⁻¹ h.
    cov = np.linalg.inv(joint)
    expected = (cov @ vectors.ravel()).reshape(5, d)
    solve = network.gaussian_belief_propagation
    means, covs = solve(diagonal, vectors, couplings, Channel(TREE))
    own = np.arange(5)
    blocks = cov.reshape(5, d, 5, d)[own, :, own]
    assert np.allclose(means, expected, atol=1e-12)
    assert np.allclose(covs, blocks, atol=1e-12)
    # A lost message leaves the one before, so that many rounds are exact all the same.
    late = Channel(TREE, faults=Faults(loss=0.6, seed=2))
    means, covs = solve(diagonal, vectors, couplings, late, rounds=60)
    assert np.allclose(means, expected, atol=1e-12)
    assert np.allclose(covs, blocks, atol=1e-12)
    # From round 6 on nothing arrives: six rounds are more than the tree's diameter.
    silent = Channel(TREE, faults=Faults(loss=1.0, during=[(6, 99)]))
    means, _ = solve(diagonal, vectors, couplings, silent, rounds=9)
    assert np.allclose(means, expected, atol=1e-12)


def test_substeps_of_the_estimator_by_hand() -> None:
    """ν⁺ = ν + h (α (u - ν) + u') - a h L ν + b h L η and η⁺ = η - b h L ν, with u along a ramp."""
    draw = rng(6)
    nu, eta, u, rate = draw.standard_normal((4, *RUNS, 5, 2))
    laplacian = RING.laplacian.toarray()
    alpha = 0.7
    a = 0.4
    b = 0.2
    dt = 0.6
    n = 3
    state = network.PIState(nu, eta)
    new = network.pi_step(
        state, u, channel_of(RING, lossy=False), dt=dt, alpha=alpha, a=a, b=b,
        rate=rate, substeps=n,
    )  # fmt: skip
    h = dt / n
    for k in range(n):
        now = u + k * h * rate
        following = alpha * (now - nu) + rate
        agreeing = b * laplacian @ eta - a * laplacian @ nu
        # Both states are those from before the substep.
        eta = eta - h * b * laplacian @ nu
        nu = nu + h * (following + agreeing)
    assert np.allclose(new.estimate, nu, atol=1e-12)
    assert np.allclose(new.integral, eta, atol=1e-12)


def test_the_residuals_of_admm_are_in_the_units_of_the_penalty() -> None:
    """One iteration with f_i = (x - c_i)²/2, whose local solution is (c_i + ρ v) / (1 + ρ)."""
    targets = rng(7).standard_normal((5, 2))
    rho = 3.0

    def solve(v: Array, rho: float) -> Array:
        return (targets + rho * v) / (1 + rho)

    start = np.ones((5, 2))
    local = solve(start, rho)
    # |u - z| after the average z, and ρ |z - z before|
    mean = local.mean(axis=0)
    dual = rho * np.abs(mean - start).max()
    primal = np.abs(local - mean).max()
    run = partial(network.admm, solve, start, rho=rho)
    result = run(Channel(RING), tolerance=1.01 * max(primal, dual), iterations=1)
    assert np.isclose(result.dual, dual)
    assert np.isclose(result.primal, primal)
    assert np.allclose(result.common, mean)


@pytest.mark.parametrize("split_horizon", [True, False])
@pytest.mark.parametrize("graph", [RING, TREE, DIGRAPH])
def test_a_flood_sends_back_nothing_where_it_is_told(
    graph: Graph, split_horizon: bool
) -> None:
    """Messages of a flood by sets: each agent forwards new messages."""
    n = graph.n_agents
    channel = Channel(graph)
    values = rng(1).standard_normal((n, 2))
    averages, is_complete = network.flooding(
        values, channel, split_horizon=split_horizon
    )
    assert is_complete.all()
    assert np.allclose(averages, values.mean(axis=0))
    links = list(zip(graph.receivers.tolist(), graph.senders.tolist(), strict=True))
    knows = [{i} for i in range(n)]
    new = [{i} for i in range(n)]
    came: dict[tuple[int, int], set[int]] = {link: set() for link in links}
    scalars = np.zeros(n)
    while any(new):
        sent = {}
        for receiver, sender in links:
            back = came.get((sender, receiver), set()) if split_horizon else set()
            sent[receiver, sender] = new[sender] - back
        new = [set() for _ in range(n)]
        for (receiver, sender), values_sent in sent.items():
            # Two numbers of each value, and whose it is
            scalars[sender] += 3 * len(values_sent)
            came[receiver, sender] |= values_sent
            new[receiver] |= values_sent - knows[receiver]
        knows = [old | fresh for old, fresh in zip(knows, new, strict=True)]
    assert np.array_equal(channel.ledger.scalars, scalars)
