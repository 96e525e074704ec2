"""Agreement of ensembles: exact moments, the least movement, lost messages, use in a filter."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.checks import SolverError
from distfilt.ensembles import mean, sample_covariance
from distfilt.filters import EnsembleFilter
from distfilt.filters.agreement import (
    barycentre_agreement,
    bures_barycentre,
    intersection_agreement,
    recolour,
)
from distfilt.models import LinearModel
from distfilt.network import Channel, Faults, graphs
from distfilt.network.consensus import mean_pull
from distfilt.network.fusion import covariance_intersection
from distfilt.sensors import direct
from distfilt.triangular.regularised import known_noise_update

NAN = float("nan")
SIZES = np.logspace(-1, 2, 4)
RULES = (intersection_agreement, partial(barycentre_agreement, scale=SIZES))


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def _ensembles(
    seed: int, leading: tuple[int, ...] = (3,), n: int = 40, d: int = 4
) -> np.ndarray:
    """Ensembles with other means and covariances each, components of different size."""
    rng = _rng(seed)
    mixing = np.eye(d) + 0.4 * rng.standard_normal((*leading, d, d))
    shift = rng.standard_normal((*leading, 1, d))
    return (rng.standard_normal((*leading, n, d)) @ mixing + shift) * np.logspace(-1, 2, d)


def _star(**options: object) -> Channel:
    return Channel(graphs.star(3), **options)


_E = _ensembles(0)
_P = np.tile(np.eye(2), (3, 1, 1))
_F = "distfilt.filters.agreement."


def _cases(rule: object) -> list[tuple[str, object]]:
    return [
        ("ensembles", lambda: rule(_E[:2], _star())),
        ("ensembles", lambda: rule(NAN * _E, _star())),
        ("ensembles", lambda: rule(_E[:, :4], _star())),
        ("ensembles", lambda: rule(np.zeros_like(_E), _star())),
        ("ensembles", lambda: rule(_E[..., [0, 0]], _star())),
        ("channel", lambda: rule(_E, graphs.star(3))),
        ("rounds", lambda: rule(_E, _star(), rounds=0)),
    ]


BAD_INPUT = {
    _F + "intersection_agreement": [
        *_cases(intersection_agreement),
        ("weights", lambda: intersection_agreement(_E, _star(), weights="best")),
        ("scale", lambda: intersection_agreement(_E, _star(), scale=[1.0])),
        ("scale", lambda: intersection_agreement(_E, _star(), scale=np.zeros(4))),
    ],
    _F + "barycentre_agreement": [
        *_cases(barycentre_agreement),
        ("scale", lambda: barycentre_agreement(_E, _star(), scale=-SIZES)),
        ("tolerance", lambda: barycentre_agreement(_E, _star(), tolerance=0.0)),
    ],
    _F + "bures_barycentre": [
        ("covs", lambda: bures_barycentre(np.eye(2), [1.0])),
        ("covs", lambda: bures_barycentre(-_P, np.full(3, 1 / 3))),
        ("weights", lambda: bures_barycentre(_P, [0.5, 0.5])),
        ("weights", lambda: bures_barycentre(_P, [0.5, 0.7, -0.2])),
        ("tolerance", lambda: bures_barycentre(_P, np.full(3, 1 / 3), tolerance=-1.0)),
        ("iterations", lambda: bures_barycentre(_P, np.full(3, 1 / 3), iterations=0)),
    ],
    _F + "recolour": [
        ("ensemble", lambda: recolour([1.0], [1.0], [[1.0]])),
        ("ensemble", lambda: recolour([[1.0], [1.0]], [1.0], [[1.0]])),
        ("ensemble", lambda: recolour([[1.0]], [1.0], [[1.0]])),
        ("mean", lambda: recolour([[0.0], [1.0]], [1.0, 2.0], [[1.0]])),
        ("cov", lambda: recolour([[0.0], [1.0]], [1.0], [[-1.0]])),
        ("cov", lambda: recolour([[0.0], [1.0]], [1.0], np.eye(2))),
    ],
}


def _gap(cov: np.ndarray, wanted: np.ndarray) -> float:
    """Largest difference in units of the standard deviations."""
    unit = np.sqrt(np.diagonal(wanted, axis1=-2, axis2=-1))
    return float(np.abs((cov - wanted) / (unit[..., :, None] * unit[..., None, :])).max())


@given(st.integers(0, 10_000), st.integers(1, 13))
def test_recoloured_moments_are_exact(seed: int, d: int) -> None:
    e = _ensembles(seed, (2,), 60, d)
    other = _ensembles(seed + 1, (2,), 60, d)
    wanted = mean(other), sample_covariance(other)
    out = recolour(e, *wanted)
    assert np.abs((mean(out) - wanted[0]) / other.std(axis=1)).max() < 1e-10
    assert _gap(sample_covariance(out), wanted[1]) < 1e-10


def test_recolouring_is_symmetric_and_moves_the_members_least() -> None:
    e, other = _ensembles(1, ()), _ensembles(2, ())
    cov = sample_covariance(other)
    unit = np.sqrt(cov.diagonal())
    e, cov = e / unit, cov / np.outer(unit, unit)
    out = recolour(e, mean(e), cov)
    a = np.linalg.lstsq(e - mean(e), out - mean(e), rcond=None)[0].T
    assert np.abs(a - a.T).max() < 1e-9 * np.abs(a).max()
    assert (np.linalg.eigvalsh(0.5 * (a + a.T)) > 0).all()
    # Cholesky factors give the same covariance by a longer way.
    step = np.linalg.solve(np.linalg.cholesky(sample_covariance(e)), (e - mean(e)).T)
    longer = mean(e) + (np.linalg.cholesky(cov) @ step).T
    assert _gap(sample_covariance(longer), cov) < 1e-10
    assert ((out - e) ** 2).sum() < ((longer - e) ** 2).sum()
    assert np.abs(recolour(e, mean(e), sample_covariance(e)) - e).max() < 1e-10 * np.abs(e).max()


@pytest.mark.parametrize("weights", ["fixed", "trace", "determinant"])
def test_intersection_gives_the_fused_moments(weights: str) -> None:
    e = _ensembles(3, (5, 3))
    fused = covariance_intersection(
        mean(e), sample_covariance(e), _star(runs=(5,)), weights=weights, rounds=2
    )
    channel = _star(runs=(5,))
    out = intersection_agreement(e, channel, weights=weights, rounds=2)
    assert np.abs((mean(out) - fused[0]) / e.std(axis=-2)).max() < 1e-10
    assert _gap(sample_covariance(out), fused[1]) < 1e-10
    # 4 + 10 numbers on each link and round.
    assert (channel.ledger.scalars == 2 * 14 * np.array([2, 1, 1])).all()


def test_scale_matters_to_traces_only() -> None:
    e, size = _ensembles(4), SIZES
    for weights, same in (("fixed", True), ("determinant", True), ("trace", False)):
        plain = intersection_agreement(e, _star(), weights=weights)
        scaled = intersection_agreement(e, _star(), weights=weights, scale=size)
        assert np.allclose(plain, scaled, rtol=1e-9, atol=1e-9) == same
    by_hand = intersection_agreement(e / size, _star(), weights="trace") * size
    assert np.allclose(intersection_agreement(e, _star(), weights="trace", scale=size), by_hand)


@pytest.mark.parametrize("rule", RULES)
def test_a_lost_message_is_left_out(rule: object) -> None:
    """Run by run: with everything lost an ensemble stays; with one lost, as if never sent."""
    e = _ensembles(5)
    deaf = rule(e, _star(faults=Faults(loss=1.0, seed=0)))
    assert np.abs(deaf - e).max() < 1e-9 * np.abs(e).max()
    faults = Faults(loss=0.5, seed=3)
    runs = np.stack([e] * 40)
    out = rule(runs, _star(runs=(40,), faults=faults))
    alone, both = e[1], rule(e, _star())[1]
    heard = np.array([np.allclose(o, both, rtol=1e-6) for o in out[:, 1]])
    missed = np.array([np.allclose(o, alone, rtol=1e-6) for o in out[:, 1]])
    assert (heard ^ missed).all() and 8 < heard.sum() < 32


@pytest.mark.parametrize("rule", RULES)
def test_equal_ensembles_stay(rule: object) -> None:
    e = np.stack([_ensembles(6, ())] * 3)
    assert np.abs(rule(e, _star()) - e).max() < 1e-8 * np.abs(e).max()


@given(st.integers(0, 10_000), st.integers(1, 6))
def test_barycentre_solves_its_equation(seed: int, d: int) -> None:
    """S = sum of w (S^1/2 P S^1/2)^1/2, by matrix square roots from scipy."""
    from scipy.linalg import sqrtm

    rng = _rng(seed)
    root = rng.standard_normal((3, d, d))
    covs = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(d)
    weights = rng.dirichlet(np.ones(3))
    s = bures_barycentre(covs, weights, tolerance=1e-12)
    half = np.real(sqrtm(s))
    right = sum(w * np.real(sqrtm(half @ p @ half)) for w, p in zip(weights, covs, strict=True))
    assert np.abs(s - right).max() < 1e-8 * np.abs(s).max()


def test_barycentre_of_commuting_covariances_averages_standard_deviations() -> None:
    covs = np.stack([np.diag([1.0, 4.0]), np.diag([9.0, 16.0])])
    s = bures_barycentre(np.stack([covs, covs]), [[0.5, 0.5], [0.25, 0.75]])
    assert np.allclose(s[0], np.diag([4.0, 9.0])) and np.allclose(s[1], np.diag([6.25, 12.25]))
    with pytest.raises(SolverError, match="iterations"):
        bures_barycentre([np.diag([1.0, 4.0]), [[2.0, 1.0], [1.0, 3.0]]], [0.5, 0.5], iterations=1)


def _study(consensus: object) -> tuple[float, np.ndarray]:
    """A drifting pair of numbers; agent 0 sees the first, 1 the second, 2 nothing: NEES / d."""
    walk = LinearModel.from_transition(2, lambda dt: np.eye(2), lambda t, dt: 0.1 * dt * np.eye(2))
    sensors = [direct([0], noise=0.5), direct([1], noise=0.5), None]
    f = EnsembleFilter(
        walk, sensors, graphs.path(3), known_noise_update, consensus=consensus, members=60
    )
    rng, runs = _rng(8), 20
    truth = np.cumsum(np.sqrt(0.1) * rng.standard_normal((30, runs, 2)), axis=0)
    seen = truth + 0.5 * rng.standard_normal(truth.shape)
    state = f.start(rng.standard_normal((60, 2)), rng=rng, runs=(runs,))
    run = f.run(state, np.arange(1.0, 31.0), [seen[..., :1], seen[..., 1:], None], truth=truth)
    late = run.isel(time=slice(10, None))
    return float(late["nees"].mean() / 2), np.asarray(late["squared_error"].mean(("time", "run")))


def test_rules_serve_a_filter_and_keep_it_honest() -> None:
    """Intersection and barycentre keep NEES / d near 1 and help the blind; a pull destroys it."""
    pull = _study(partial(mean_pull, gain=0.2))[0]
    for rule in (partial(intersection_agreement, weights="trace"), barycentre_agreement):
        nees, _ = _study(rule)
        assert 0.4 < nees < 1.3 < pull


def test_inputs_are_left_alone() -> None:
    e = _ensembles(9)
    before = e.copy()
    for rule in RULES:
        rule(e, _star())
    recolour(e[0], mean(e[1]), sample_covariance(e[1]))
    assert (e == before).all()
