"""Forecast, update, gating and splitting of mixtures: Kalman filter, moments, coordinates."""

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
    propagate_together,
    update_mixture,
    update_together,
    within_gate,
)
from distfilt.mixtures.splitting import split_nonlinear

from .examples import assert_same, random_frame, random_mixture, shuffle, transform

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
    # Forecast: F m and F P Fᵀ + Q.
    forecast = propagate_mixture(p, lambda x: x @ f.T, q)
    assert np.allclose(forecast.means, p.means @ f.T)
    propagated = f @ p.covs @ f.T
    assert np.allclose(forecast.covs, propagated + q @ q.T)
    # Update with the gain K = P Hᵀ S⁻¹ of each component.
    y = 3 * rng.standard_normal(2)
    analysis = update_mixture(forecast, y, lambda x: x @ h.T, r)
    predicted = forecast.means @ h.T
    innovation_cov = h @ forecast.covs @ h.T + r
    gain = np.linalg.solve(innovation_cov, h @ forecast.covs).mT
    innovation = y - predicted
    correction = gain @ innovation[..., None]
    means = forecast.means + correction[..., 0]
    covs = forecast.covs - gain @ innovation_cov @ gain.mT
    # Weights by the likelihood; negligible components are left out.
    likelihoods = []
    for mean, cov in zip(predicted, innovation_cov, strict=True):
        likelihoods.append(multivariate_normal(mean, cov).pdf(y))
    w = forecast.weights * np.array(likelihoods)
    large = w > 1e-9 * w.sum()
    expected_weights = w[large] / w[large].sum()
    assert np.allclose(analysis.weights, expected_weights)
    assert np.allclose(analysis.means, means[large], atol=1e-7)
    assert np.allclose(analysis.covs, covs[large], atol=1e-7)


def test_curvature_adds_to_the_covariance() -> None:
    # The variance of x² is 4 m² P + 2 P², which DD2 meets; its covariance with x is 2 m
    # P.
    m = 1.5
    p = 0.8
    r = 0.3
    y = 4.0
    prior = GaussianMixture.gaussian([m], [[p]])
    spread = 4 * m**2 * p + 2 * p**2
    noise_factor = np.full((1, 1), np.sqrt(r))
    forecast = propagate_mixture(prior, lambda x: x**2, noise_factor)
    assert np.allclose(forecast.covs, spread + r)
    noise = np.full((1, 1), r)
    analysis = update_mixture(prior, np.array([y]), lambda x: x**2, noise)
    # The predicted mean is E x² = m² + P.
    innovation = y - (m**2 + p)
    innovation_cov = spread + r
    gain = 2 * m * p / innovation_cov
    assert np.allclose(analysis.means, m + gain * innovation)
    assert np.allclose(analysis.covs, p - gain**2 * innovation_cov)


def test_steps_do_not_depend_on_coordinates_or_order() -> None:
    matrix, shift = random_frame(3)
    inverse = np.linalg.inv(matrix)
    inverse_shift = -inverse @ shift

    def move(x: np.ndarray) -> np.ndarray:
        return x + 0.1 * np.sin(x @ np.ones((3, 3)))

    def to_original(x: np.ndarray) -> np.ndarray:
        return (x - shift) @ inverse.T

    # The unscented points depend on the square root, so both start from matching ones.
    p = transform(P, matrix, shift)
    p = GaussianMixture.construct(
        p.weights, p.means, p.covs, factors=matrix @ P.factors
    )

    def move_in_frame(x: np.ndarray) -> np.ndarray:
        return move(to_original(x)) @ matrix.T + shift

    forecast = propagate_mixture(p, move_in_frame, 0.1 * matrix)
    forecast = transform(forecast, inverse, inverse_shift)
    expected = propagate_mixture(P, move, 0.1 * np.eye(3))
    assert_same(forecast, expected, 1e-8)
    # An update in other coordinates, and of components in another order.
    y = np.array([0.5, 1.0])
    expected = update_mixture(P, y, lambda x: move(x) @ H.T, R)
    analysis = update_mixture(p, y, lambda x: move(to_original(x)) @ H.T, R)
    assert_same(transform(analysis, inverse, inverse_shift), expected, 1e-7)
    analysis = update_mixture(shuffle(P), y, lambda x: move(x) @ H.T, R)
    assert_same(analysis, expected)


