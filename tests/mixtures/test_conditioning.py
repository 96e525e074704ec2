"""Mixtures forecast, conditioned, gated and split: exact moments, Kalman, other coordinates."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from distfilt.mixtures import (
    GaussianMixture,
    nonlinearity,
    split_components,
    split_library,
)
from distfilt.mixtures.conditioning import (
    propagate_mixture,
    update_mixture,
    within_gate,
)
from distfilt.mixtures.splitting import split_nonlinear

from .examples import affine, random_mixture, same, scales, shuffled

P = random_mixture(4, 3, 1)
U = P.factors[[1, 3], :, 0]
H = np.random.default_rng(1).standard_normal((2, 3))
R = random_mixture(1, 2, 2).covs[0]


@given(st.integers(0, 100), st.integers(1, 4))
def test_linear_problems_are_the_kalman_filter(seed: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    p = random_mixture(3, d, seed)
    f = rng.standard_normal((d, d))
    h = rng.standard_normal((2, d))
    q = random_mixture(1, d, seed + 1).factors[0]
    r = random_mixture(1, 2, seed + 2).covs[0]
    ahead = propagate_mixture(p, lambda x: x @ f.T, q)
    assert np.allclose(ahead.means, p.means @ f.T)
    assert np.allclose(ahead.covs, f @ p.covs @ f.T + q @ q.T)
    y = 3 * rng.standard_normal(2)
    after = update_mixture(ahead, y, lambda x: x @ h.T, r)
    inner = h @ ahead.covs @ h.T + r
    gain = np.linalg.solve(inner, h @ ahead.covs).mT
    means = ahead.means + (gain @ (y - ahead.means @ h.T)[..., None])[..., 0]
    parts = zip(ahead.weights, ahead.means @ h.T, inner, strict=True)
    w = np.array([v * multivariate_normal(m, c).pdf(y) for v, m, c in parts])
    seen = w > 1e-9 * w.sum()  # the others are left out
    assert np.allclose(after.weights, w[seen] / w[seen].sum())
    assert np.allclose(after.means, means[seen], atol=1e-7)
    assert np.allclose(
        after.covs, (ahead.covs - gain @ inner @ gain.mT)[seen], atol=1e-7
    )


def test_what_bends_adds_to_the_spread() -> None:
    # The variance of x² is 4 m² P + 2 P², which DD2 meets; its covariance with x is 2 m P.
    m = 1.5
    p = 0.8
    r = 0.3
    y = 4.0
    prior = GaussianMixture.gaussian([m], [[p]])
    spread = 4 * m**2 * p + 2 * p**2
    ahead = propagate_mixture(prior, lambda x: x**2, np.full((1, 1), np.sqrt(r)))
    assert np.allclose(ahead.covs, spread + r)
    after = update_mixture(prior, np.array([y]), lambda x: x**2, np.full((1, 1), r))
    gain = 2 * m * p / (spread + r)
    assert np.allclose(after.means, m + gain * (y - m**2 - p))
    assert np.allclose(after.covs, p - gain**2 * (spread + r))


def test_steps_in_other_coordinates_and_in_another_order() -> None:
    matrix, shift = scales(3)
    back = np.linalg.inv(matrix)

    def bent(x: np.ndarray) -> np.ndarray:
        return x + 0.1 * np.sin(x @ np.ones((3, 3)))

    def there(x: np.ndarray) -> np.ndarray:
        return (x - shift) @ back.T

    # The unscented points depend on the square root, so both start from matching ones.
    p = affine(P, matrix, shift)
    p = GaussianMixture.construct(
        p.weights, p.means, p.covs, factors=matrix @ P.factors
    )
    after = propagate_mixture(
        p, lambda x: bent(there(x)) @ matrix.T + shift, 0.1 * matrix
    )
    same(
        affine(after, back, -back @ shift),
        propagate_mixture(P, bent, 0.1 * np.eye(3)),
        1e-8,
    )
    y = np.array([0.5, 1.0])
    after = update_mixture(p, y, lambda x: bent(there(x)) @ H.T, R)
    home = update_mixture(P, y, lambda x: bent(x) @ H.T, R)
    same(affine(after, back, -back @ shift), home, 1e-7)
    same(update_mixture(shuffled(P), y, lambda x: bent(x) @ H.T, R), home)


def test_a_missing_component_keeps_its_noise_to_itself() -> None:
    noise = np.array([[1.0, 0.9], [0.9, 2.0]])
    part = update_mixture(P, np.array([np.nan, 1.0]), lambda x: x @ H.T, noise)
    same(part, update_mixture(P, np.ones(1), lambda x: x @ H[1:].T, noise[1:, 1:]))
    assert update_mixture(P, np.full(2, np.nan), lambda x: x @ H.T, noise) is P


def test_a_mixand_that_cannot_see_is_left_out() -> None:
    def half_blind(x: np.ndarray) -> np.ndarray:
        return np.where(x > 0, x, np.nan)

    two = GaussianMixture([0.5, 0.5], [[-9.0], [9.0]], np.ones((2, 1, 1)))
    after = update_mixture(two, np.full(1, 8.0), half_blind, np.eye(1))
    assert after.n_components == 1 and np.allclose(after.means, 8.5)
    with pytest.raises(ValueError, match="^observed must be a target that can be seen"):
        update_mixture(two, np.full(1, 8.0), lambda x: np.nan * x, np.eye(1))


def test_angles_that_wrap_between_points() -> None:
    def bearing(x: np.ndarray) -> np.ndarray:
        return np.arctan2(x[..., 1:2], x[..., 0:1])

    def wrap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (a - b + np.pi) % (2 * np.pi) - np.pi

    at = np.array([-5.0, 0.01])
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    one, two = (GaussianMixture.gaussian(m, 0.09 * np.eye(2)) for m in (at, turn @ at))
    one = update_mixture(
        one, np.array([-np.pi + 0.05]), bearing, 0.01 * np.eye(1), residual=wrap
    )
    two = update_mixture(
        two, np.array([-np.pi / 2 + 0.05]), bearing, 0.01 * np.eye(1), residual=wrap
    )
    assert np.allclose(one.means @ turn.T, two.means)
    assert np.allclose(turn @ one.covs @ turn.T, two.covs)


def test_a_gate_measures_from_the_nearest_mixand() -> None:
    h = np.array([[1.0, 0.0], [0.0, 1.0]])
    cov = np.array([[1.0, 0.5], [0.5, 2.0]])
    prior = GaussianMixture([0.5, 0.5], [[0.0, 0.0], [50.0, 0.0]], [cov, cov])

    def passed(y: list[float], gate: float) -> bool:
        left = within_gate(
            prior, np.array(y), lambda x: x @ h.T, 0.25 * np.eye(2), gate=gate
        )
        assert np.isnan(left).all() or np.array_equal(left, y, equal_nan=True)
        return not np.isnan(left).all()

    y = np.array([1.0, -2.0])
    length = np.sqrt(y @ np.linalg.solve(cov + 0.25 * np.eye(2), y))
    assert passed([*y], 1.001 * length) and not passed([*y], 0.999 * length)
    assert passed([50.0, np.nan], 3.0) and not passed([25.0, np.nan], 3.0)


def test_the_library_keeps_moments_and_is_near_the_normal() -> None:
    x = np.linspace(-9, 9, 20001)
    for std, limit in ((0.5, 1.5e-2), (0.7, 2e-3), (0.9, 1e-4)):
        w, m = split_library(std=std)
        assert np.isclose(w.sum(), 1) and (w > 0).all() and np.isclose(w @ m, 0)
        assert np.isclose(w @ m**2 + std**2, 1)

        def ise(a: float, std: float = std) -> float:
            at = np.sqrt((1 - std**2) / (2 * a))
            w = [a, 1 - 2 * a, a]
            p = GaussianMixture(w, [[-at], [0.0], [at]], np.full((3, 1, 1), std**2))
            gap = np.exp(p.log_density(x[:, None])) - np.exp(-0.5 * x**2) / np.sqrt(
                2 * np.pi
            )
            return float(np.trapezoid(gap**2, x))

        assert ise(w[0]) <= min(ise(0.9 * w[0]), ise(1.1 * w[0])) + 1e-12 < limit


def test_splits_keep_the_moments() -> None:
    after = split_components(P, [1, 3], U, std=0.6)
    assert after.n_components == 8 and np.linalg.eigvalsh(after.covs).min() > 0
    assert np.allclose(after.mean, P.mean) and np.allclose(after.cov, P.cov, rtol=1e-12)
    assert np.allclose(after.weights[:2], P.weights[[0, 2]])
    assert np.isclose(after.weights[2:5].sum(), P.weights[1])
    matrix, shift = scales(3)
    there = split_components(affine(P, matrix, shift), [1, 3], U @ matrix.T, std=0.6)
    same(there, affine(after, matrix, shift))


def test_stretching_is_the_largest_image() -> None:
    rng = np.random.default_rng(2)
    g = rng.standard_normal((4, 2, 3))
    scale = np.array([1.0, 3.0])
    u, length = nonlinearity(P.factors, g, scale=scale)
    for k in range(4):
        assert np.isclose(u[k] @ np.linalg.solve(P.covs[k], u[k]), 1)
        assert np.isclose(np.linalg.norm(scale * (g[k] @ u[k])), length[k])
        z = rng.standard_normal((500, 3))
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        assert (
            np.linalg.norm(scale * (z @ P.factors[k].T @ g[k].T), axis=1).max()
            <= length[k]
        )


def test_the_most_stretched_are_split_while_there_is_room() -> None:
    def slope(x: np.ndarray) -> np.ndarray:
        return np.where(x > 0, 4.0, 1.0)[..., None]

    two = GaussianMixture([0.5, 0.5], [[-5.0], [5.0]], np.ones((2, 1, 1)))
    once = split_nonlinear(two, slope, max_components=4, split_threshold=0.6)
    assert once.n_components == 4 and (once.means > 0).sum() == 3
    # .5 · 4 is above the limit, and so is its middle piece, of deviation .7; thrice at most.
    assert (
        split_nonlinear(two, slope, max_components=50, split_threshold=0.6).n_components
        == 6
    )
    assert split_nonlinear(two, slope, max_components=3, split_threshold=0.6) is two
    assert split_nonlinear(two, slope, max_components=50, split_threshold=2.5) is two
