"""Gaussian mixtures and divergences against scipy, quadrature and identities."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from distfilt.mixtures import GaussianMixture, jeffreys_by_sampling, jeffreys_of_many
from distfilt.mixtures.reduction import gaussian_divergences as between

from .examples import affine, random_mixture, scales, shuffled

UNIT = [[[1.0]], [[1.0]]]
P = random_mixture(1, 2, 1, 1.0)
Q = random_mixture(1, 2, 2, 1.0)
F = P.log_density
NEAR = GaussianMixture([1.0], P.means + 0.3, P.covs)


@pytest.mark.parametrize(("size", "dim"), [(1, 1), (3, 3), (5, 2), (2, 6)])
def test_log_density_is_scipys(size: int, dim: int) -> None:
    p = random_mixture(size, dim, 10 * size + dim)
    x = np.random.default_rng(0).standard_normal((4, 7, dim)) * 3
    each = zip(p.weights, p.means, p.covs, strict=True)
    wanted = sum(w * multivariate_normal(m, c).pdf(x) for w, m, c in each)
    assert p.log_density(x).shape == (4, 7)
    assert np.allclose(p.log_density(x), np.log(wanted), rtol=1e-11)
    parts = p.component_log_densities(x)
    assert parts.shape == (4, 7, size)
    for k in range(size):
        assert np.allclose(
            parts[..., k], multivariate_normal(p.means[k], p.covs[k]).logpdf(x)
        )


def test_many_points_are_evaluated_in_blocks() -> None:
    p = random_mixture(40, 3, 1)
    x = np.random.default_rng(0).standard_normal((40_000, 3))
    few = np.arange(0, 40_000, 1777)
    assert np.allclose(p.log_density(x)[few], p.log_density(x[few]), rtol=1e-13)
    assert np.allclose(
        p.component_log_densities(x)[few], p.component_log_densities(x[few])
    )


def test_tails_do_not_underflow() -> None:
    p = GaussianMixture([0.5, 0.5], [[0.0], [1e4]], [[[1.0]], [[4.0]]])
    assert np.isclose(
        p.log_density([5e3]), np.log(0.5) - 0.5 * np.log(8 * np.pi) - 0.125 * 25e6
    )
    assert np.isfinite(p.log_density([-1e8]))
    zero = GaussianMixture([1.0, 0.0], [[0.0], [1.0]], UNIT)
    assert np.isclose(zero.log_density([0.0]), -0.5 * np.log(2 * np.pi))


def test_density_in_other_coordinates_and_in_another_order() -> None:
    p = random_mixture(4, 3, 2)
    (matrix, shift) = scales(3)
    x = np.random.default_rng(0).standard_normal((20, 3)) * 3
    there = affine(p, matrix, shift).log_density(x @ matrix.T + shift)
    assert np.allclose(
        there, p.log_density(x) - np.linalg.slogdet(matrix)[1], atol=1e-6
    )
    far = affine(p, np.eye(3), np.full(3, 4.2e7))
    assert np.allclose(far.log_density(x + 4.2e7), p.log_density(x), atol=1e-6)
    assert np.allclose(shuffled(p).log_density(x), p.log_density(x), rtol=1e-13)


def test_a_marginal_is_the_integral() -> None:
    p = random_mixture(3, 2, 3)
    x = np.linspace(-60, 60, 20_001)
    for at in (-1.0, 2.5):
        whole = np.exp(p.log_density(np.column_stack([x, np.full_like(x, at)])))
        part = p.marginal([1]).log_density([at])
        assert np.isclose(np.trapezoid(whole, x), np.exp(part), rtol=1e-9)
    back = p.marginal([1, 0])
    assert np.array_equal(back.means, p.means[:, ::-1])
    assert np.array_equal(back.covs, p.covs[:, ::-1, ::-1])


def test_moments_are_the_draws() -> None:
    p = random_mixture(3, 3, 4)
    x = p.rvs(200_000, rng=np.random.default_rng(2))
    # Five standard errors.
    assert np.abs(x.mean(axis=0) - p.mean).max() < 5 * np.sqrt(
        np.diag(p.cov).max() / 200_000
    )
    assert np.abs(np.cov(x, rowvar=False) - p.cov).max() < 0.02 * np.abs(p.cov).max()
    gap = p.means - p.weights @ p.means
    by_hand = sum(
        w * (c + np.outer(g, g)) for w, c, g in zip(p.weights, p.covs, gap, strict=True)
    )
    assert np.allclose(p.cov, by_hand, rtol=1e-13)
    one = p.moment_match()
    assert (
        one.n_components == 1
        and np.allclose(one.mean, p.mean)
        and np.allclose(one.cov, p.cov)
    )


def test_a_mixture_owns_its_arrays() -> None:
    w = np.array([1 - 1e-320, 1e-320])
    m = np.zeros((2, 2))
    c = np.stack([np.eye(2)] * 2)
    p = GaussianMixture(w, m, c)
    before = p.log_density([0.3, 0.4])
    w[:] = 0.5
    m[:] = 7.0
    c[:] = 4 * np.eye(2)
    assert p.log_density([0.3, 0.4]) == before == p.replace().log_density([0.3, 0.4])
    assert np.allclose(p.replace(covs=4 * p.covs).factors, 2 * p.factors)
    for mixture in (p, p.marginal([0]), p.moment_match()):
        with pytest.raises(ValueError, match="read-only"):
            mixture.covs[0] *= 4


# ----------------------------------------------------------------------------- divergences


def closed(p: GaussianMixture, q: GaussianMixture) -> float:
    return 0.5 * float(between(p, q)[0, 0] + between(q, p)[0, 0])


def test_gaussian_divergences_are_the_integral() -> None:
    p = random_mixture(3, 1, 3)
    q = random_mixture(2, 1, 4)
    x = np.linspace(-80, 80, 200_001)[:, None]
    lp = p.component_log_densities(x)
    lq = q.component_log_densities(x)
    for i, j in np.ndindex(3, 2):
        value = np.trapezoid(np.exp(lp[:, i]) * (lp[:, i] - lq[:, j]), x[:, 0])
        assert np.isclose(between(p, q)[i, j], value, rtol=1e-9)


def test_gaussian_divergences_are_no_matter_of_coordinates_and_never_negative() -> None:
    p = random_mixture(4, 4, 1)
    q = random_mixture(3, 4, 2)
    assert np.allclose(
        between(affine(p, *scales(4)), affine(q, *scales(4))), between(p, q)
    )
    for seed in range(30):
        p = random_mixture(4, 4, seed)
        assert between(p, p).min() >= 0 and np.diag(between(p, p)).max() < 1e-12


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_quadrature_meets_the_closed_form(dim: int) -> None:
    p = random_mixture(1, dim, 1, 1.0)
    q = random_mixture(1, dim, 3, 1.0)
    far = 9 * np.sqrt(p.cov.diagonal() + q.cov.diagonal()) + abs(p.mean) + abs(q.mean)
    # Constants in the logarithms do not matter.
    found = jeffreys_of_many(
        lambda x: p.log_density(x) + 900,
        [lambda x: q.log_density(x) - 50, p.log_density],
        -far,
        far,
        nodes=130,
    )
    assert np.isclose(found[0].value, closed(p, q), rtol=1e-6) and found[0].error == 0
    assert abs(found[1].value) < 1e-12


def test_sampling_meets_the_closed_form_within_its_standard_error() -> None:
    found = [
        jeffreys_by_sampling(
            lambda x: F(x) - 3,
            NEAR.log_density,
            Q,
            members=800,
            rng=np.random.default_rng(seed),
        )
        for seed in range(200)
    ]
    spread = np.std([d.value for d in found], ddof=1)
    assert (
        abs(np.mean([d.value for d in found]) - closed(P, NEAR)) < 4 * spread / 200**0.5
    )
    # A standard deviation from 200 draws is known to 5%; 20% is four of its standard errors.
    assert np.isclose(np.mean([d.error for d in found]), spread, rtol=0.2)
