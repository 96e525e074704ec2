"""Weights, four ways to resample, and jitter."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.updates import Particles, effective_size, jitter, resample, resampled
from distfilt.updates.particles import RESAMPLING


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@given(seed=st.integers(0, 10**6), n=st.integers(1, 60), rule=st.sampled_from(RESAMPLING))
def test_counts_are_where_the_rule_says(seed: int, n: int, rule: str) -> None:
    draws = rng(seed)
    w = draws.dirichlet(np.full(n, 0.3), size=3)
    picked = resampled(w, rng=draws, rule=rule)
    assert picked.shape == (3, n) and picked.min() >= 0 and picked.max() < n
    assert (w[np.arange(3)[:, None], picked] > 0).all()
    counts = np.array([np.bincount(row, minlength=n) for row in picked])
    if rule == "systematic":
        assert np.abs(counts - n * w).max() < 1 + 1e-9
    if rule == "stratified":
        assert np.abs(counts - n * w).max() < 2 + 1e-9
    if rule == "residual":
        assert (counts >= np.floor(n * w - 1e-9)).all()
        assert np.abs(counts - n * w).max() < 1 + 1e-9


@pytest.mark.parametrize("rule", RESAMPLING)
def test_resampling_is_unbiased(rule: str) -> None:
    w = np.array([0.5, 0.1, 0.0, 0.4])
    points = np.tile(np.arange(4.0)[:, None], (20_000, 1, 1))
    cloud = Particles(points, np.tile(np.log(w + 1e-300), (20_000, 1)))
    fresh = resample(cloud, rng=rng(13), rule=rule)
    shares = np.bincount(fresh.points.astype(int).ravel(), minlength=4) / fresh.points.size
    # Four standard errors of the loosest rule, independent draws.
    assert np.allclose(shares, w, atol=4 * 0.5 / np.sqrt(80_000))
    assert np.allclose(effective_size(fresh.log_weights), 4.0)


def test_systematic_has_the_smallest_variance_and_multinomial_the_largest() -> None:
    w = np.tile(rng(2).dirichlet(np.ones(30)), (4000, 1))
    spread = {
        rule: np.var(np.array([np.bincount(p, minlength=30) for p in
                               resampled(w, rng=rng(3), rule=rule)]), axis=0).mean()
        for rule in RESAMPLING
    }
    assert spread["systematic"] < spread["stratified"] < 0.7 * spread["multinomial"]
    assert spread["residual"] < 0.7 * spread["multinomial"]


def test_systematic_is_the_inverse_of_the_distribution_function() -> None:
    w = rng(5).dirichlet(np.full(50, 0.2), size=4)
    picked = resampled(w, rng=rng(6))
    offset = rng(6).random((4, 1))
    levels = (np.arange(50) + offset) / 50
    wanted = [np.searchsorted(np.cumsum(v) / v.sum(), u, side="right")
              for v, u in zip(w, levels, strict=True)]
    assert np.array_equal(picked, wanted)


def test_effective_size_between_one_and_n() -> None:
    assert effective_size([0.0, -np.inf, -np.inf]) == pytest.approx(1.0)
    assert effective_size(np.full(8, -1e6)) == pytest.approx(8.0)
    assert effective_size(np.log([0.5, 0.5])) == pytest.approx(2.0)


def test_moments_with_weights_far_apart() -> None:
    x = rng(1).standard_normal((6, 2))
    w = np.array([0.1, 0.2, 0.3, 0.15, 0.25, 0.0])
    with np.errstate(divide="ignore"):
        cloud = Particles(x, np.log(w) - 800.0)
    mean = w @ x
    assert np.allclose(cloud.mean, mean)
    assert np.allclose(cloud.covariance, (x - mean).T @ (w[:, None] * (x - mean)))
    assert np.allclose(cloud.weights, w)


def test_jitter_keeps_mean_and_covariance_on_average() -> None:
    x = rng(0).standard_normal((2000, 50, 2)) @ np.array([[1.0, 0.6], [0.0, 0.4]])
    out = jitter(x, rng=rng(1), bandwidth=0.5)
    gap = out.mean(axis=1) - x.mean(axis=1)
    assert np.abs(gap.mean(axis=0)).max() < 0.01

    def cov(e: np.ndarray) -> np.ndarray:
        a = e - e.mean(axis=1, keepdims=True)
        return (np.swapaxes(a, -1, -2) @ a / e.shape[1]).mean(axis=0)

    # The kernel's own mean takes a share h²/N of its variance.
    assert np.allclose(cov(out), (1 - 0.25 / 50) * cov(x), atol=0.01)
    assert len(np.unique(jitter(np.zeros((9, 1)), rng=rng(), cov=[[1.0]]))) == 9


def test_jitter_s_default_is_silverman_s() -> None:
    x = rng(0).standard_normal((40, 3))
    h = (4 / (40 * 5)) ** (1 / 7)
    assert np.array_equal(jitter(x, rng=rng(1)), jitter(x, rng=rng(1), bandwidth=h))


BAD_INPUT = {
    "distfilt.updates.particles.Particles": [
        ("points", lambda: Particles([1.0], [0.0])),
        ("log_weights", lambda: Particles([[1.0]], [0.0, 0.0])),
        ("log_weights", lambda: Particles([[1.0]], [np.nan])),
        ("log_weights", lambda: Particles([[1.0]], [-np.inf])),
    ],
    "distfilt.updates.particles.effective_size": [
        ("log_weights", lambda: effective_size([np.inf, 0.0])),
    ],
    "distfilt.updates.particles.resampled": [
        ("probabilities", lambda: resampled([0.5, 0.6], rng=rng())),
        ("rule", lambda: resampled([0.5, 0.5], rng=rng(), rule="best")),
        ("rng", lambda: resampled([0.5, 0.5], rng=3)),
    ],
    "distfilt.updates.particles.resample": [
        ("particles", lambda: resample(np.zeros((3, 1)), rng=rng())),
        ("rule", lambda: resample(Particles([[1.0]], [0.0]), rng=rng(), rule="best")),
    ],
    "distfilt.updates.particles.jitter": [
        ("points", lambda: jitter([1.0], rng=rng())),
        ("bandwidth", lambda: jitter([[1.0]], rng=rng(), bandwidth=2.0)),
        ("cov", lambda: jitter([[1.0]], rng=rng(), cov=[[-1.0]])),
    ],
}
EXEMPT = {"distfilt.updates.particles.RESAMPLING": "names"}
