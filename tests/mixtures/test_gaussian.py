"""Gaussian mixtures and divergences against scipy, quadrature and identities."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from distfilt.mixtures import (
    Divergence,
    GaussianMixture,
    jeffreys_by_sampling,
    jeffreys_of_many,
)
from distfilt.mixtures.reduction import gaussian_divergences

from .examples import random_frame, random_mixture, shuffle, transform

UNIT = [[[1.0]], [[1.0]]]
P = random_mixture(1, 2, 1, 1.0)
Q = random_mixture(1, 2, 2, 1.0)
SHIFTED = GaussianMixture([1.0], P.means + 0.3, P.covs)


@pytest.mark.parametrize(("size", "dim"), [(1, 1), (3, 3), (5, 2), (2, 6)])
def test_log_density_is_scipys(size: int, dim: int) -> None:
    p = random_mixture(size, dim, 10 * size + dim)
    x = 3 * np.random.default_rng(0).standard_normal((4, 7, dim))
    # p(x) = Σ w_l N(x; m_l, P_l)
    density = 0
    for w, m, c in zip(p.weights, p.means, p.covs, strict=True):
        density = density + w * multivariate_normal(m, c).pdf(x)
    assert p.log_density(x).shape == (4, 7)
    assert np.allclose(p.log_density(x), np.log(density), rtol=1e-11)
    parts = p.component_log_densities(x)
    assert parts.shape == (4, 7, size)
    for k in range(size):
        logs = multivariate_normal(p.means[k], p.covs[k]).logpdf(x)
        assert np.allclose(parts[..., k], logs)


def test_many_points_are_evaluated_in_blocks() -> None:
    p = random_mixture(40, 3, 1)
    x = np.random.default_rng(0).standard_normal((40_000, 3))
    # Single points of a large call have the values of a small one.
    index = np.arange(0, 40_000, 1777)
    few = x[index]
    assert np.allclose(p.log_density(x)[index], p.log_density(few), rtol=1e-13)
    logs = p.component_log_densities(x)[index]
    assert np.allclose(logs, p.component_log_densities(few))


def test_tails_do_not_underflow() -> None:
    p = GaussianMixture([0.5, 0.5], [[0.0], [1e4]], [[[1.0]], [[4.0]]])
    # The wider component alone: log(w) - ½ log(2 π 4) - ½ x² / 4.
    log_norm = 0.5 * np.log(8 * np.pi)
    expected = np.log(0.5) - log_norm - 0.125 * 25e6
    assert np.isclose(p.log_density([5e3]), expected)
    assert np.isfinite(p.log_density([-1e8]))
    # A component of zero weight adds log 0 = -∞ without a NaN.
    zero = GaussianMixture([1.0, 0.0], [[0.0], [1.0]], UNIT)
    expected = -0.5 * np.log(2 * np.pi)
    assert np.isclose(zero.log_density([0.0]), expected)


def test_density_in_other_coordinates_and_in_another_order() -> None:
    """A change of coordinates divides the density by |det A|."""
    p = random_mixture(4, 3, 2)
    matrix, shift = random_frame(3)
    x = 3 * np.random.default_rng(0).standard_normal((20, 3))
    transformed_x = x @ matrix.T + shift
    logs = transform(p, matrix, shift).log_density(transformed_x)
    log_determinant = np.linalg.slogdet(matrix)[1]
    expected = p.log_density(x) - log_determinant
    assert np.allclose(logs, expected, atol=1e-6)
    # At 4.2e7 a squared distance by its binomial formula would have no digits left.
    far = transform(p, np.eye(3), np.full(3, 4.2e7))
    assert np.allclose(far.log_density(x + 4.2e7), p.log_density(x), atol=1e-6)
    assert np.allclose(shuffle(p).log_density(x), p.log_density(x), rtol=1e-13)


def test_a_marginal_is_the_integral() -> None:
    p = random_mixture(3, 2, 3)
    x = np.linspace(-60, 60, 20_001)
    for y in (-1.0, 2.5):
        points = np.column_stack([x, np.full_like(x, y)])
        density = np.exp(p.log_density(points))
        integral = np.trapezoid(density, x)
        marginal = p.marginal([1]).log_density([y])
        assert np.isclose(integral, np.exp(marginal), rtol=1e-9)
    # Of all components in reverse order.
    reverse = p.marginal([1, 0])
    assert np.array_equal(reverse.means, p.means[:, ::-1])
    assert np.array_equal(reverse.covs, p.covs[:, ::-1, ::-1])


def test_moments_are_the_draws() -> None:
    p = random_mixture(3, 3, 4)
    x = p.rvs(200_000, rng=np.random.default_rng(2))
    # Five standard errors.
    error = np.sqrt(np.diag(p.cov).max() / 200_000)
    assert np.abs(x.mean(axis=0) - p.mean).max() < 5 * error
    cov_error = np.abs(np.cov(x, rowvar=False) - p.cov).max()
    assert cov_error < 0.02 * np.abs(p.cov).max()
    # P = Σ w (P_l + (m_l - m)(m_l - m)ᵀ)
    differences = p.means - p.weights @ p.means
    cov = np.zeros((3, 3))
    for w, c, d in zip(p.weights, p.covs, differences, strict=True):
        cov += w * (c + np.outer(d, d))
    assert np.allclose(p.cov, cov, rtol=1e-13)
    one = p.moment_match()
    assert one.n_components == 1
    assert np.allclose(one.mean, p.mean)
    assert np.allclose(one.cov, p.cov)


def test_a_mixture_owns_its_arrays() -> None:
    w = np.array([1 - 1e-320, 1e-320])
    m = np.zeros((2, 2))
    c = np.stack([np.eye(2)] * 2)
    p = GaussianMixture(w, m, c)
    before = p.log_density([0.3, 0.4])
    # Writing to the arguments does not reach the mixture, which has copies.
    w[:] = 0.5
    m[:] = 7.0
    c[:] = 4 * np.eye(2)
    assert p.log_density([0.3, 0.4]) == before
    assert p.replace().log_density([0.3, 0.4]) == before
    # Factors are computed from the new covariances: √4 = 2.
    assert np.allclose(p.replace(covs=4 * p.covs).factors, 2 * p.factors)
    for mixture in (p, p.marginal([0]), p.moment_match()):
        with pytest.raises(ValueError, match="read-only"):
            mixture.covs[0] *= 4


# ----------------------------------------------------------------------------- divergences


def jeffreys_of_gaussians(p: GaussianMixture, q: GaussianMixture) -> float:
    """Jeffreys' divergence ½ (KL(p‖q) + KL(q‖p)) of two Gaussians."""
    forward = gaussian_divergences(p, q)[0, 0]
    backward = gaussian_divergences(q, p)[0, 0]
    return 0.5 * float(forward + backward)