def test_a_missing_component_has_no_influence() -> None:
    """Not by the correlation of its noise with the others' either."""
    noise = np.array([[1.0, 0.9], [0.9, 2.0]])
    y = np.array([np.nan, 1.0])
    part = update_mixture(P, y, lambda x: x @ H.T, noise)
    # The marginal noise of the observed component is its block of R.
    h = H[1:]
    expected = update_mixture(P, np.ones(1), lambda x: x @ h.T, noise[1:, 1:])
    assert_same(part, expected)
    nothing = np.full(2, np.nan)
    assert update_mixture(P, nothing, lambda x: x @ H.T, noise) is P


def test_a_component_that_predicts_nothing_is_left_out() -> None:
    def half_blind(x: np.ndarray) -> np.ndarray:
        return np.where(x > 0, x, np.nan)

    two = GaussianMixture([0.5, 0.5], [[-9.0], [9.0]], np.ones((2, 1, 1)))
    after = update_mixture(two, np.full(1, 8.0), half_blind, np.eye(1))
    # The other one is updated with the gain P / (P + R) = 1/2: from 9 to 8.5.
    assert after.n_components == 1
    assert np.allclose(after.means, 8.5)
    with pytest.raises(ValueError, match="^observed must be predicted by"):
        update_mixture(two, np.full(1, 8.0), lambda x: np.nan * x, np.eye(1))


def test_angles_that_wrap_between_points() -> None:
    def bearing(x: np.ndarray) -> np.ndarray:
        return np.arctan2(x[..., 1:2], x[..., 0:1])

    def wrap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (a - b + np.pi) % (2 * np.pi) - np.pi

    # Bearings near ±π, and the same problem turned by a right angle, where nothing
    # wraps.
    position = np.array([-5.0, 0.01])
    rotation = np.array([[0.0, -1.0], [1.0, 0.0]])
    noise = 0.01 * np.eye(1)
    near_pi = GaussianMixture.gaussian(position, 0.09 * np.eye(2))
    y = np.array([-np.pi + 0.05])
    near_pi = update_mixture(near_pi, y, bearing, noise, residual=wrap)
    turned = GaussianMixture.gaussian(rotation @ position, 0.09 * np.eye(2))
    y = np.array([-np.pi / 2 + 0.05])
    turned = update_mixture(turned, y, bearing, noise, residual=wrap)
    assert np.allclose(near_pi.means @ rotation.T, turned.means)
    assert np.allclose(rotation @ near_pi.covs @ rotation.T, turned.covs)


def test_a_gate_measures_from_the_nearest_component() -> None:
    h = np.array([[1.0, 0.0], [0.0, 1.0]])
    cov = np.array([[1.0, 0.5], [0.5, 2.0]])
    prior = GaussianMixture([0.5, 0.5], [[0.0, 0.0], [50.0, 0.0]], [cov, cov])

    noise = 0.25 * np.eye(2)

    def is_inside(y: list[float], gate: float) -> bool:
        result = within_gate(prior, np.array(y), lambda x: x @ h.T, noise, gate=gate)
        assert np.isnan(result).all() or np.array_equal(result, y, equal_nan=True)
        return not np.isnan(result).all()

    # The gate is a Mahalanobis distance with S = P + R.
    y = np.array([1.0, -2.0])
    whitened = np.linalg.solve(cov + noise, y)
    distance = np.sqrt(y @ whitened)
    assert is_inside(y.tolist(), 1.001 * distance)
    assert not is_inside(y.tolist(), 0.999 * distance)
    # The second component is at 50; halfway between both, 25 is far from each.
    assert is_inside([50.0, np.nan], 3.0)
    assert not is_inside([25.0, np.nan], 3.0)


def test_the_split_library_has_moments_and_least_error_of_the_normal() -> None:
    """The weight a of the outer components minimises the integrated squared error."""
    x = np.linspace(-9, 9, 20001)
    for std, limit in ((0.5, 1.5e-2), (0.7, 2e-3), (0.9, 1e-4)):
        w, m = split_library(std=std)
        # Σ w = 1, Σ w m = 0 and Σ w m² + σ² = 1: the moments of N(0, 1).
        assert np.isclose(w.sum(), 1)
        assert (w > 0).all()
        assert np.isclose(w @ m, 0)
        assert np.isclose(w @ m**2 + std**2, 1)

        def ise(a: float, std: float = std) -> float:
            # 2 a m² + σ² = 1 fixes the means once a is chosen.
            m = np.sqrt((1 - std**2) / (2 * a))
            weights = [a, 1 - 2 * a, a]
            means = [[-m], [0.0], [m]]
            p = GaussianMixture(weights, means, np.full((3, 1, 1), std**2))
            normal = np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
            error = np.exp(p.log_density(x[:, None])) - normal
            return float(np.trapezoid(error**2, x))

        least = ise(w[0])
        nearby = min(ise(0.9 * w[0]), ise(1.1 * w[0]))
        assert least <= nearby + 1e-12 < limit


