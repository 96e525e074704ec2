"""Rules for Gaussians and ensembles: against the definition, agent by agent, run by run."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt import gaussians as pure
from distfilt.doors import unchecked
from distfilt.ensembles import mean, sample_covariance
from distfilt.network import (
    Channel,
    Faults,
    Graph,
    UnstableGain,
    arithmetic_average,
    average,
    consensus_pull,
    covariance_intersection,
    fused_kind,
    graphs,
    intersection,
    naive_fusion,
    pull,
)
from tests.network.helpers import REFERENCE, STAR, gaussians, heard, lossy, rng, star

RULES = ("equal", "trace", "determinant", "min_trace", "min_determinant")
GAIN = 0.04
ALL = {
    **{r: partial(covariance_intersection, rule=r) for r in RULES},
    "naive": naive_fusion, "arithmetic": arithmetic_average,
    "pull": partial(consensus_pull, gain=GAIN),
}
every = pytest.mark.parametrize("rule", ALL.values(), ids=ALL.keys())
MOVES = {
    "least": intersection, "equal": partial(intersection, rule="equal"),
    "pull": partial(pull, gain=0.1),
}
SIZES = np.logspace(-1, 2, 4)
LINKS = np.array([2, 1, 1])
"""How many hear each agent of the star."""


def _by_hand(
    name: str, graph: Graph, m: np.ndarray, p: np.ndarray, got: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One round, agent by agent, from those whose messages arrived, `got` (A, A)."""
    out_m, out_p = np.empty_like(m), np.empty_like(p)
    for i in range(graph.size):
        who = [i, *(j for j in graph.neighbours(i) if got[i, j])]
        if name == "naive":
            info = np.linalg.inv(p[who])
            out_p[i] = np.linalg.inv(info.sum(axis=0))
            out_m[i] = out_p[i] @ (info @ m[who][..., None]).sum(axis=0)[:, 0]
        elif name == "arithmetic":
            out_m[i] = m[who].mean(axis=0)
            gap = m[who] - out_m[i]
            out_p[i] = (p[who] + gap[..., :, None] * gap[..., None, :]).mean(axis=0)
        elif name == "pull":
            out_m[i], out_p[i] = m[i] + GAIN * (m[who] - m[i]).sum(axis=0), p[i]
        else:
            omega = pure.intersection_weights(p[who], rule=name)
            out_m[i], out_p[i] = pure.intersection(m[who], p[who], omega)
    return out_m, out_p


def _gap(cov: np.ndarray, wanted: np.ndarray) -> float:
    """Largest difference in units of the standard deviations."""
    unit = np.sqrt(np.diagonal(wanted, axis1=-2, axis2=-1))
    return float(np.abs((cov - wanted) / (unit[..., :, None] * unit[..., None, :])).max())


@pytest.mark.parametrize("loss", [0.0, 0.4])
@pytest.mark.parametrize("name", ["star", "grid", "disk"])
@pytest.mark.parametrize("key", ALL)
def test_all_agents_at_once_is_each_by_its_definition(key: str, name: str, loss: float) -> None:
    graph = REFERENCE[name]
    m, p = gaussians(3, 2, graph.size, d=3)
    faults = Faults(loss=loss, seed=6)
    out = ALL[key]((m, p), Channel(graph, runs=(2,), faults=faults))
    for run, got in enumerate(heard(faults, graph, runs=2)):
        means, covs = _by_hand(key, graph, m[run], p[run], got)
        unit = np.sqrt(np.diagonal(covs, axis1=-2, axis2=-1))
        assert np.abs((out[0][run] - means) / unit).max() < 1e-7
        assert _gap(out[1][run], covs) < 1e-7
    assert (out[1] == np.swapaxes(out[1], -1, -2)).all()


@every
def test_the_account_is_mean_and_half_the_covariance(rule: object) -> None:
    for d, floats in ((1, 2), (6, 27), (13, 104)):
        channel = lossy(0.4)
        rule((np.zeros((3, d)), np.tile(np.eye(d), (3, 1, 1))), channel, rounds=2)
        sent = 2 * (d if rule is ALL["pull"] else floats) * LINKS
        assert (channel.ledger.scalars == sent).all() and (channel.ledger.bytes == 8 * sent).all()
        assert channel.ledger.rounds == 2 and 0 < channel.ledger.lost.sum() < 8