def test_gaussian_divergences_are_the_integral() -> None:
    p = random_mixture(3, 1, 3)
    q = random_mixture(2, 1, 4)
    x = np.linspace(-80, 80, 200_001)[:, None]
    lp = p.component_log_densities(x)
    lq = q.component_log_densities(x)
    for i, j in np.ndindex(3, 2):
        # ∫ p log(p / q)
        log_ratio = lp[:, i] - lq[:, j]
        integrand = np.exp(lp[:, i]) * log_ratio
        value = np.trapezoid(integrand, x[:, 0])
        divergence = gaussian_divergences(p, q)[i, j]
        assert np.isclose(divergence, value, rtol=1e-9)


def test_gaussian_divergences_are_invariant_and_never_negative() -> None:
    p = random_mixture(4, 4, 1)
    q = random_mixture(3, 4, 2)
    matrix, shift = random_frame(4)
    transformed = gaussian_divergences(
        transform(p, matrix, shift), transform(q, matrix, shift)
    )
    assert np.allclose(transformed, gaussian_divergences(p, q))
    for seed in range(30):
        p = random_mixture(4, 4, seed)
        # Gibbs' inequality, also where rounding would give -1e-16: KL(p‖p) = 0.
        divergences = gaussian_divergences(p, p)
        assert divergences.min() >= 0
        assert np.diag(divergences).max() < 1e-12


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_quadrature_equals_the_closed_form(dim: int) -> None:
    p = random_mixture(1, dim, 1, 1.0)
    q = random_mixture(1, dim, 3, 1.0)
    # A box of nine standard deviations around both means holds all but 1e-18.
    std = np.sqrt(p.cov.diagonal() + q.cov.diagonal())
    edge = 9 * std + abs(p.mean) + abs(q.mean)
    # Constants in the logarithms do not matter.
    divergences = jeffreys_of_many(
        lambda x: p.log_density(x) + 900,
        [lambda x: q.log_density(x) - 50, p.log_density],
        -edge,
        edge,
        nodes=130,
    )
    assert np.isclose(divergences[0].value, jeffreys_of_gaussians(p, q), rtol=1e-6)
    # Quadrature has no sampling error.
    assert divergences[0].error == 0
    # The second density is p itself.
    assert abs(divergences[1].value) < 1e-12


