"""Rules for Gaussians and ensembles: against the definition, agent by agent, run by run."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from distfilt import gaussians as pure
from distfilt import network
from distfilt.ensembles import mean, sample_covariance
from distfilt.network import Channel, Faults, Graph, UnstableGain, graphs
from distfilt.network.channel import kind_of_rule
from tests.network.helpers import DISK, STAR, gaussians, heard, lossy, rng, star
from tests.support import unit_gap, without_checks

RULES = ("equal", "trace", "determinant", "min_trace", "min_determinant")
GAIN = 0.04
ALL = {
    **{r: partial(network.covariance_intersection, rule=r) for r in RULES},
    "naive": network.naive_fusion,
    "arithmetic": network.arithmetic_average,
    "pull": partial(network.consensus_pull, gain=GAIN),
}
every = pytest.mark.parametrize("rule", ALL.values(), ids=ALL.keys())
MOVES = {
    "least": network.intersect_ensembles,
    "equal": partial(network.intersect_ensembles, rule="equal"),
    "pull": partial(network.mean_pull, gain=0.1),
}
SIZES = np.logspace(-1, 2, 4)
LINKS = np.array([2, 1, 1])
"""How many hear each agent of the star."""


def _by_hand(
    name: str, graph: Graph, m: np.ndarray, p: np.ndarray, got: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One round, agent by agent, from those whose messages arrived, `got` (A, A)."""
    out_m = np.empty_like(m)
    out_p = np.empty_like(p)
    for i in range(graph.n_agents):
        who = [i, *(j for j in graph.neighbours(i) if got[i, j])]
        if name == "naive":
            equal = np.full(len(who), 1 / len(who))
            out_m[i], out_p[i] = pure.intersect_gaussians(
                m[who], p[who] / len(who), equal
            )
        elif name == "arithmetic":
            out_m[i] = m[who].mean(axis=0)
            gap = m[who] - out_m[i]
            out_p[i] = (p[who] + gap[..., :, None] * gap[..., None, :]).mean(axis=0)
        elif name == "pull":
            out_m[i] = m[i] + GAIN * (m[who] - m[i]).sum(axis=0)
            out_p[i] = p[i]
        else:
            omega = pure.intersection_weights(p[who], rule=name)
            out_m[i], out_p[i] = pure.intersect_gaussians(m[who], p[who], omega)
    return out_m, out_p


@pytest.mark.parametrize("loss", [0.0, 0.4])
@pytest.mark.parametrize("graph", [STAR, DISK, Graph.from_edges(3, [[0, 1]])])
@pytest.mark.parametrize("key", ALL)
def test_all_agents_at_once_is_each_by_its_definition(
    key: str, graph: Graph, loss: float
) -> None:
    m, p = gaussians(3, 2, 1, graph.n_agents, d=3)
    faults = Faults(loss=loss, seed=6)
    out = ALL[key]((m, p), Channel(graph, runs=(2, 1), faults=faults))
    for run, got in enumerate(heard(faults, graph, runs=2)):
        means, covs = _by_hand(key, graph, m[run, 0], p[run, 0], got)
        unit = np.sqrt(np.diagonal(covs, axis1=-2, axis2=-1))
        assert np.abs((out[0][run, 0] - means) / unit).max() < 1e-7
        assert unit_gap(out[1][run, 0], covs) < 1e-7
    assert (out[1] == np.swapaxes(out[1], -1, -2)).all()


@every
def test_the_account_is_mean_and_half_the_covariance(rule: object) -> None:
    for d, floats in ((1, 2), (6, 27), (13, 104)):
        channel = lossy(0.4)
        rule((np.zeros((3, d)), np.tile(np.eye(d), (3, 1, 1))), channel, rounds=2)
        sent = 2 * (d if rule is ALL["pull"] else floats) * LINKS
        assert (channel.ledger.scalars == sent).all() and (
            channel.ledger.bytes == 8 * sent
        ).all()
        assert channel.ledger.rounds == 2 and 0 < channel.ledger.lost.sum() < 8


@every
def test_two_rounds_are_one_after_the_other(rule: object) -> None:
    belief = gaussians(2, 6)
    channel = Channel(graphs.path(6))
    for whole, part in zip(
        rule(belief, channel, rounds=2),
        rule(rule(belief, channel), channel),
        strict=True,
    ):
        assert np.allclose(whole, part, rtol=1e-12)


