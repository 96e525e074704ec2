"""Fusing Gaussians over a channel: against the definition, agent by agent, run by run."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt import gaussians as pure
from distfilt.network import Channel, Faults, Graph, UnstableGain, Weights, graphs
from distfilt.network.fusion import (
    RULES,
    arithmetic_average,
    consensus_pull,
    covariance_intersection,
    naive_fusion,
)
from tests.network.helpers import REFERENCE, STAR, gaussians, lossy, rng, star

_ZEROS, _EYES = np.zeros((3, 2)), np.tile(np.eye(2), (3, 1, 1))
GAIN = 0.04
ALL = [*(partial(covariance_intersection, rule=r) for r in RULES), naive_fusion,
       arithmetic_average, partial(consensus_pull, gain=GAIN)]
NAMES = [*RULES, "naive", "arithmetic", "pull"]
every = pytest.mark.parametrize("rule", ALL, ids=NAMES)


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


@pytest.mark.parametrize("loss", [0.0, 0.4])
@pytest.mark.parametrize("name", ["path", "star", "grid", "disk"])
@pytest.mark.parametrize(("key", "rule"), list(zip(NAMES, ALL, strict=True)), ids=NAMES)
def test_all_agents_at_once_is_each_by_its_definition(
    key: str, rule: object, name: str, loss: float
) -> None:
    graph = REFERENCE[name]
    m, p = gaussians(3, 2, graph.size, d=3)
    faults = Faults(loss=loss, seed=6)
    out = rule((m, p), Channel(graph, runs=(2,), faults=faults))
    gone = faults.lost(graph, 0, 2)
    unit = np.sqrt(np.diagonal(p, axis1=-2, axis2=-1))
    for run in range(2):
        got = np.zeros((graph.size, graph.size), dtype=bool)
        got[graph.receivers[~gone[run]], graph.senders[~gone[run]]] = True
        means, covs = _by_hand(key, graph, m[run], p[run], got)
        assert np.abs((out[0][run] - means) / unit[run]).max() < 1e-7
        scale = unit[run][:, :, None] * unit[run][:, None, :]
        assert np.abs((out[1][run] - covs) / scale).max() < 1e-7
    assert (out[1] == np.swapaxes(out[1], -1, -2)).all()


@every
def test_the_account_is_mean_and_half_the_covariance(rule: object) -> None:
    only_means = rule is ALL[-1]
    for d, floats in ((1, 2), (6, 27), (13, 104)):
        channel = lossy(0.4)
        rule((np.zeros((3, d)), np.tile(np.eye(d), (3, 1, 1))), channel, rounds=2)
        sent = 2 * (d if only_means else floats) * np.array([2, 1, 1])
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
def test_a_perturbation_travels_one_hop_a_round(rule: object) -> None:
    m, p = gaussians(2, 6)
    other_m, other_p = m.copy(), p.copy()
    other_m[0] += 1.0
    other_p[0] *= 3.0
    for loss in (0.0, 0.3):
        a = rule((m, p), lossy(loss, graphs.path(6)), rounds=2)
        b = rule((other_m, other_p), lossy(loss, graphs.path(6)), rounds=2)
        assert (a[0][3:] == b[0][3:]).all() and (a[1][3:] == b[1][3:]).all()
        assert loss > 0 or (a[0][:3] != b[0][:3]).any(axis=1).all()


@every
def test_late_gaussians_are_those_of_before(rule: object) -> None:
    """With a delay agents fuse their own of now with the neighbours' of a round ago."""
    first, second = gaussians(1, 3), gaussians(2, 3)
    channel = star(faults=Faults(delay=1))
    alone = rule(first, channel)
    assert np.allclose(alone[0], first[0]) and np.allclose(alone[1], first[1])
    late = rule(second, channel)
    for a in range(3):
        mixed_m, mixed_p = first[0].copy(), first[1].copy()
        mixed_m[a], mixed_p[a] = second[0][a], second[1][a]
        expected = rule((mixed_m, mixed_p), star())
        assert np.allclose(late[0][a], expected[0][a], rtol=1e-7)
        assert np.allclose(late[1][a], expected[1][a], rtol=1e-7)


@every
def test_inputs_are_left_alone(rule: object) -> None:
    m, p = gaussians(4, 3)
    before = m.copy(), p.copy()
    out = rule((m, p), star())
    assert (m == before[0]).all() and (p == before[1]).all()
    assert not np.shares_memory(out[0], m) and not np.shares_memory(out[1], p)


@pytest.mark.parametrize("rule", [*ALL[:5], arithmetic_average], ids=[*NAMES[:5], "arithmetic"])
@given(seed=st.integers(0, 1000), d=st.integers(1, 4))
def test_fusing_the_same_belief_changes_nothing(rule: object, seed: int, d: int) -> None:
    m, p = (np.repeat(v[:1], 3, axis=0) for v in gaussians(seed, 1, d=d))
    mean, cov = rule((m + 1e6, p), star())
    assert (mean == m + 1e6).all() and np.allclose(cov, p, rtol=1e-7, atol=1e-12)