@every
def test_fusion_in_a_batch_is_fusion_run_by_run(rule: object) -> None:
    m, p = gaussians(1, 4, 3)
    faults = Faults(loss=0.4, seed=1)
    whole = rule((m, p), star(runs=(4,), faults=faults), rounds=2)
    first = rule((m[0], p[0]), star(faults=faults), rounds=2)
    assert np.allclose(whole[0][0], first[0]) and np.allclose(whole[1][0], first[1])
    nested = rule((m.reshape(2, 2, 3, 2), p.reshape(2, 2, 3, 2, 2)),
                  star(runs=(2, 2), faults=faults), rounds=2)
    assert np.allclose(nested[0].reshape(m.shape), whole[0])
    alone = rule((m, p), star(runs=(4,), faults=Faults(loss=1.0)))
    assert np.allclose(alone[0], m) and np.allclose(alone[1], p)


@every
def test_a_perturbation_travels_one_hop_a_round_and_inputs_stay(rule: object) -> None:
    m, p = gaussians(2, 6)
    other_m, other_p, before = m.copy(), p.copy(), (m.copy(), p.copy())
    other_m[0] += 1.0
    other_p[0] *= 3.0
    for loss in (0.0, 0.3):
        a = rule((m, p), lossy(loss, graphs.path(6)), rounds=2)
        b = rule((other_m, other_p), lossy(loss, graphs.path(6)), rounds=2)
        assert (a[0][3:] == b[0][3:]).all() and (a[1][3:] == b[1][3:]).all()
        assert loss > 0 or (a[0][:3] != b[0][:3]).any(axis=1).all()
    assert (m == before[0]).all() and (p == before[1]).all()
    assert not np.shares_memory(a[0], m) and not np.shares_memory(a[1], p)


@every
def test_late_gaussians_are_those_of_before(rule: object) -> None:
    """With a delay agents fuse their own of now with the neighbours' of a round ago."""
    first, second = gaussians(1, 3), gaussians(2, 3)
    channel = star(faults=Faults(delay=1))
    alone, late = rule(first, channel), rule(second, channel)
    assert np.allclose(alone[0], first[0]) and np.allclose(alone[1], first[1])
    for a in range(3):
        mixed_m, mixed_p = first[0].copy(), first[1].copy()
        mixed_m[a], mixed_p[a] = second[0][a], second[1][a]
        expected = rule((mixed_m, mixed_p), star())
        for got, wanted in zip(late, expected, strict=True):
            assert np.allclose(got[a], wanted[a], rtol=1e-7)