def test_pulls_beyond_the_bound_warn_and_none_is_silence() -> None:
    e = _ensembles(1)
    for rule, belief in (
        (network.consensus_pull, gaussians(5, 3)),
        (network.mean_pull, e),
    ):
        with pytest.warns(
            UnstableGain, match=r"0\.8 is above 2/λ_max = 0\.6666"
        ) as caught:
            rule(belief, star(), gain=0.8, rounds=2)
        assert len(caught) == 1 and caught[0].filename == __file__
    channel = star()
    assert (
        network.mean_pull(e, channel, gain=0.0) == e
    ).all() and channel.ledger.rounds == 0


def _ensembles(seed: int, leading: tuple[int, ...] = (3,)) -> np.ndarray:
    """Forty members with other means and covariances each, components of different size."""
    draw = rng(seed)
    mixing = np.eye(4) + 0.4 * draw.standard_normal((*leading, 4, 4))
    shift = draw.standard_normal((*leading, 1, 4))
    return (draw.standard_normal((*leading, 40, 4)) @ mixing + shift) * SIZES


def test_a_rule_says_what_it_fuses_with_and_without_its_door() -> None:
    assert (
        kind_of_rule(partial(partial(network.mean_pull, gain=0.1), rounds=2))
        == "ensembles"
    )
    assert kind_of_rule(without_checks(network.naive_fusion)) == "gaussians"
    assert kind_of_rule(network.average_consensus) == "vectors"
    assert kind_of_rule(lambda belief, channel: belief) is None


@pytest.mark.parametrize("include", [True, False])
def test_a_pull_by_its_equation_with_the_means_that_are_heard(include: bool) -> None:
    """Member by member, run by run, equation (16)."""
    e = rng(1).standard_normal((6, 3, 20, 2))
    channel = star(runs=(6,), faults=Faults(loss=0.5, seed=5))
    out = network.mean_pull(e, channel, gain=0.2, include_self=include)
    got = heard(channel.faults, STAR, runs=6) | (include & np.eye(3, dtype=bool))
    for run in range(6):
        expected = e[run].copy()
        for i, j in np.argwhere(got[run]):
            expected[i] += 0.2 * (e[run, j].mean(axis=0) - e[run, i])
        assert np.abs(out[run] - expected).max() < 1e-14
    assert (channel.ledger.scalars == 2 * LINKS).all()


@pytest.mark.parametrize("rule", RULES)
def test_intersection_gives_the_fused_moments(rule: str) -> None:
    e = _ensembles(3, (5, 3))
    belief = (mean(e), sample_covariance(e))
    channel = star(runs=(5,))
    fused = network.covariance_intersection(
        belief, star(runs=(5,)), rule=rule, rounds=2
    )
    out = network.intersect_ensembles(e, channel, rule=rule, rounds=2)
    assert np.abs((mean(out) - fused[0]) / e.std(axis=-2)).max() < 1e-10
    assert unit_gap(sample_covariance(out), fused[1]) < 1e-10
    # 4 + 10 numbers on each link and round.
    assert (channel.ledger.scalars == 2 * 14 * LINKS).all()
    # A scale matters to traces only.
    scaled = network.intersect_ensembles(e[0], star(), rule=rule, scale=SIZES)
    plain = network.intersect_ensembles(e[0], star(), rule=rule)
    assert np.allclose(plain, scaled, rtol=1e-6, atol=1e-6) == ("trace" not in rule)
    assert np.allclose(
        scaled, network.intersect_ensembles(e[0] / SIZES, star(), rule=rule) * SIZES
    )


@pytest.mark.parametrize("rule", MOVES.values(), ids=MOVES.keys())
def test_ensembles_of_two_rounds_in_any_units_and_equal_ones(rule: object) -> None:
    e = _ensembles(2, (6,))
    channel = Channel(graphs.path(6))
    whole = rule(e, channel, rounds=2)
    parts = rule(rule(e, channel), channel)
    assert np.allclose(mean(whole), mean(parts), rtol=1e-9)
    for factor in (1e-8, 1e8):
        scaled = rule(factor * e[:3], star()) / factor
        assert np.allclose(scaled, rule(e[:3], star()), rtol=1e-8, atol=1e-8)
    same = np.stack([e[0]] * 3)
    assert np.allclose(mean(rule(same, star())), mean(same), rtol=1e-8, atol=1e-8)
