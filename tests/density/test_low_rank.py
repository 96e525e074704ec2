"""The two forms of the density's Kalman filter: their agreement, mass, compression, scale."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from distfilt import density
from distfilt.models import rotating_swarm

RNG = np.random.default_rng(1)


def _predict_and_step(
    state: density.LowRank,
    transition: Callable[[np.ndarray], np.ndarray],
    y: np.ndarray,
    r: np.ndarray,
    dt: float,
    process: np.ndarray | None = None,
) -> density.LowRank:
    forecast = density.low_rank_predict(state, transition, process=process, dt=dt)
    return density.low_rank_step(forecast, y, r, dt)


@pytest.mark.parametrize("filters", [1, 3, 20])
def test_two_steps_are_the_textbook_kalman_filter(filters: int) -> None:
    """With process noise, for any number of filters, each with its own data."""
    n = 5
    dt = 0.3
    phi = RNG.random((n, n)) / 2
    q = RNG.standard_normal((n, 2))
    # Two columns of zeros leave room for the process noise: nothing is truncated.
    square_root = RNG.standard_normal((n, n))
    root = np.hstack([square_root, np.zeros((n, 2))])
    means = RNG.standard_normal((filters, n))
    r = RNG.random((filters, n)) + 0.5
    state = density.low_rank_start(root, means)
    covs = np.tile(root @ root.T, (filters, 1, 1))
    for y in RNG.standard_normal((2, filters, n)):
        # The textbook's filter: P⁻ = Φ P Φᵀ + Q Δ, K = P⁻ (P⁻ + R/Δ)⁻¹
        means = means @ phi.T
        process_cov = dt * q @ q.T
        covs = phi @ covs @ phi.T + process_cov
        noise = r[:, :, None] * np.eye(n) / dt
        gains = covs @ np.linalg.inv(covs + noise)
        corrections = np.einsum("fij,fj->fi", gains, y - means)
        means = means + corrections
        covs = covs - gains @ covs
        state = _predict_and_step(state, lambda x: x @ phi.T, y, r, dt, q)
    assert np.allclose(state.estimates, means)
    for i, cov in enumerate(covs):
        assert np.allclose(state.covariance(i), cov)
        assert np.allclose(state.variances[i], np.diag(cov))


def test_compression_retains_the_largest_variance() -> None:
    """Of diag(9 + 1, 1) with rank one: the first component."""
    state = density.low_rank_start([[3.0], [0.0]], np.zeros((2, 2)))
    forecast = density.low_rank_predict(state, np.asarray, process=np.eye(2), dt=1.0)
    assert np.allclose(forecast.covariance(0), np.diag([10.0, 0.0]))


@pytest.mark.parametrize(
    ("interpretation", "rank", "steps"),
    [
        ("gibbs", 143, 15),
        ("slowgibbs", 143, 15),
        ("slowgibbs", 60, 200),
    ],
)
def test_low_rank_equals_dense_with_the_same_prior_and_both_conserve_the_mass(
    interpretation: str, rank: int, steps: int
) -> None:
    """To 1e-10 with the same measurements of a swarm, over hundreds of steps."""
    grid = density.Grid((12, 12))
    swarm = rotating_swarm(interpretation)
    equation = density.FokkerPlanck(swarm, grid)
    rng = np.random.default_rng(2)
    x = rng.random((100, 2))
    y = density.kernel_density(x, grid, bandwidth=0.08)
    prior = density.zero_mean_prior(grid, rank=rank)
    dense = density.Dense(y, prior @ prior.T)
    low = density.low_rank_start(prior, y[None])
    constant = density.kernel_constant(grid, bandwidth=0.08, agents=100)
    for k in range(steps):
        transition = equation.solver(0.1 * k, 0.1)
        x = swarm.step(x, 0.1 * k, 0.1, rng=rng, substeps=2)
        y = density.kernel_density(x, grid, bandwidth=0.08)
        # R = k̄ p, with a floor
        noise = constant * np.maximum(transition(dense.mean), 0.1)
        dense = density.dense_step(dense, transition, y, noise, 0.1)
        low = _predict_and_step(low, transition, y, noise, 0.1)
    estimate = low.estimates[0]
    error = np.abs(estimate - dense.mean).max()
    assert error < 1e-10 * np.abs(dense.mean).max()
    covariance_error = low.covariance(0) - dense.covariance
    assert np.abs(covariance_error).max() < 1e-10
    variance_error = low.variances[0] - np.diag(dense.covariance)
    assert np.abs(variance_error).max() < 1e-10
    # The prior's columns have no mass, so that no update changes it.
    masses = grid.integral(np.stack([dense.mean, estimate]))
    assert np.abs(masses - 1).max() < 1e-12
    # M = I + Sᵀ R⁻¹ S Δ + ... is at least the identity.
    assert np.linalg.eigvalsh(low.information[0]).min() > 1 - 1e-9


GRID = density.Grid((10, 10))
BASIS = density.zero_mean_prior(GRID, rank=40)


@pytest.mark.parametrize("process", [None, BASIS])
def test_filters_are_independent_and_an_infinite_noise_measures_nothing(
    process: np.ndarray | None,
) -> None:
    transition = density.FokkerPlanck(rotating_swarm(), GRID).solver(0.0, 0.1)
    rng = np.random.default_rng(7)
    base = rng.random((20, 100))
    y = rng.random((20, 100))
    r = 0.1 + rng.random((20, 100))
    # Filter 3 measures nothing, filter 4 half of the cells.
    r[3] = np.inf
    r[4, 50:] = np.inf
    start = density.low_rank_start(BASIS, base)
    forecast = density.low_rank_predict(start, transition, process=process, dt=0.1)
    analysis = density.low_rank_step(forecast, y, r, 0.1)
    # R⁻¹ = 0: no innovation enters.
    assert np.array_equal(analysis.estimates[3], forecast.estimates[3])
    # The limit of a huge noise
    limit = density.low_rank_step(forecast, y, np.minimum(r, 1e15), 0.1)
    limit_error = analysis.estimates - limit.estimates
    assert np.abs(limit_error).max() < 1e-12
    # Each filter by itself
    for i in (0, 4, 19):
        single = density.low_rank_start(BASIS, base[i : i + 1])
        single = _predict_and_step(single, transition, y[i], r[i], 0.1, process)
        estimate_error = single.estimates[0] - analysis.estimates[i]
        variance_error = single.variances[0] - analysis.variances[i]
        assert np.abs(estimate_error).max() < 1e-12
        assert np.abs(variance_error).max() < 1e-12


def test_an_ill_conditioned_information_is_an_error() -> None:
    """A step of 1e20 s, in which some cells are measured and others are not."""
    basis = np.eye(36)[:, :9]
    start = density.low_rank_start(basis, np.ones((1, 36)))
    # M = I + Δ Sᵀ R⁻¹ S has the eigenvalues 1 and 1 + 1e20.
    noise = np.where(np.arange(36) < 4, np.inf, 1.0)
    with pytest.raises(np.linalg.LinAlgError, match="density filter: .* out of scale"):
        density.low_rank_step(start, np.ones(36), noise, 1e20)