@pytest.mark.parametrize("rule", RULES)
@given(seed=st.integers(0, 1000), d=st.integers(1, 3))
def test_covariance_intersection_bounds_the_true_covariance(rule: str, seed: int, d: int) -> None:
    """Whatever the errors' correlation, P - P_true has no negative eigenvalue."""
    draw = rng(seed)
    root = draw.standard_normal((2 * d, 2 * d))
    joint = root @ root.T + 0.1 * np.eye(2 * d)
    covs = np.stack([joint[:d, :d], joint[d:, d:]])
    pair = Channel(graphs.path(2))
    _, fused = covariance_intersection((np.zeros((2, d)), covs), pair, rule=rule)
    # Unit means in place of data read off the linear map from both means to the fused one.
    units = np.eye(2 * d).reshape(2 * d, 2, d)
    many = Channel(graphs.path(2), runs=(2 * d,))
    spread = np.broadcast_to(covs, (2 * d, 2, d, d))
    whole = covariance_intersection((units, spread), many, rule=rule)[0][:, 0].T
    gap = fused[0] - whole @ joint @ whole.T
    assert np.linalg.eigvalsh(gap).min() > -1e-9 * np.abs(fused).max()


@pytest.mark.parametrize("rule", ["equal", "determinant", "min_determinant"])
def test_what_uses_determinants_does_not_depend_on_units(rule: str) -> None:
    m, p = gaussians(1, 3)
    units = np.diag([1000.0, 0.01])
    plain = covariance_intersection((m, p), star(), rule=rule)
    other = covariance_intersection((m @ units, units @ p @ units), star(), rule=rule)
    assert np.allclose(other[0], plain[0] @ units, rtol=1e-6)
    assert np.allclose(other[1], units @ plain[1] @ units, rtol=1e-6)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_closed_weights_by_their_formula(d: int) -> None:
    """Isotropic covariances s² I: both rules give 1 / s², not the determinant's (1 / s²)^d."""
    s2 = np.array([1.0, 2.0, 5.0])
    p = s2[:, None, None] * np.eye(d)
    omega = (1 / s2) / (1 / s2).sum()
    expected = 1 / (omega / s2).sum()
    for rule in ("trace", "determinant"):
        cov = covariance_intersection((np.zeros((3, d)), p), star(), rule=rule)[1]
        assert np.allclose(cov[0], expected * np.eye(d))


def test_given_weights_by_the_definition() -> None:
    m, p = gaussians(5, 3)
    w = np.array([[0.5, 0.3, 0.2], [0.4, 0.6, 0.0], [0.0, 0.0, 1.0]])
    mean, cov = covariance_intersection((m, p), star(), weights=w)
    for i in range(3):
        exact = pure.intersection(m, p, w[i])
        assert np.allclose(mean[i], exact[0]) and np.allclose(cov[i], exact[1])
    as_object = covariance_intersection((m, p), star(), weights=Weights.from_matrix(STAR, w))
    assert (as_object[0] == mean).all()
    other = Graph.from_adjacency(STAR.links.toarray())
    elsewhere = Weights.from_matrix(other, w)
    assert (covariance_intersection((m, p), star(), weights=elsewhere)[0] == mean).all()


def test_given_weights_are_scaled_up_where_messages_are_lost() -> None:
    m, p = gaussians(5, 3)
    w = np.array([[0.5, 0.3, 0.2], [0.4, 0.6, 0.0], [0.1, 0.0, 0.9]])
    loss = np.zeros((3, 3))
    loss[0, 2] = 1.0
    mean, cov = covariance_intersection((m, p), star(faults=Faults(loss=loss)), weights=w)
    exact = pure.intersection(m[:2], p[:2], [0.625, 0.375])
    assert np.allclose(mean[0], exact[0]) and np.allclose(cov[0], exact[1])


def test_naive_fusion_grows_sure_of_one_measurement() -> None:
    """The same datum passed round and round: variance falls, although nothing new was learned."""
    m, p = np.zeros((3, 1)), np.ones((3, 1, 1))
    assert naive_fusion((m, p), star(), rounds=5)[1].max() < 0.02
    assert np.allclose(covariance_intersection((m, p), star(), rounds=5)[1], 1.0)


def test_repeated_intersection_agrees() -> None:
    m, p = gaussians(5, 5)
    mean, cov = covariance_intersection((m, p), Channel(graphs.ring(5)), rounds=60)
    assert np.ptp(mean, axis=0).max() < 1e-6 and np.ptp(cov, axis=0).max() < 1e-6


def test_a_consensus_pull_by_covariance() -> None:
    """Olfati-Saber's gain: γ P / (1 + |P|_F), matrix and all."""
    m, p = gaussians(5, 3)
    mean, cov = consensus_pull((m, p), star(), gain=0.4, rule="covariance")
    for i, near in enumerate([[1, 2], [0], [0]]):
        gain = 0.4 * p[i] / (1 + np.linalg.norm(p[i]))
        assert np.allclose(mean[i], m[i] + gain @ (m[near] - m[i]).sum(axis=0), rtol=1e-12)
    assert (cov == p).all()
    channel = star()
    same = consensus_pull((m, p), channel, gain=0.0)
    assert (same[0] == m).all() and channel.ledger.rounds == 0


def test_a_consensus_pull_beyond_the_bound_warns() -> None:
    m, p = gaussians(5, 3)
    with pytest.warns(UnstableGain, match=r"0\.8 is above 2/λ_max = 0\.6666") as caught:
        consensus_pull((m, p), star(), gain=0.8, rounds=2)
    assert len(caught) == 1 and caught[0].filename == __file__
    consensus_pull((m, 0.1 * _EYES), star(), gain=0.8, rule="covariance")
