"""Fusion rules for Gaussians and ensembles: against the definition, agent by agent."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from distfilt import gaussians as pure
from distfilt import network
from distfilt.ensembles import mean, sample_covariance
from distfilt.network import Channel, Faults, Graph, UnstableGain, graphs
from distfilt.network.channel import kind_of_rule
from tests.network.helpers import DISK, STAR, arrivals, gaussians, lossy, rng, star
from tests.support import relative_difference

RULES = ("equal", "trace", "determinant", "min_trace", "min_determinant")
GAIN = 0.04
ALL = {
    **{r: partial(network.covariance_intersection, rule=r) for r in RULES},
    "naive": network.naive_fusion,
    "arithmetic": network.arithmetic_average,
    "pull": partial(network.consensus_pull, gain=GAIN),
}
each_rule = pytest.mark.parametrize("rule", ALL.values(), ids=ALL.keys())
OF_ENSEMBLES = {
    "optimal": network.intersect_ensembles,
    "equal": partial(network.intersect_ensembles, rule="equal"),
    "pull": partial(network.mean_pull, gain=0.1),
}
each_ensemble_rule = pytest.mark.parametrize(
    "rule", OF_ENSEMBLES.values(), ids=OF_ENSEMBLES.keys()
)
SCALE = np.logspace(-1, 2, 4)
OUT_DEGREE = np.array([2, 1, 1])
"""Of the star's agents."""


def _ensembles(seed: int, leading: tuple[int, ...] = (3,)) -> np.ndarray:
    """Return ensembles of forty members with different moments, components of different size."""
    draw = rng(seed)
    perturbation = draw.standard_normal((*leading, 4, 4))
    mixing = np.eye(4) + 0.4 * perturbation
    shift = draw.standard_normal((*leading, 1, 4))
    normal = draw.standard_normal((*leading, 40, 4))
    return (normal @ mixing + shift) * SCALE


# Gaussians.