@pytest.mark.parametrize("key", [*RULES, "arithmetic"])
@given(seed=st.integers(0, 1000), d=st.integers(1, 4))
def test_fusing_the_same_belief_changes_nothing(key: str, seed: int, d: int) -> None:
    m, p = (np.repeat(v[:1], 3, axis=0) for v in gaussians(seed, 1, d=d))
    mean, cov = ALL[key]((m + 1e6, p), star())
    assert (mean == m + 1e6).all() and np.allclose(cov, p, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("rule", RULES)
@given(seed=st.integers(0, 1000), d=st.integers(1, 3))
def test_covariance_intersection_bounds_the_true_covariance(rule: str, seed: int, d: int) -> None:
    """Whatever the errors' correlation, P - P_true has no negative eigenvalue."""
    root = rng(seed).standard_normal((2 * d, 2 * d))
    joint = root @ root.T + 0.1 * np.eye(2 * d)
    covs = np.stack([joint[:d, :d], joint[d:, d:]])
    # Unit means in place of data read off the linear map from both means to the fused one.
    many = Channel(graphs.path(2), runs=(2 * d,))
    belief = np.eye(2 * d).reshape(2 * d, 2, d), np.broadcast_to(covs, (2 * d, 2, d, d))
    means, fused = covariance_intersection(belief, many, rule=rule)
    whole = means[:, 0].T
    gap = fused[0, 0] - whole @ joint @ whole.T
    assert np.linalg.eigvalsh(gap).min() > -1e-9 * np.abs(fused).max()


@pytest.mark.parametrize("rule", ["equal", "determinant", "min_determinant"])
def test_what_uses_determinants_does_not_depend_on_units(rule: str) -> None:
    m, p = gaussians(1, 3)
    units = np.diag([1000.0, 0.01])
    plain = covariance_intersection((m, p), star(), rule=rule)
    other = covariance_intersection((m @ units, units @ p @ units), star(), rule=rule)
    assert np.allclose(other[0], plain[0] @ units, rtol=1e-6)
    assert np.allclose(other[1], units @ plain[1] @ units, rtol=1e-6)


@pytest.mark.parametrize("rule", RULES)
def test_an_agent_that_hears_nobody_keeps_its_belief(rule: str) -> None:
    means, covs = gaussians(2, 3)
    door = Channel(Graph.from_edges(3, [[0, 1]]))
    m, p = covariance_intersection((means, covs), door, rule=rule)
    assert np.allclose(m[2], means[2], rtol=1e-14) and np.allclose(p[2], covs[2], rtol=1e-13)


def test_naive_fusion_grows_sure_of_one_measurement() -> None:
    """The same datum passed round and round: variance falls, although nothing new was learned."""
    one = np.zeros((3, 1)), np.ones((3, 1, 1))
    assert naive_fusion(one, star(), rounds=5)[1].max() < 0.02
    assert np.allclose(covariance_intersection(one, star(), rounds=5)[1], 1.0)


def test_a_consensus_pull_by_covariance() -> None:
    """Olfati-Saber's gain: γ P / (1 + |P|_F), matrix and all."""
    m, p = gaussians(5, 3)
    mean, cov = consensus_pull((m, p), star(), gain=0.4, rule="covariance")
    for i, near in enumerate([[1, 2], [0], [0]]):
        gain = 0.4 * p[i] / (1 + np.linalg.norm(p[i]))
        assert np.allclose(mean[i], m[i] + gain @ (m[near] - m[i]).sum(axis=0), rtol=1e-12)
    assert (cov == p).all()


def test_pulls_beyond_the_bound_warn_and_none_is_silence() -> None:
    (m, p), e = gaussians(5, 3), _ensembles(1)
    for rule, belief in ((consensus_pull, (m, p)), (pull, e)):
        with pytest.warns(UnstableGain, match=r"0\.8 is above 2/λ_max = 0\.6666") as caught:
            rule(belief, star(), gain=0.8, rounds=2)
        assert len(caught) == 1 and caught[0].filename == __file__
        channel = star()
        same = rule(belief, channel, gain=0.0)
        assert all((a == b).all() for a, b in zip(same, belief, strict=True))
        assert channel.ledger.rounds == 0
    consensus_pull((m, 0.1 * np.tile(np.eye(2), (3, 1, 1))), star(), gain=0.8, rule="covariance")


def _ensembles(seed: int, leading: tuple[int, ...] = (3,)) -> np.ndarray:
    """Forty members with other means and covariances each, components of different size."""
    draw = rng(seed)
    mixing = np.eye(4) + 0.4 * draw.standard_normal((*leading, 4, 4))
    shift = draw.standard_normal((*leading, 1, 4))
    return (draw.standard_normal((*leading, 40, 4)) @ mixing + shift) * SIZES


def test_a_rule_says_what_it_fuses_with_and_without_its_door() -> None:
    assert fused_kind(partial(partial(pull, gain=0.1), rounds=2)) == "ensembles"
    assert fused_kind(unchecked(naive_fusion)) == "gaussians"
    assert fused_kind(average) == "vectors" and fused_kind(lambda belief, channel: belief) is None


@pytest.mark.parametrize("include", [True, False])
def test_a_pull_averages_means_and_shrinks_the_spread(include: bool) -> None:
    """The exact defect of (16): anomalies are multiplied by 1 - γ|Nbs| in every round."""
    e, channel = rng(1).standard_normal((3, 20, 2)), star()
    pulled = pull(e, channel, gain=0.05, rounds=2, include_self=include)
    means = average(e.mean(axis=1), star(), gain=0.05, rounds=2)
    assert np.allclose(pulled.mean(axis=1), means, atol=1e-13)
    shrink = (1 - 0.05 * (LINKS + include)) ** 2
    before, after = (v - v.mean(axis=1, keepdims=True) for v in (e, pulled))
    assert np.allclose(after, shrink[:, None, None] * before, atol=1e-13)
    assert (channel.ledger.scalars == 2 * 2 * LINKS).all()


def test_a_lost_mean_does_not_pull_and_the_others_do() -> None:
    """Run by run against equation (16) with the neighbours that were heard."""
    e = rng(1).standard_normal((6, 3, 20, 2))
    faults = Faults(loss=0.5, seed=5)
    out = pull(e, star(runs=(6,), faults=faults), gain=0.2, include_self=False)
    got = heard(faults, STAR, runs=6)
    assert 0 < got.sum() < 6 * 4
    for run in range(6):
        expected = e[run].copy()
        for i, j in np.argwhere(got[run]):
            expected[i] += 0.2 * (e[run, j].mean(axis=0) - e[run, i])
        assert np.abs(out[run] - expected).max() < 1e-14


@pytest.mark.parametrize("rule", RULES)
def test_intersection_gives_the_fused_moments(rule: str) -> None:
    e = _ensembles(3, (5, 3))
    belief, channel = (mean(e), sample_covariance(e)), star(runs=(5,))
    fused = covariance_intersection(belief, star(runs=(5,)), rule=rule, rounds=2)
    out = intersection(e, channel, rule=rule, rounds=2)
    assert np.abs((mean(out) - fused[0]) / e.std(axis=-2)).max() < 1e-10
    assert _gap(sample_covariance(out), fused[1]) < 1e-10
    # 4 + 10 numbers on each link and round.
    assert (channel.ledger.scalars == 2 * 14 * LINKS).all()
    # A scale matters to traces only.
    scaled = intersection(e[0], star(), rule=rule, scale=SIZES)
    plain = intersection(e[0], star(), rule=rule)
    assert np.allclose(plain, scaled, rtol=1e-6, atol=1e-6) == ("trace" not in rule)
    assert np.allclose(scaled, intersection(e[0] / SIZES, star(), rule=rule) * SIZES)


def test_the_default_weights_give_the_least_determinant() -> None:
    e = _ensembles(7)
    options = ({}, *({"rule": rule} for rule in RULES[:4]))
    sizes = [np.linalg.slogdet(sample_covariance(intersection(e, star(), **o)))[1] for o in options]
    assert all((sizes[0] <= other + 1e-9).all() for other in sizes[1:])
    assert (sizes[0] < sizes[1] - 1e-3).any()


@pytest.mark.parametrize("rule", MOVES.values(), ids=MOVES.keys())
def test_ensembles_one_hop_units_equality_and_loss(rule: object) -> None:
    """What every rule does: news travels a hop a round, units do not matter, inputs stay."""
    e = _ensembles(2, (6,))
    other, before = e.copy(), e.copy()
    other[0] = _ensembles(12, ()) * [1, 30, 1, 0.01]
    for loss in (0.0, 0.3):
        a, b = (rule(v, lossy(loss, graphs.path(6)), rounds=2) for v in (e, other))
        assert (a[3:] == b[3:]).all() and (loss > 0 or (a[:3] != b[:3]).any(axis=(1, 2)).all())
    assert (e == before).all() and not np.shares_memory(a, e)
    for factor in (1e-8, 1e8):
        scaled = rule(factor * e[:3], star()) / factor
        assert np.allclose(scaled, rule(e[:3], star()), rtol=1e-8, atol=1e-8)
    same = np.stack([e[0]] * 3)
    assert np.allclose(mean(rule(same, star())), mean(same), rtol=1e-8, atol=1e-8)


def test_flat_ensembles_are_refused() -> None:
    e = _ensembles(0)
    flat = (e[:, :4], np.zeros_like(e), e[..., [0, 0]], e[..., [0, 1]] @ [[1.0, 1, 2], [1, -1, 3]])
    for ensembles in flat:
        with pytest.raises(ValueError, match="ensemble"):
            intersection(ensembles, star())
