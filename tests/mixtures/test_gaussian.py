"""Gaussian mixtures against scipy, against quadrature, and against identities."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from distfilt.mixtures import ExponentialQuadratics, GaussianMixture
from distfilt.network import Channel, graphs

from .examples import random_mixture

ONE = GaussianMixture.gaussian([1.0, 2.0], [[2.0, 0.5], [0.5, 1.0]])
GAP = [[-1.0], [1.0]]
UNIT = [[[1.0]], [[1.0]]]
TERMS = ExponentialQuadratics([[[1.0]]], [[0.0]], [0.0])

BAD_INPUT = {
    "distfilt.mixtures.gaussian.GaussianMixture": [
        ("weights", lambda: GaussianMixture([1.5, -0.5], GAP, UNIT)),
        ("weights", lambda: GaussianMixture([0.5, 0.6], GAP, UNIT)),
        ("weights", lambda: GaussianMixture([], np.empty((0, 1)), np.empty((0, 1, 1)))),
        ("weights", lambda: GaussianMixture([[0.5, 0.5]], GAP, UNIT)),
        ("means", lambda: GaussianMixture([0.5, 0.5], [[1.0]], UNIT)),
        ("means", lambda: GaussianMixture([0.5, 0.5], [[1.0], [np.nan]], UNIT)),
        ("means", lambda: GaussianMixture([1.0], np.empty((1, 0)), np.empty((1, 0, 0)))),
        ("covs", lambda: GaussianMixture([0.5, 0.5], GAP, [[[1.0]]])),
        ("covs", lambda: GaussianMixture([0.5, 0.5], GAP, [[[1.0]], [[-1.0]]])),
        ("covs", lambda: GaussianMixture([1.0], [[0.0, 0.0]], [[[1.0, 0.2], [0.1, 1.0]]])),
        ("covs", lambda: GaussianMixture([1.0], [[0.0, 0.0]], [[[1.0, 2.0], [2.0, 1.0]]])),
    ],
    "distfilt.mixtures.gaussian.GaussianMixture.gaussian": [
        ("cov", lambda: GaussianMixture.gaussian([0.0], np.eye(2))),
    ],
    "distfilt.mixtures.gaussian.GaussianMixture.log_density": [
        ("x", lambda: ONE.log_density([1.0, 2.0, 3.0])),
    ],
    "distfilt.mixtures.gaussian.GaussianMixture.marginal": [
        ("indices", lambda: ONE.marginal([0, 0])),
        ("indices", lambda: ONE.marginal([2])),
        ("indices", lambda: ONE.marginal([-1])),
        ("indices", lambda: ONE.marginal([])),
    ],
    "distfilt.mixtures.gaussian.GaussianMixture.conditional": [
        ("indices", lambda: ONE.conditional([0, 1], [0.0, 0.0])),
        ("values", lambda: ONE.conditional([0], [0.0, 0.0])),
    ],
    "distfilt.mixtures.gaussian.GaussianMixture.sample": [
        ("n", lambda: ONE.sample(0, rng=np.random.default_rng(0))),
        ("rng", lambda: ONE.sample(3, rng=0)),  # type: ignore[arg-type]
    ],
    "distfilt.mixtures.gaussian.GaussianMixture.product": [
        ("other", lambda: ONE.product(GaussianMixture.gaussian([0.0], [[1.0]]))),
        ("other", lambda: ONE.product(3)),  # type: ignore[arg-type]
    ],
    "distfilt.mixtures.gaussian.GaussianMixture.unpack": [
        ("payload", lambda: GaussianMixture.unpack(ONE.pack()[:2])),
        ("payload", lambda: GaussianMixture.unpack((*ONE.pack()[:2], np.zeros((1, 4))))),
        ("covs", lambda: GaussianMixture.unpack((*ONE.pack()[:2], np.zeros((1, 3))))),
    ],
    "distfilt.mixtures.gaussian.GaussianMixture.from_quadratics": [
        ("terms", lambda: GaussianMixture.from_quadratics(TERMS.power(-1.0))),
        ("terms", lambda: GaussianMixture.from_quadratics(
            ExponentialQuadratics([[[1.0]]], [[0.0]], [-np.inf]))),
    ],
    "distfilt.mixtures.quadratics.ExponentialQuadratics": [
        ("log_coefficients", lambda: ExponentialQuadratics([[[1.0]]], [[0.0]], [np.nan])),
        ("log_coefficients", lambda: ExponentialQuadratics([[[1.0]]], [[0.0]], [np.inf])),
        ("vectors", lambda: ExponentialQuadratics([[[1.0]]], [[0.0], [1.0]], [0.0])),
        ("precisions", lambda: ExponentialQuadratics([np.array([[1, 2], [0, 1]])], [[0, 0]], [0])),
    ],
    "distfilt.mixtures.quadratics.ExponentialQuadratics.times": [
        ("other", lambda: TERMS.times(ONE.quadratics())),
    ],
    "distfilt.mixtures.quadratics.ExponentialQuadratics.power": [
        ("exponent", lambda: TERMS.power(np.nan)),
        ("exponent", lambda: ExponentialQuadratics([[[1.0]]], [[0.0]], [-np.inf]).power(-1.0)),
    ],
}


@pytest.mark.parametrize(("size", "dim"), [(1, 1), (3, 3), (5, 2), (2, 6)])
def test_log_density_is_scipys(size: int, dim: int) -> None:
    p = random_mixture(size, dim, 10 * size + dim)
    x = np.random.default_rng(0).standard_normal((4, 7, dim)) * 3
    wanted = sum(
        w * multivariate_normal(m, c).pdf(x)
        for w, m, c in zip(p.weights, p.means, p.covs, strict=True)
    )
    assert p.log_density(x).shape == (4, 7)
    assert np.allclose(p.log_density(x), np.log(wanted), rtol=1e-11)
    parts = p.component_log_densities(x)
    assert parts.shape == (4, 7, size)
    for k in range(size):
        assert np.allclose(parts[..., k], multivariate_normal(p.means[k], p.covs[k]).logpdf(x))


def test_many_points_are_evaluated_in_blocks() -> None:
    p = random_mixture(40, 3, 1)
    x = np.random.default_rng(0).standard_normal((40_000, 3))
    few = np.arange(0, 40_000, 1777)
    assert np.allclose(p.log_density(x)[few], p.log_density(x[few]), rtol=1e-13)
    assert np.allclose(p.component_log_densities(x)[few], p.component_log_densities(x[few]))


def test_tails_do_not_underflow() -> None:
    p = GaussianMixture([0.5, 0.5], [[0.0], [1e4]], [[[1.0]], [[4.0]]])
    assert np.isclose(p.log_density([5e3]), np.log(0.5) - 0.5 * np.log(8 * np.pi) - 0.125 * 25e6)
    assert np.isfinite(p.log_density([-1e8]))
    zero = GaussianMixture([1.0, 0.0], [[0.0], [1.0]], UNIT)
    assert np.isclose(zero.log_density([0.0]), -0.5 * np.log(2 * np.pi))


def test_density_keeps_its_digits_far_from_the_origin() -> None:
    near = random_mixture(4, 3, 2)
    far = GaussianMixture(near.weights, near.means + 4.2e7, near.covs)
    x = np.random.default_rng(0).standard_normal((20, 3)) * 3
    assert np.allclose(far.log_density(x + 4.2e7), near.log_density(x), atol=1e-6)


def test_marginal_and_conditional_make_the_joint() -> None:
    p = random_mixture(4, 5, 3)
    known, rest = [3, 0], [1, 2, 4]
    for x in np.random.default_rng(1).standard_normal((5, 5)) * 2:
        joint = p.marginal(known).log_density(x[known])
        joint = joint + p.conditional(known, x[known]).log_density(x[rest])
        assert np.isclose(joint, p.log_density(x), rtol=1e-11)


def test_conditional_far_in_the_tails_is_the_nearest_mixand() -> None:
    p = GaussianMixture([0.9, 0.1], [[0.0, 0.0], [50.0, 7.0]], [np.eye(2), np.eye(2)])
    rest = p.conditional([0], [100.0])
    assert np.allclose(rest.weights, [0.0, 1.0]) and rest.means[1, 0] == 7.0
    assert np.isfinite(rest.log_density([7.0]))


def test_moments_are_the_samples() -> None:
    p = random_mixture(3, 3, 4)
    mean, cov = p.moments()
    x = p.sample(200_000, rng=np.random.default_rng(2))
    # Five standard errors.
    assert np.abs(x.mean(axis=0) - mean).max() < 5 * np.sqrt(np.diag(cov).max() / 200_000)
    assert np.abs(np.cov(x, rowvar=False) - cov).max() < 0.02 * np.abs(cov).max()
    assert np.allclose(p.collapsed().moments()[1], cov) and p.collapsed().size == 1
    gap = p.means - p.weights @ p.means
    by_hand = sum(
        w * (c + np.outer(g, g)) for w, c, g in zip(p.weights, p.covs, gap, strict=True)
    )
    assert np.allclose(cov, by_hand, rtol=1e-13)


def test_product_is_the_product() -> None:
    p, q = random_mixture(3, 2, 5), random_mixture(2, 2, 6)
    both, log_integral = p.product(q)
    assert both.size == 6
    x = np.random.default_rng(3).standard_normal((9, 2)) * 2
    wanted = p.log_density(x) + q.log_density(x) - log_integral
    assert np.allclose(both.log_density(x), wanted, rtol=1e-10)
    # The order: those of the other run fastest.
    single, _ = GaussianMixture.gaussian(p.means[1], p.covs[1]).product(q)
    assert np.allclose(both.means[2:4], single.means)


@given(st.floats(-3, 3), st.integers(1, 4), st.integers(0, 50))
def test_quadratics_have_the_value_of_the_density(power: float, size: int, seed: int) -> None:
    p = random_mixture(size, 2, seed)
    x = np.random.default_rng(seed).standard_normal((3, 2)) * 3
    assert np.allclose(p.quadratics().log_value(x), p.log_density(x), atol=1e-8)
    one = GaussianMixture.gaussian(p.means[0], p.covs[0])
    assert np.allclose(
        one.quadratics().power(power).log_value(x), power * one.log_density(x), atol=1e-7
    )


def test_a_quotient_of_equals_is_one_and_indefinite_terms_can_be_evaluated() -> None:
    p = random_mixture(1, 3, 8)
    ratio = p.quadratics().times(p.quadratics().power(-1.0))
    assert np.abs(ratio.precisions).max() < 1e-12
    assert np.abs(ratio.log_value(np.ones((4, 3)))).max() < 1e-9
    wide = GaussianMixture.gaussian(p.means[0], 2 * p.covs[0])
    quotient = wide.quadratics().times(p.quadratics().power(-1.0))
    assert (np.linalg.eigvalsh(quotient.precisions) < 0).all()
    x = np.random.default_rng(1).standard_normal((5, 3))
    assert np.allclose(quotient.log_value(x), wide.log_density(x) - p.log_density(x))


def test_pack_goes_through_a_channel_and_every_number_is_charged() -> None:
    p = random_mixture(3, 4, 9)
    channel = Channel(graphs.path(2))
    inbox = channel.exchange([p.pack(), None])
    got = GaussianMixture.unpack(inbox[1][0])
    assert (got.weights == p.weights).all() and (got.means == p.means).all()
    assert (got.covs == p.covs).all()
    assert channel.ledger.scalars.tolist() == [3 * (1 + 4 + 10), 0]


def test_input_is_not_changed_and_an_extreme_weight_is_kept() -> None:
    w = np.array([1 - 1e-320, 1e-320])
    m, c = np.zeros((2, 2)), np.stack([np.eye(2)] * 2)
    before = m.copy(), c.copy(), w.copy()
    p = GaussianMixture(w, m, c)
    p.moments()
    p.marginal([1]).log_density([[0.0]])
    assert all((a == b).all() for a, b in zip((m, c, w), before, strict=True))
