"""Divergences: closed form, quadrature and sampling against each other; beliefs along an arc."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.mixtures import GaussianMixture, arc, jeffreys_by_sampling, jeffreys_of_many
from distfilt.mixtures.divergence import gaussian_divergences

from .examples import affine, random_mixture, scales

P, Q = random_mixture(1, 2, 1, 1.0), random_mixture(1, 2, 2, 1.0)
F = P.log_density
BOTH = GaussianMixture([0.5, 0.5], np.r_[P.means, Q.means], np.r_[P.covs, Q.covs])


def between(p: GaussianMixture, q: GaussianMixture) -> np.ndarray:
    return gaussian_divergences(p.means, p.covs, q.means, q.covs)


def closed(p: GaussianMixture, q: GaussianMixture) -> float:
    return 0.5 * float(between(p, q)[0, 0] + between(q, p)[0, 0])


def test_gaussian_divergences_are_the_integral() -> None:
    p, q = random_mixture(3, 1, 3), random_mixture(2, 1, 4)
    x = np.linspace(-80, 80, 200_001)[:, None]
    lp, lq = p.component_log_densities(x), q.component_log_densities(x)
    for i, j in np.ndindex(3, 2):
        value = np.trapezoid(np.exp(lp[:, i]) * (lp[:, i] - lq[:, j]), x[:, 0])
        assert np.isclose(between(p, q)[i, j], value, rtol=1e-9)


def test_gaussian_divergences_are_no_matter_of_coordinates_and_never_negative() -> None:
    p, q = random_mixture(4, 4, 1), random_mixture(3, 4, 2)
    assert np.allclose(between(affine(p, *scales(4)), affine(q, *scales(4))), between(p, q))
    for seed in range(30):
        p = random_mixture(4, 4, seed)
        assert between(p, p).min() >= 0 and np.diag(between(p, p)).max() < 1e-12


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_quadrature_meets_the_closed_form(dim: int) -> None:
    p, q = random_mixture(1, dim, 1, 1.0), random_mixture(1, dim, 3, 1.0)
    far = 9 * np.sqrt(p.cov.diagonal() + q.cov.diagonal()) + abs(p.mean) + abs(q.mean)
    # Constants in the logarithms do not matter.
    found = jeffreys_of_many(
        lambda x: p.log_density(x) + 900,
        [lambda x: q.log_density(x) - 50, p.log_density], -far, far, nodes=130,
    )  # fmt: skip
    assert np.isclose(found[0].value, closed(p, q), rtol=1e-6) and found[0].error == 0
    assert abs(found[1].value) < 1e-12


def test_sampling_meets_the_closed_form_within_its_standard_error() -> None:
    found = [
        jeffreys_by_sampling(
            lambda x: F(x) - 3, Q.log_density, BOTH, members=800, rng=np.random.default_rng(seed)
        )
        for seed in range(200)
    ]
    spread = np.std([d.value for d in found], ddof=1)
    assert abs(np.mean([d.value for d in found]) - closed(P, Q)) < 4 * spread / 200**0.5
    # A standard deviation from 200 draws is known to 5%; 20% is four of its standard errors.
    assert np.isclose(np.mean([d.error for d in found]), spread, rtol=0.2)
    assert all(0 < d.share <= 1 for d in found)


def test_equal_densities_are_not_apart() -> None:
    found = jeffreys_by_sampling(F, F, P, members=10, rng=np.random.default_rng(0))
    assert found.value == 0 and found.error == 0 and np.isclose(found.share, 1)


@pytest.mark.parametrize("turn", [0.0, 1.0, np.pi])
def test_arcs_turn_with_the_agent(turn: float) -> None:
    c, s = np.cos(turn), np.sin(turn)
    plane = np.array([[c, -s], [s, c]])
    whole = np.kron(np.eye(2), plane)
    base = arc(5, [-10.0, 2.0], angle_std=0.6, range_std=0.4, ego_std=0.3, width=0.4)
    moved = arc(5, plane @ [-10.0, 2.0], angle_std=0.6, range_std=0.4, ego_std=0.3, width=0.4)
    assert np.allclose(moved.means, base.means @ whole.T)
    assert np.allclose(moved.covs, whole @ base.covs @ whole.T)
    assert np.allclose(base.means[2], [0, 0, -10, 2], atol=1e-12)
    r = np.hypot(10, 2)
    assert np.allclose(np.hypot(*(base.means[:, :2] - [-10, 2]).T), r)
    # The own position moves half as far, the other way.
    out, ego = base.means[:, :2] - base.means[2, :2], base.means[:, 2:] - base.means[2, 2:]
    assert np.allclose(ego, -0.5 * out)
    along, across = np.array([10, -2]) / r, np.array([2, 10]) / r
    assert np.isclose(along @ base.covs[2, :2, :2] @ along, 0.4**2)
    step = r * 0.4 * 0.6 * 1.46 / 2
    assert np.isclose(across @ base.covs[2, :2, :2] @ across, step**2)
    assert np.isclose(across @ base.covs[2, :2, 2:] @ across, -0.5 * step**2)
    assert np.isclose(across @ base.covs[2, 2:, 2:] @ across, 0.25 * step**2 + 0.3**2)
    assert np.allclose(np.diff(np.log(base.weights))[:2], 1.46**2 * np.array([3 / 8, 1 / 8]))
