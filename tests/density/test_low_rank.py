"""The two forms of the density's Kalman filter agree, keep mass and stay stable."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.density import (
    Dense,
    FokkerPlanck,
    Grid,
    LowRank,
    dense_step,
    kernel_density,
    kernel_information,
    low_rank_moved,
    low_rank_start,
    low_rank_step,
    zero_mean_prior,
)
from distfilt.models import rotating_swarm

RNG = np.random.default_rng(1)


def _stepped(state: LowRank, move: object, y: np.ndarray, r: np.ndarray, dt: float,
             process: np.ndarray | None = None) -> LowRank:
    return low_rank_step(low_rank_moved(state, move, process=process, dt=dt), y, r, dt)


@pytest.mark.parametrize("filters", [1, 3, 20])
def test_two_steps_are_the_textbook_kalman_filter(filters: int) -> None:
    """With process noise, for any number of filters with data of their own."""
    n, dt = 5, 0.3
    phi, q = RNG.random((n, n)) / 2, RNG.standard_normal((n, 2))
    root = np.hstack([RNG.standard_normal((n, n)), np.zeros((n, 2))])
    base, r = RNG.standard_normal((filters, n)), RNG.random((filters, n)) + 0.5
    low = low_rank_start(root, base)
    wanted = [(m, root @ root.T) for m in base]
    dense = [Dense(*each) for each in wanted]
    for y in RNG.standard_normal((2, filters, n)):
        for i, (m, p) in enumerate(wanted):
            p = phi @ p @ phi.T + dt * q @ q.T
            gain = p @ np.linalg.inv(p + np.diag(r[i]) / dt)
            wanted[i] = phi @ m + gain @ (y[i] - phi @ m), (np.eye(n) - gain) @ p
            dense[i] = dense_step(dense[i], lambda x: x @ phi.T, y[i], r[i], dt, process=q)
        low = _stepped(low, lambda x: x @ phi.T, y, r, dt, q)
    for i, (m, p) in enumerate(wanted):
        assert np.allclose(dense[i].mean, m) and np.allclose(dense[i].covariance, p)
        assert np.allclose(low.estimates[i], m) and np.allclose(low.covariance(i), p)
        assert np.allclose(low.variances[i], np.diag(p))


def test_compression_keeps_the_largest_part() -> None:
    state = low_rank_start(np.diag([3.0, 1.0])[:, :1], np.zeros((2, 2)))
    moved = low_rank_moved(state, np.asarray, process=np.eye(2), dt=1.0)
    assert np.allclose(moved.covariance(0), np.diag([10.0, 0.0]))


@pytest.mark.parametrize(("reading", "rank", "steps"), [
    ("gibbs", 143, 15), ("slowgibbs", 143, 15), ("slowgibbs", 60, 600),
])
def test_low_rank_equals_dense_with_the_same_prior_and_both_keep_the_mass(
    reading: str, rank: int, steps: int
) -> None:
    """Criterion 8: with the same prior and measurements to 1e-10; mass over hundreds of steps."""
    grid, swarm = Grid((12, 12)), rotating_swarm(reading)
    flow, rng = FokkerPlanck(swarm, grid), np.random.default_rng(2)
    x = rng.random((100, 2))
    y, prior = kernel_density(x, grid, bandwidth=0.08), zero_mean_prior(grid, rank=rank)
    dense, low = Dense(y, prior @ prior.T), low_rank_start(prior, y[None])
    k = kernel_information(grid, bandwidth=0.08, agents=100)
    for j in range(steps):
        move = flow.solver(0.1 * j, 0.1)
        x = swarm.step(x, 0.1 * j, 0.1, rng=rng, substeps=2)
        y = kernel_density(x, grid, bandwidth=0.08)
        noise = k * np.maximum(move(dense.mean), 0.1)
        dense = dense_step(dense, move, y, noise, 0.1)
        low = _stepped(low, move, y, noise, 0.1)
    assert np.abs(low.estimates[0] - dense.mean).max() < 1e-10 * np.abs(dense.mean).max()
    assert np.abs(low.covariance(0) - dense.covariance).max() < 1e-10
    assert np.abs(low.variances[0] - np.diag(dense.covariance)).max() < 1e-10
    assert np.abs(grid.integral(np.stack([dense.mean, low.estimates[0]])) - 1).max() < 1e-12
    assert np.linalg.eigvalsh(low.information[0]).min() > 1 - 1e-9


def test_stable_over_thousands_of_steps_with_process_noise() -> None:
    grid = Grid((12, 12))
    flow, s = FokkerPlanck(rotating_swarm("gibbs"), grid), zero_mean_prior(grid, rank=30)
    state, rng = low_rank_start(s, np.ones((1, 144))), np.random.default_rng(3)
    for j in range(2000):
        y = 1 + 0.3 * rng.standard_normal(144)
        state = _stepped(state, flow.solver(0.1 * j, 0.1), y, np.full(144, 0.1), 0.1, 0.1 * s)
    assert abs(grid.integral(state.estimates[0]) - 1) < 1e-10
    assert 1e-3 < np.sqrt(state.variances.sum()) < 100


def test_filters_do_not_see_each_other_and_infinite_noise_measures_nothing() -> None:
    grid = Grid((10, 10))
    move = FokkerPlanck(rotating_swarm(), grid).solver(0.0, 0.1)
    s, base = zero_mean_prior(grid, rank=40), RNG.random((20, 100))
    y, r = RNG.random((20, 100)), 0.1 + RNG.random((20, 100))
    r[3], r[4, 50:] = np.inf, np.inf
    for q in (None, s):
        start = low_rank_moved(low_rank_start(s, base), move, process=q, dt=0.1)
        many = low_rank_step(start, y, r, 0.1)
        huge = low_rank_step(start, y, np.minimum(r, 1e15), 0.1)
        assert np.abs(many.estimates - huge.estimates).max() < 1e-12
        assert np.array_equal(many.estimates[3], start.estimates[3])
        for i in (0, 4, 19):
            one = _stepped(low_rank_start(s, base[i : i + 1]), move, y[i], r[i], 0.1, q)
            assert np.abs(one.estimates[0] - many.estimates[i]).max() < 1e-12
            assert np.abs(one.variances[0] - many.variances[i]).max() < 1e-12


def test_prior_has_the_variance_the_length_and_the_mass_that_it_says() -> None:
    grid = Grid((20, 20), high=[2.0, 1.0])
    s = zero_mean_prior(grid, rank=399, length=0.2, std=0.7)
    assert (s**2).sum() / grid.size == pytest.approx(0.49, rel=1e-10)
    assert np.abs(s.sum(axis=0)).max() < 1e-10
    correlation = (s @ s.T)[190, 190 + 40] / (s @ s.T)[190, 190]  # two cells, 0.2, along axis 0
    assert correlation == pytest.approx(np.exp(-0.5), abs=0.1)
    assert np.array_equal(zero_mean_prior(grid, rank=50, length=0.2, std=0.7), s[:, :50])
    loose = zero_mean_prior(grid, rank=30, mass_std=0.2)
    assert np.array_equal(loose[:, 1:], zero_mean_prior(grid, rank=30))
    assert np.ptp(loose[:, 0]) == 0 and grid.integral(loose[:, 0]) == pytest.approx(0.2, rel=1e-12)


def test_a_prior_is_a_tenth_of_the_box_long_and_as_wide_as_the_mean_density() -> None:
    grid = Grid((12, 12), high=[20.0, 5.0])
    wanted = zero_mean_prior(grid, rank=20, length=1.0, std=0.01)
    assert np.allclose(zero_mean_prior(grid, rank=20), wanted, rtol=1e-12)


def test_a_prior_far_longer_than_the_box_is_its_lowest_modes() -> None:
    """exp(-π²ℓ²|k|²/2) underflows for all modes; what counts is their ratio."""
    s = zero_mean_prior(Grid((9, 9)), rank=5, length=1e12, std=0.5)
    assert np.allclose((s**2).mean(axis=0), [0.125, 0.125, 0, 0, 0])


def test_a_covariance_that_is_none_is_refused_or_named() -> None:
    with pytest.raises(ValueError, match="covariance: .* semidefinite"):
        Dense(np.ones(2), np.diag([1.0, -1.0]))
    grid = Grid((6, 6))
    flow, s = FokkerPlanck(rotating_swarm(), grid), zero_mean_prior(grid, rank=9)
    start = low_rank_start(s, np.ones((1, 36)))
    singular = LowRank(s, np.ones((1, 36)), np.ones((1, 9, 9)), np.zeros((1, 9)))
    for call in (
        lambda: _stepped(start, flow.solver(0.0, 1e300), np.ones(36), np.ones(36), 1e300),
        lambda: low_rank_moved(start, np.asarray, process=1e200 * s, dt=1.0),
        lambda: singular.estimates,
        lambda: singular.variances,
    ):
        with (pytest.raises(np.linalg.LinAlgError, match="density filter: .* out of scale"),
              np.errstate(all="ignore")):
            call()