@pytest.mark.parametrize("seed", range(5))
def test_the_standard_error_of_sampling_is_symmetric_and_the_jackknife_s(
    seed: int,
) -> None:
    """It is one divergence in both directions."""
    p = random_mixture(2, 2, seed + 10, 1.0)
    q = random_mixture(3, 2, seed + 20, 1.0)
    # Half from each: no weight is above two.
    proposal = GaussianMixture(
        0.5 * np.concatenate([p.weights, q.weights]),
        np.concatenate([p.means, q.means]),
        np.concatenate([p.covs, q.covs]),
    )
    members = 400

    def sample(
        log_p: Callable[[np.ndarray], np.ndarray],
        log_q: Callable[[np.ndarray], np.ndarray],
    ) -> Divergence:
        rng = np.random.default_rng(seed)
        return jeffreys_by_sampling(log_p, log_q, proposal, members=members, rng=rng)

    one = sample(p.log_density, q.log_density)
    other = sample(q.log_density, p.log_density)
    assert np.isclose(one.value, other.value, rtol=1e-9)
    assert np.isclose(one.error, other.error, rtol=1e-9)
    # The same draws, each left out in turn
    x = proposal.rvs(members, rng=np.random.default_rng(seed))
    log_ratio = p.log_density(x) - q.log_density(x)
    means = []
    for density in (p, q):
        w = np.exp(density.log_density(x) - proposal.log_density(x))
        left = (w @ log_ratio - w * log_ratio) / (w.sum() - w)
        means.append(left)
    without_one = 0.5 * (means[0] - means[1])
    jackknife = np.sqrt((members - 1) * without_one.var())
    # They differ by the order of one part in N, a weight's share of the sum.
    assert np.isclose(one.error, jackknife, rtol=10 / members)


def test_sampling_equals_the_closed_form_within_its_standard_error() -> None:
    values = []
    errors = []
    for seed in range(200):
        divergence = jeffreys_by_sampling(
            lambda x: P.log_density(x) - 3,
            SHIFTED.log_density,
            Q,
            members=800,
            rng=np.random.default_rng(seed),
        )
        values.append(divergence.value)
        errors.append(divergence.error)
    std = np.std(values, ddof=1)
    # Four standard errors of the mean.
    error = np.mean(values) - jeffreys_of_gaussians(P, SHIFTED)
    assert abs(error) < 4 * std / 200**0.5
    # A standard deviation from 200 draws is known to 5%; 20% is four of its standard
    # errors.
    assert np.isclose(np.mean(errors), std, rtol=0.2)