def _fuse_one(name: str, m: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the fusion of an agent's Gaussian, the first, with the received ones."""
    count = len(m)
    if name == "naive":
        # The product of all: P⁻¹ = Σ P_j⁻¹, an intersection of P_j / n with weights
        # 1 / n.
        equal_weights = np.full(count, 1 / count)
        return pure.intersect_gaussians(m, p / count, equal_weights)
    if name == "arithmetic":
        # Mean and covariance of the mixture with equal weights.
        # Law of total covariance: the mean covariance plus the covariance of the means.
        mixture_mean = m.mean(axis=0)
        deviation = m - mixture_mean
        spread = deviation[..., :, None] * deviation[..., None, :]
        return mixture_mean, (p + spread).mean(axis=0)
    if name == "pull":
        # m⁺ = m_0 + γ Σ (m_j - m_0); the covariance stays.
        pulls = GAIN * (m - m[0])
        return m[0] + pulls.sum(axis=0), p[0]
    omega = pure.intersection_weights(p, rule=name)
    return pure.intersect_gaussians(m, p, omega)


@pytest.mark.parametrize("loss", [0.0, 0.4])
@pytest.mark.parametrize("graph", [STAR, DISK, Graph.from_edges(3, [[0, 1]])])
@pytest.mark.parametrize("name", ALL)
def test_all_agents_at_once_are_each_by_its_definition(
    name: str, graph: Graph, loss: float
) -> None:
    """From the messages that arrived, run by run."""
    m, p = gaussians(3, 2, 1, graph.n_agents, d=3)
    faults = Faults(loss=loss, seed=6)
    channel = Channel(graph, runs=(2, 1), faults=faults)
    means, covs = ALL[name]((m, p), channel)
    for run, arrived in enumerate(arrivals(faults, graph, runs=2)):
        for agent in range(graph.n_agents):
            senders = [j for j in graph.neighbours(agent) if arrived[agent, j]]
            sources = [agent, *senders]
            expected_mean, expected_cov = _fuse_one(
                name, m[run, 0, sources], p[run, 0, sources]
            )
            # Components differ in size: errors are in standard deviations.
            std = np.sqrt(np.diagonal(expected_cov))
            error = (means[run, 0, agent] - expected_mean) / std
            assert np.abs(error).max() < 1e-7
            assert relative_difference(covs[run, 0, agent], expected_cov) < 1e-7
    assert (covs == np.swapaxes(covs, -1, -2)).all()


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize(("d", "numbers"), [(1, 2), (6, 27), (13, 104)])
def test_the_cost_is_mean_and_half_the_covariance(
    name: str, d: int, numbers: int
) -> None:
    """d + d(d+1)/2 numbers on each link and round; means alone for the pull."""
    channel = lossy(0.4)
    covs = np.tile(np.eye(d), (3, 1, 1))
    belief = (np.zeros((3, d)), covs)
    ALL[name](belief, channel, rounds=2)
    sent = 2 * (d if name == "pull" else numbers) * OUT_DEGREE
    # Lost messages are paid for, too.
    assert (channel.ledger.scalars == sent).all()
    assert (channel.ledger.bytes == 8 * sent).all()
    assert channel.ledger.rounds == 2
    assert 0 < channel.ledger.lost.sum() < 8


@each_rule
def test_two_rounds_are_one_after_the_other(rule: object) -> None:
    belief = gaussians(2, 6)
    channel = Channel(graphs.path(6))
    at_once = rule(belief, channel, rounds=2)
    one_by_one = rule(rule(belief, channel), channel)
    # No rule keeps a memory between rounds.
    for x, y in zip(at_once, one_by_one, strict=True):
        assert np.allclose(x, y, rtol=1e-12)


# Pulls.


@pytest.mark.parametrize(
    ("rule", "belief"),
    [
        (network.consensus_pull, gaussians(5, 3)),
        (network.mean_pull, _ensembles(1)),
    ],
)
def test_a_pull_beyond_the_bound_warns(rule: object, belief: object) -> None:
    text = r"2/λ_max = 0\.6666.* got 0\.8"
    with pytest.warns(UnstableGain, match=text) as caught:
        rule(belief, star(), gain=0.8, rounds=2)
    # Once for both rounds, at the line of the caller.
    assert len(caught) == 1
    assert caught[0].filename == __file__


def test_a_pull_without_gain_sends_nothing() -> None:
    ensembles = _ensembles(1)
    channel = star()
    assert (network.mean_pull(ensembles, channel, gain=0.0) == ensembles).all()
    assert channel.ledger.rounds == 0


@pytest.mark.parametrize("include_self", [True, False])
def test_a_pull_by_its_equation_with_the_received_means(include_self: bool) -> None:
    """Member by member, run by run, equation (16)."""
    ensembles = rng(1).standard_normal((6, 3, 20, 2))
    channel = star(runs=(6,), faults=Faults(loss=0.5, seed=5))
    pulled = network.mean_pull(ensembles, channel, gain=0.2, include_self=include_self)
    arrived = arrivals(channel.faults, STAR, runs=6)
    # With j = i an agent's members are pulled to their own mean, too.
    if include_self:
        arrived |= np.eye(3, dtype=bool)
    for run in range(6):
        expected = ensembles[run].copy()
        for i, j in np.argwhere(arrived[run]):
            # From the positions before the round, for all neighbours.
            received_mean = ensembles[run, j].mean(axis=0)
            expected[i] += 0.2 * (received_mean - ensembles[run, i])
        assert np.abs(pulled[run] - expected).max() < 1e-14
    assert (channel.ledger.scalars == 2 * OUT_DEGREE).all()


# Intersections of ensembles.


@pytest.mark.parametrize("rule", RULES)
def test_intersection_gives_the_fused_moments(rule: str) -> None:
    ensembles = _ensembles(3, (5, 3))
    belief = (mean(ensembles), sample_covariance(ensembles))
    means, covs = network.covariance_intersection(
        belief, star(runs=(5,)), rule=rule, rounds=2
    )
    channel = star(runs=(5,))
    fused = network.intersect_ensembles(ensembles, channel, rule=rule, rounds=2)
    # Members are moved affinely: their sample moments are exactly the fused ones.
    error = (mean(fused) - means) / ensembles.std(axis=-2)
    assert np.abs(error).max() < 1e-10
    assert relative_difference(sample_covariance(fused), covs) < 1e-10
    # 4 + 10 numbers on each link and round.
    assert (channel.ledger.scalars == 2 * 14 * OUT_DEGREE).all()


@pytest.mark.parametrize("rule", RULES)
def test_a_scale_matters_to_traces_only(rule: str) -> None:
    """Determinants scale alike for all agents, traces add components of different units."""
    ensembles = _ensembles(3)
    intersect = partial(network.intersect_ensembles, rule=rule)
    plain = intersect(ensembles, star())
    scaled = intersect(ensembles, star(), scale=SCALE)
    is_close = np.allclose(plain, scaled, rtol=1e-6, atol=1e-6)
    # det(S P S) = det(S)² det(P): the minimiser of a determinant ignores the scale.
    assert is_close == ("trace" not in rule)
    # The scale is a division before and a multiplication after.
    in_units = intersect(ensembles / SCALE, star()) * SCALE
    assert np.allclose(scaled, in_units)


@each_ensemble_rule
def test_ensembles_of_two_rounds(rule: object) -> None:
    ensembles = _ensembles(2, (6,))
    channel = Channel(graphs.path(6))
    at_once = rule(ensembles, channel, rounds=2)
    one_by_one = rule(rule(ensembles, channel), channel)
    assert np.allclose(mean(at_once), mean(one_by_one), rtol=1e-9)


@each_ensemble_rule
def test_ensembles_in_any_unit_and_equal_ones(rule: object) -> None:
    ensembles = _ensembles(2)
    fused = rule(ensembles, star())
    for factor in (1e-8, 1e8):
        scaled = rule(factor * ensembles, star()) / factor
        assert np.allclose(scaled, fused, rtol=1e-8, atol=1e-8)
    # Equal means stay.
    equal = np.stack([ensembles[0]] * 3)
    fused = rule(equal, star())
    assert np.allclose(mean(fused), mean(equal), rtol=1e-8, atol=1e-8)


# Declarations.


def test_a_rule_declares_the_kind_of_belief_that_it_fuses() -> None:
    """Also with options given by partials; a rule of the user's may declare nothing."""
    pull = partial(partial(network.mean_pull, gain=0.1), rounds=2)
    assert kind_of_rule(pull) == "ensembles"
    assert kind_of_rule(network.naive_fusion) == "gaussians"
    assert kind_of_rule(network.average_consensus) == "vectors"
    assert kind_of_rule(lambda belief, channel: belief) is None
