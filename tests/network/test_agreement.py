"""Agreement of ensembles: the pull's defect, exact fused moments, lost messages, honest spread."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from distfilt.ensembles import mean, sample_covariance
from distfilt.gaussians import bures_barycentre, recolour
from distfilt.network import Channel, Faults, UnstableGain, Weights, graphs
from distfilt.network.agreement import barycentre, intersection, pull
from distfilt.network.consensus import average
from distfilt.network.fusion import covariance_intersection
from tests.network.helpers import NAN, STAR, lossy, rng, star

SIZES = np.logspace(-1, 2, 4)
RULES = (intersection, partial(intersection, rule="equal"), partial(barycentre, scale=SIZES))
_A = "distfilt.network.agreement."


def _ensembles(
    seed: int, leading: tuple[int, ...] = (3,), n: int = 40, d: int = 4
) -> np.ndarray:
    """Ensembles with other means and covariances each, components of different size."""
    draw = rng(seed)
    mixing = np.eye(d) + 0.4 * draw.standard_normal((*leading, d, d))
    shift = draw.standard_normal((*leading, 1, d))
    return (draw.standard_normal((*leading, n, d)) @ mixing + shift) * np.logspace(-1, 2, d)


_E = _ensembles(0)


def _cases(rule: object) -> list[tuple[str, object]]:
    return [
        ("ensembles", lambda: rule(_E[:2], star())),
        ("ensembles", lambda: rule(NAN * _E, star())),
        ("ensembles", lambda: rule(_E[:, :4], star())),
        ("ensembles", lambda: rule(np.zeros_like(_E), star())),
        ("ensembles", lambda: rule(_E[..., [0, 0]], star())),
        ("ensembles", lambda: rule(_E[..., [0, 1]] @ [[1.0, 1, 2], [1, -1, 3]], star())),
        ("channel", lambda: rule(_E, STAR)),
        ("channel", lambda: rule(_E, None)),
        ("rounds", lambda: rule(_E, star(), rounds=0)),
    ]


BAD_INPUT = {
    _A + "intersection": [
        *_cases(intersection),
        ("rule", lambda: intersection(_E, star(), rule="best")),
        ("weights", lambda: intersection(_E, star(), weights=np.ones((3, 3)) / 3)),
        ("weights", lambda: intersection(_E, star(), weights=0.9 * np.eye(3))),
        ("scale", lambda: intersection(_E, star(), scale=[1.0])),
        ("scale", lambda: intersection(_E, star(), scale=np.zeros(4))),
    ],
    _A + "barycentre": [
        *_cases(barycentre),
        ("scale", lambda: barycentre(_E, star(), scale=-SIZES)),
        ("tolerance", lambda: barycentre(_E, star(), tolerance=0.0)),
    ],
    _A + "pull": [
        ("ensembles", lambda: pull(np.zeros((3, 1)), star(), gain=0.1)),
        ("ensembles", lambda: pull(NAN * _E, star(), gain=0.1)),
        ("channel", lambda: pull(_E, STAR, gain=0.1)),
        ("gain", lambda: pull(_E, star(), gain=-0.1)),
        ("rounds", lambda: pull(_E, star(), gain=0.1, rounds=0)),
    ],
}


def _gap(cov: np.ndarray, wanted: np.ndarray) -> float:
    """Largest difference in units of the standard deviations."""
    unit = np.sqrt(np.diagonal(wanted, axis1=-2, axis2=-1))
    return float(np.abs((cov - wanted) / (unit[..., :, None] * unit[..., None, :])).max())


def test_a_pull_moves_means_by_averaging() -> None:
    e = rng(1).standard_normal((3, 20, 2))
    means = average(e.mean(axis=1), star(), gain=0.1, rounds=4)
    for include in (True, False):
        pulled = pull(e, star(), gain=0.1, rounds=4, include_self=include)
        assert np.allclose(pulled.mean(axis=1), means, atol=1e-13)


@pytest.mark.parametrize("include", [True, False])
def test_a_pull_shrinks_the_spread(include: bool) -> None:
    """The exact defect of (16): anomalies are multiplied by 1 - γ|Nbs| in every round."""
    e = rng(1).standard_normal((3, 20, 2))
    pulled = pull(e, star(), gain=0.05, rounds=2, include_self=include)
    shrink = (1 - 0.05 * (np.array([2, 1, 1]) + include)) ** 2
    before, after = (v - v.mean(axis=1, keepdims=True) for v in (e, pulled))
    assert np.allclose(after, shrink[:, None, None] * before, atol=1e-13)


def test_a_pull_sends_means_only_and_nothing_without_gain() -> None:
    channel = star()
    e = rng(1).standard_normal((3, 20, 2))
    out = pull(e, channel, gain=0.0)
    assert (out == e).all() and out is not e and channel.ledger.rounds == 0
    pull(e, channel, gain=0.1, rounds=2)
    assert (channel.ledger.scalars == 2 * 2 * np.array([2, 1, 1])).all()


def test_a_lost_mean_does_not_pull_and_the_others_do() -> None:
    """Run by run against equation (16) with the neighbours that were heard."""
    e = rng(1).standard_normal((6, 3, 20, 2))
    faults = Faults(loss=0.5, seed=5)
    out = pull(e, star(runs=(6,), faults=faults), gain=0.2, include_self=False)
    gone = faults.lost(STAR, 0, 6)
    assert 0 < gone.sum() < gone.size
    for run in range(6):
        expected = e[run].copy()
        for link, (i, j) in enumerate(zip(STAR.receivers, STAR.senders, strict=True)):
            if not gone[run, link]:
                expected[i] += 0.2 * (e[run, j].mean(axis=0) - e[run, i])
        assert np.abs(out[run] - expected).max() < 1e-14
    assert np.allclose(pull(e[0], lossy(1.0), gain=0.1, include_self=False), e[0], atol=1e-15)


def test_a_pull_beyond_the_bound_warns_once_and_names_both() -> None:
    e = rng(1).standard_normal((3, 20, 2))
    with pytest.warns(UnstableGain, match=r"gain: 0\.9 is above 2/λ_max = 0\.6666") as caught:
        pull(e, star(), gain=0.9, rounds=3)
    assert len(caught) == 1 and caught[0].filename == __file__
    pull(e, star(), gain=0.66)


@pytest.mark.parametrize("rule", ["equal", "trace", "determinant", "min_trace", "min_determinant"])
def test_intersection_gives_the_fused_moments(rule: str) -> None:
    e = _ensembles(3, (5, 3))
    fused = covariance_intersection(
        mean(e), sample_covariance(e), star(runs=(5,)), rule=rule, rounds=2
    )
    channel = star(runs=(5,))
    out = intersection(e, channel, rule=rule, rounds=2)
    assert np.abs((mean(out) - fused[0]) / e.std(axis=-2)).max() < 1e-10
    assert _gap(sample_covariance(out), fused[1]) < 1e-10
    # 4 + 10 numbers on each link and round.
    assert (channel.ledger.scalars == 2 * 14 * np.array([2, 1, 1])).all()


def test_intersection_by_given_weights() -> None:
    e = _ensembles(3)
    w = np.array([[0.5, 0.3, 0.2], [0.4, 0.6, 0.0], [0.0, 0.0, 1.0]])
    fused = covariance_intersection(mean(e), sample_covariance(e), star(), weights=w)
    out = intersection(e, star(), weights=w)
    assert np.abs((mean(out) - fused[0]) / e.std(axis=-2)).max() < 1e-10
    assert np.allclose(out[2], e[2], rtol=1e-9, atol=1e-9)
    assert (intersection(e, star(), weights=Weights.from_matrix(STAR, w)) == out).all()


def test_the_default_weights_give_the_least_determinant() -> None:
    e = _ensembles(7)
    sizes = [
        np.linalg.slogdet(sample_covariance(intersection(e, star(), **options)))[1]
        for options in ({}, {"rule": "equal"}, {"rule": "trace", "scale": SIZES},
                        {"rule": "determinant"}, {"rule": "min_trace", "scale": SIZES})
    ]
    assert all((sizes[0] <= other + 1e-9).all() for other in sizes[1:])
    assert (sizes[0] < sizes[1] - 1e-3).any()


def test_scale_matters_to_traces_only() -> None:
    e, size = _ensembles(4), SIZES
    for rule, same in (("equal", True), ("determinant", True), ("trace", False),
                       ("min_determinant", True), ("min_trace", False)):
        plain = intersection(e, star(), rule=rule)
        scaled = intersection(e, star(), rule=rule, scale=size)
        assert np.allclose(plain, scaled, rtol=1e-6, atol=1e-6) == same
        by_hand = intersection(e / size, star(), rule=rule) * size
        assert np.allclose(scaled, by_hand)


def test_the_barycentre_s_moments() -> None:
    """Of the own and all heard, with equal weights."""
    e = _ensembles(8) / SIZES
    m, p = mean(e), sample_covariance(e)
    out = barycentre(e, star())
    assert np.allclose(barycentre(e * SIZES, star(), scale=SIZES), out * SIZES, rtol=1e-9)
    assert np.allclose(mean(out)[0], m.mean(axis=0)) and np.allclose(mean(out)[1], m[:2].mean(0))
    assert _gap(sample_covariance(out)[0], bures_barycentre(p, np.full(3, 1 / 3))) < 1e-9
    assert _gap(sample_covariance(out)[2], bures_barycentre(p[[2, 0]], [0.5, 0.5])) < 1e-9


@pytest.mark.parametrize("factor", [1e-8, 1e8])
def test_tolerances_are_relative(factor: float) -> None:
    e = _ensembles(8)
    for rule in RULES:
        assert np.allclose(rule(factor * e, star()) / factor, rule(e, star()), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("rule", RULES)
def test_a_lost_message_is_left_out(rule: object) -> None:
    """Run by run: with everything lost an ensemble stays; with one lost, as if never sent."""
    e = _ensembles(5)
    deaf = rule(e, star(faults=Faults(loss=1.0, seed=0)))
    assert np.abs(deaf - e).max() < 1e-9 * np.abs(e).max()
    faults = Faults(loss=0.5, seed=3)
    runs = np.stack([e] * 40)
    out = rule(runs, star(runs=(40,), faults=faults))
    alone, both = e[1], rule(e, star())[1]
    gone = faults.lost(STAR, 0, 40)[:, (STAR.receivers == 1)][:, 0]
    expected = np.where(gone[:, None, None], alone, both)
    assert np.allclose(out[:, 1], expected, rtol=1e-6) and 8 < gone.sum() < 32


@pytest.mark.parametrize("rule", RULES)
def test_equal_ensembles_stay(rule: object) -> None:
    e = np.stack([_ensembles(6, ())] * 3)
    assert np.abs(rule(e, star()) - e).max() < 1e-8 * np.abs(e).max()


@pytest.mark.parametrize("rule", [*RULES, partial(pull, gain=0.1)])
def test_a_perturbation_travels_one_hop_a_round(rule: object) -> None:
    e = _ensembles(2, (6,))
    other = e.copy()
    # Far from the others, so that an iteration over all at once would take more sweeps.
    other[0] = _ensembles(12, ()) * [1, 30, 1, 0.01]
    for loss in (0.0, 0.3):
        a, b = (rule(v, lossy(loss, graphs.path(6)), rounds=2) for v in (e, other))
        assert (a[3:] == b[3:]).all() and (loss > 0 or (a[:3] != b[:3]).any(axis=(1, 2)).all())


@pytest.mark.parametrize("rule", [*RULES, partial(pull, gain=0.1)])
def test_inputs_are_left_alone(rule: object) -> None:
    e = _ensembles(9)
    before = e.copy()
    out = rule(e, star())
    assert (e == before).all() and not np.shares_memory(out, e)


def _nees(rule: object) -> tuple[float, np.ndarray]:
    """A drifting pair of numbers; agent 0 sees the first, 1 the second, 2 nothing: NEES / d."""
    draw, graph, runs = rng(8), graphs.path(3), 20
    truth = draw.standard_normal((runs, 2))
    e = draw.standard_normal((runs, 3, 60, 2))
    total, errors = [], []
    for k in range(30):
        truth = truth + np.sqrt(0.1) * draw.standard_normal(truth.shape)
        e = e + np.sqrt(0.1) * draw.standard_normal(e.shape)
        for a in (0, 1):
            y = truth[:, a] + 0.5 * draw.standard_normal(runs)
            m, p = mean(e[:, a]), sample_covariance(e[:, a])
            gain = p[:, :, a] / (p[:, a, a] + 0.25)[:, None]
            m = m + gain * (y - m[:, a])[:, None]
            p = p - gain[:, :, None] * p[:, a, None, :]
            e[:, a] = recolour(e[:, a], m, 0.5 * (p + np.swapaxes(p, 1, 2)))
        e = rule(e, Channel(graph, runs=(runs,)))
        if k >= 10:
            gap = mean(e) - truth[:, None]
            solved = np.linalg.solve(sample_covariance(e), gap[..., None])[..., 0]
            total.append((gap * solved).sum(axis=-1).mean() / 2)
            errors.append((gap**2).mean(axis=(0, 2)))
    return float(np.mean(total)), np.mean(errors, axis=0)


def test_rules_keep_a_filter_honest() -> None:
    """Intersection and barycentre keep NEES / d near 1 and help the blind; a pull destroys it."""
    alone = _nees(lambda e, channel: e)[1]
    pulled = _nees(partial(pull, gain=0.2))[0]
    for rule in (intersection, partial(intersection, rule="trace"), barycentre):
        nees, errors = _nees(rule)
        assert 0.5 < nees < 1.3 < pulled
        assert errors[2] < 0.8 * alone[2]
