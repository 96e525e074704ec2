"""Divergences: closed form, quadrature and sampling against each other."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.mixtures import (
    Divergence,
    GaussianMixture,
    arc,
    jeffreys_by_quadrature,
    jeffreys_by_sampling,
    jeffreys_of_many,
)
from distfilt.mixtures.divergence import gaussian_divergences, tensor_grid

from .examples import random_mixture, wide

P, Q = random_mixture(1, 2, 1, 1.0), random_mixture(1, 2, 2, 1.0)
F = P.log_density

BAD_INPUT = {
    "distfilt.mixtures.divergence.gaussian_divergences": [
        ("means", lambda: gaussian_divergences([0.0], [[[1.0]]], [[0.0]], [[[1.0]]])),
        ("covs", lambda: gaussian_divergences([[0.0]], [[[-1.0]]], [[0.0]], [[[1.0]]])),
        ("other_means", lambda: gaussian_divergences([[0.0]], [[[1.0]]], [0.0], [[[1.0]]])),
        ("other_covs", lambda: gaussian_divergences([[0.0]], [[[1.0]]], [[0.0]], [np.eye(2)])),
    ],
    "distfilt.mixtures.divergence.Divergence": [("value", lambda: Divergence(np.nan, 0.0, 1.0))],
    "distfilt.mixtures.divergence.tensor_grid": [
        ("lower", lambda: tensor_grid([[0.0]], [1.0], 3)),
        ("upper", lambda: tensor_grid([0.0], [0.0], 3)),
        ("nodes", lambda: tensor_grid([0.0], [1.0], 1)),
    ],
    "distfilt.mixtures.divergence.jeffreys_by_quadrature": [
        ("log_p", lambda: jeffreys_by_quadrature(3, F, [0], [1])),  # type: ignore[arg-type]
        ("log_q", lambda: jeffreys_by_quadrature(F, lambda x: x, [0, 0], [1, 1], nodes=3)),
        ("lower", lambda: jeffreys_by_quadrature(F, F, [[0.0]], [1.0])),
        ("upper", lambda: jeffreys_by_quadrature(F, F, [0.0, 0.0], [1.0])),
        ("nodes", lambda: jeffreys_by_quadrature(F, F, [0.0, 0], [1.0, 1], nodes=1)),
    ],
    "distfilt.mixtures.divergence.jeffreys_of_many": [
        ("log_p", lambda: jeffreys_of_many(3, [F], [0, 0], [1, 1])),  # type: ignore[arg-type]
        ("log_qs", lambda: jeffreys_of_many(F, [3], [0, 0], [1, 1])),  # type: ignore[list-item]
    ],
    "distfilt.mixtures.divergence.jeffreys_by_sampling": [
        ("log_p", lambda: jeffreys_by_sampling(
            3, F, P, members=9, rng=np.random.default_rng(0))),  # type: ignore[arg-type]
        ("log_q", lambda: jeffreys_by_sampling(
            F, lambda x: x, P, members=9, rng=np.random.default_rng(0))),
        ("proposal", lambda: jeffreys_by_sampling(
            F, F, 3, members=9, rng=np.random.default_rng(0))),  # type: ignore[arg-type]
        ("members", lambda: jeffreys_by_sampling(
            F, F, P, members=1, rng=np.random.default_rng(0))),
        ("rng", lambda: jeffreys_by_sampling(F, F, P, members=9, rng=0)),  # type: ignore[arg-type]
    ],
}


def closed(p: GaussianMixture, q: GaussianMixture) -> float:
    there = gaussian_divergences(p.means, p.covs, q.means, q.covs)[0, 0]
    back = gaussian_divergences(q.means, q.covs, p.means, p.covs)[0, 0]
    return 0.5 * float(there + back)


def test_gaussian_divergences_are_the_integral() -> None:
    p, q = random_mixture(3, 1, 3), random_mixture(2, 1, 4)
    x = np.linspace(-80, 80, 200_001)[:, None]
    found = gaussian_divergences(p.means, p.covs, q.means, q.covs)
    lp, lq = p.component_log_densities(x), q.component_log_densities(x)
    for i in range(3):
        for j in range(2):
            value = np.trapezoid(np.exp(lp[:, i]) * (lp[:, i] - lq[:, j]), x[:, 0])
            assert np.isclose(found[i, j], value, rtol=1e-9)


def test_gaussian_divergences_are_never_negative() -> None:
    for seed in range(30):
        p = random_mixture(4, 4, seed)
        d = gaussian_divergences(p.means, p.covs, p.means, p.covs)
        assert (np.diag(d) >= 0).all() and np.diag(d).max() < 1e-12 and d.min() >= 0


def test_quadrature_and_sampling_meet_the_closed_form() -> None:
    wanted = closed(P, Q)
    far = np.full(2, 14.0)
    found = jeffreys_by_quadrature(P.log_density, Q.log_density, -far, far, nodes=200)
    assert np.isclose(found.value, wanted, rtol=1e-6) and found.error == 0
    # Constants do not matter.
    shifted = jeffreys_by_quadrature(
        lambda x: P.log_density(x) + 900, lambda x: Q.log_density(x) - 50, -far, far, nodes=200
    )
    assert np.isclose(shifted.value, found.value, rtol=1e-10)
    drawn = jeffreys_by_sampling(
        lambda x: P.log_density(x) - 3, Q.log_density, wide(P, Q, 0.5), members=50_000,
        rng=np.random.default_rng(1),
    )
    assert abs(drawn.value - wanted) < 4 * drawn.error and 0 < drawn.share <= 1


def test_the_standard_error_is_that_of_repeated_draws() -> None:
    found = [
        jeffreys_by_sampling(
            P.log_density, Q.log_density, wide(P, Q, 0.5), members=800,
            rng=np.random.default_rng(seed),
        )
        for seed in range(200)
    ]
    spread = np.std([d.value for d in found], ddof=1)
    # A standard deviation from 200 draws is known to 5%; 20% is four of its standard errors.
    assert np.isclose(np.mean([d.error for d in found]), spread, rtol=0.2)


def test_equal_densities_are_not_apart() -> None:
    same = jeffreys_by_sampling(F, F, P, members=10, rng=np.random.default_rng(0))
    assert same.value == 0 and same.error == 0 and np.isclose(same.share, 1)


def test_one_dimension_and_the_order_of_axes() -> None:
    points, parts = tensor_grid([0.0, 10.0], [1.0, 14.0], 3)
    assert points[:3].tolist() == [[0, 10], [0, 12], [0, 14]]
    assert parts.tolist() == [0.25, 0.5, 0.25, 0.5, 1.0, 0.5, 0.25, 0.5, 0.25]


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
    along = np.array([10, -2]) / r
    assert np.isclose(along @ base.covs[2, :2, :2] @ along, 0.4**2)
    across = np.array([2, 10]) / r
    step = r * 0.4 * 0.6 * 1.46 / 2
    assert np.isclose(across @ base.covs[2, :2, :2] @ across, step**2)
    assert np.isclose(across @ base.covs[2, :2, 2:] @ across, -0.5 * step**2)
    assert np.isclose(across @ base.covs[2, 2:, 2:] @ across, 0.25 * step**2 + 0.3**2)
