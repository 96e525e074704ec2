"""The two forms of the density's Kalman filter agree, keep mass and stay stable."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt import density
from distfilt.models import rotating_swarm

RNG = np.random.default_rng(1)


def _stepped(
    state: density.LowRank,
    move: object,
    y: np.ndarray,
    r: np.ndarray,
    dt: float,
    process: np.ndarray | None = None,
) -> density.LowRank:
    moved = density.low_rank_predict(state, move, process=process, dt=dt)
    return density.low_rank_step(moved, y, r, dt)


@pytest.mark.parametrize("filters", [1, 3, 20])
def test_two_steps_are_the_textbook_kalman_filter(filters: int) -> None:
    """With process noise, for any number of filters with data of their own."""
    n = 5
    dt = 0.3
    phi = RNG.random((n, n)) / 2
    q = RNG.standard_normal((n, 2))
    root = np.hstack([RNG.standard_normal((n, n)), np.zeros((n, 2))])
    base = RNG.standard_normal((filters, n))
    r = RNG.random((filters, n)) + 0.5
    low = density.low_rank_start(root, base)
    wanted = [(m, root @ root.T) for m in base]
    for y in RNG.standard_normal((2, filters, n)):
        for i, (m, p) in enumerate(wanted):
            p = phi @ p @ phi.T + dt * q @ q.T
            gain = p @ np.linalg.inv(p + np.diag(r[i]) / dt)
            wanted[i] = phi @ m + gain @ (y[i] - phi @ m), (np.eye(n) - gain) @ p
        low = _stepped(low, lambda x: x @ phi.T, y, r, dt, q)
    for i, (m, p) in enumerate(wanted):
        assert np.allclose(low.estimates[i], m) and np.allclose(low.covariance(i), p)
        assert np.allclose(low.variances[i], np.diag(p))


def test_compression_keeps_the_largest_part() -> None:
    state = density.low_rank_start(np.diag([3.0, 1.0])[:, :1], np.zeros((2, 2)))
    moved = density.low_rank_predict(state, np.asarray, process=np.eye(2), dt=1.0)
    assert np.allclose(moved.covariance(0), np.diag([10.0, 0.0]))


@pytest.mark.parametrize(
    ("reading", "rank", "steps"),
    [
        ("gibbs", 143, 15),
        ("slowgibbs", 143, 15),
        ("slowgibbs", 60, 200),
    ],
)
def test_low_rank_equals_dense_with_the_same_prior_and_both_keep_the_mass(
    reading: str, rank: int, steps: int
) -> None:
    """Criterion 8: with the same prior and measurements to 1e-10; mass over hundreds of steps."""
    grid = density.Grid((12, 12))
    swarm = rotating_swarm(reading)
    flow = density.FokkerPlanck(swarm, grid)
    rng = np.random.default_rng(2)
    x = rng.random((100, 2))
    y = density.kernel_density(x, grid, bandwidth=0.08)
    prior = density.zero_mean_prior(grid, rank=rank)
    dense = density.Dense(y, prior @ prior.T)
    low = density.low_rank_start(prior, y[None])
    k = density.kernel_constant(grid, bandwidth=0.08, agents=100)
    for j in range(steps):
        move = flow.solver(0.1 * j, 0.1)
        x = swarm.step(x, 0.1 * j, 0.1, rng=rng, substeps=2)
        y = density.kernel_density(x, grid, bandwidth=0.08)
        noise = k * np.maximum(move(dense.mean), 0.1)
        dense = density.dense_step(dense, move, y, noise, 0.1)
        low = _stepped(low, move, y, noise, 0.1)
    assert (
        np.abs(low.estimates[0] - dense.mean).max() < 1e-10 * np.abs(dense.mean).max()
    )
    assert np.abs(low.covariance(0) - dense.covariance).max() < 1e-10
    assert np.abs(low.variances[0] - np.diag(dense.covariance)).max() < 1e-10
    assert (
        np.abs(grid.integral(np.stack([dense.mean, low.estimates[0]])) - 1).max()
        < 1e-12
    )
    assert np.linalg.eigvalsh(low.information[0]).min() > 1 - 1e-9


def test_filters_do_not_see_each_other_and_infinite_noise_measures_nothing() -> None:
    grid = density.Grid((10, 10))
    move = density.FokkerPlanck(rotating_swarm(), grid).solver(0.0, 0.1)
    s = density.zero_mean_prior(grid, rank=40)
    base = RNG.random((20, 100))
    y = RNG.random((20, 100))
    r = 0.1 + RNG.random((20, 100))
    r[3] = np.inf
    r[4, 50:] = np.inf
    for q in (None, s):
        start = density.low_rank_predict(
            density.low_rank_start(s, base), move, process=q, dt=0.1
        )
        many = density.low_rank_step(start, y, r, 0.1)
        huge = density.low_rank_step(start, y, np.minimum(r, 1e15), 0.1)
        assert np.abs(many.estimates - huge.estimates).max() < 1e-12
        assert np.array_equal(many.estimates[3], start.estimates[3])
        for i in (0, 4, 19):
            one = _stepped(
                density.low_rank_start(s, base[i : i + 1]), move, y[i], r[i], 0.1, q
            )
            assert np.abs(one.estimates[0] - many.estimates[i]).max() < 1e-12
            assert np.abs(one.variances[0] - many.variances[i]).max() < 1e-12


def test_what_is_out_of_scale_is_named() -> None:
    start = density.low_rank_start(np.eye(36)[:, :9], np.ones((1, 36)))
    ones = np.ones(36)
    with pytest.raises(np.linalg.LinAlgError, match="density filter: .* out of scale"):
        density.low_rank_step(
            start, ones, np.where(np.arange(36) < 4, np.inf, 1.0), 1e20
        )