def test_splits_keep_the_moments() -> None:
    split = split_components(P, [1, 3], U, std=0.6)
    # Two of four components become three each.
    assert split.n_components == 8
    assert np.linalg.eigvalsh(split.covs).min() > 0
    assert np.allclose(split.mean, P.mean)
    assert np.allclose(split.cov, P.cov, rtol=1e-12)
    # The components that stay come first; a split one shares its weight among three.
    assert np.allclose(split.weights[:2], P.weights[[0, 2]])
    assert np.isclose(split.weights[2:5].sum(), P.weights[1])
    # The same in other coordinates.
    matrix, shift = random_frame(3)
    transformed = transform(P, matrix, shift)
    transformed = split_components(transformed, [1, 3], U @ matrix.T, std=0.6)
    assert_same(transformed, transform(split, matrix, shift))


def test_stretching_is_the_largest_image() -> None:
    rng = np.random.default_rng(2)
    g = rng.standard_normal((4, 2, 3))
    scale = np.array([1.0, 3.0])
    u, length = nonlinearity(P.factors, g, scale=scale)
    for k in range(4):
        # uᵀ P⁻¹ u = 1: one standard deviation; its image has the length ‖D G u‖.
        whitened = np.linalg.solve(P.covs[k], u[k])
        squared_distance = u[k] @ whitened
        assert np.isclose(squared_distance, 1)
        image = scale * (g[k] @ u[k])
        assert np.isclose(np.linalg.norm(image), length[k])
        # No other direction of one standard deviation has a larger image.
        z = rng.standard_normal((500, 3))
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        anomalies = z @ P.factors[k].T
        images = scale * (anomalies @ g[k].T)
        assert np.linalg.norm(images, axis=1).max() <= length[k]


def test_the_most_stretched_are_split_while_there_is_room() -> None:
    def slope(x: np.ndarray) -> np.ndarray:
        return np.where(x > 0, 4.0, 1.0)[..., None]

    two = GaussianMixture([0.5, 0.5], [[-5.0], [5.0]], np.ones((2, 1, 1)))
    once = split_nonlinear(two, slope, max_components=4, split_threshold=0.6)
    # The slope is 4 at the second component, which is split into three.
    assert once.n_components == 4
    assert (once.means > 0).sum() == 3
    # .5 · 4 is above the limit, and so is its middle piece, of deviation .7.
    twice = split_nonlinear(two, slope, max_components=50, split_threshold=0.6)
    assert twice.n_components == 6
    # No room for two more components, or no stretching above the threshold.
    assert split_nonlinear(two, slope, max_components=3, split_threshold=0.6) is two
    assert split_nonlinear(two, slope, max_components=50, split_threshold=2.5) is two


def test_mixtures_together_are_each_alone() -> None:
    """Bit by bit, for mixtures of several sizes."""
    mixtures = [random_mixture(n, 3, seed) for seed, n in enumerate((1, 3, 1, 2))]
    observed = np.array([0.3, -0.2])

    def bend(x: np.ndarray) -> np.ndarray:
        return np.sin(x) + 0.1 * x * x

    def look(x: np.ndarray) -> np.ndarray:
        return bend(x) @ H.T

    moved = propagate_together(mixtures, bend, P.factors[0])
    updated = update_together(mixtures, observed, look, R)
    for mixture, one, other in zip(mixtures, moved, updated, strict=True):
        for result, alone in (
            (one, propagate_mixture(mixture, bend, P.factors[0])),
            (other, update_mixture(mixture, observed, look, R)),
        ):
            np.testing.assert_array_equal(result.weights, alone.weights)
            np.testing.assert_array_equal(result.means, alone.means)
            np.testing.assert_array_equal(result.covs, alone.covs)
