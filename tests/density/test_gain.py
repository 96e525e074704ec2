"""The three forms of the density's Kalman filter agree, keep mass and stay stable."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt.density import (
    Dense,
    FokkerPlanck,
    Grid,
    LowRank,
    Shared,
    dense_step,
    kernel_density,
    kernel_information,
    low_rank_start,
    low_rank_step,
    shared_moved,
    shared_start,
    shared_step,
    zero_mean_prior,
)
from distfilt.models import rotating_swarm

RNG = np.random.default_rng(1)


def _same(p: np.ndarray) -> np.ndarray:
    return p


def test_one_step_is_the_textbook_kalman_filter() -> None:
    n, dt = 5, 0.3
    phi = RNG.random((n, n))
    root, q = RNG.standard_normal((n, n)), RNG.standard_normal((n, 2))
    m, y, r = RNG.standard_normal(n), RNG.standard_normal(n), RNG.random(n) + 0.5
    p = phi @ (root @ root.T) @ phi.T + dt * q @ q.T
    gain = p @ np.linalg.inv(p + np.diag(r) / dt)
    wanted_mean, wanted_cov = phi @ m + gain @ (y - phi @ m), (np.eye(n) - gain) @ p

    def move(rows: np.ndarray) -> np.ndarray:
        return rows @ phi.T

    dense = dense_step(Dense(m, root @ root.T), move, y, r, dt, process=q)
    assert np.allclose(dense.mean, wanted_mean) and np.allclose(dense.covariance, wanted_cov)
    low = low_rank_step(LowRank(m, np.hstack([root, np.zeros((n, 2))])), move, y, r, dt, process=q)
    assert np.allclose(low.mean, wanted_mean)
    assert np.allclose(low.factor @ low.factor.T, wanted_cov)
    assert low.lost < 1e-12


def _case(reading: str, rank: int, steps: int, n: int = 12) -> tuple[Dense, Shared, LowRank]:
    """The three filters on the same measurements, with the same prior of the given rank."""
    grid = Grid((n, n))
    swarm = rotating_swarm(reading)
    flow, rng = FokkerPlanck(swarm, grid), np.random.default_rng(2)
    s = zero_mean_prior(grid, rank=rank)
    x = rng.random((100, 2))
    first = kernel_density(x, grid, bandwidth=0.08)
    dense, shared, low = Dense(first, s @ s.T), shared_start(s, first[None]), LowRank(first, s)
    k = kernel_information(grid, bandwidth=0.08, agents=100)
    for j in range(steps):
        t = 0.1 * j
        move = flow.solver(t, 0.1)
        x = swarm.step(x, t, 0.1, rng=rng, substeps=2)
        y = kernel_density(x, grid, bandwidth=0.08)
        r = k * np.maximum(move(dense.mean), 0.1)
        dense = dense_step(dense, move, y, r, 0.1)
        shared = shared_step(shared_moved(shared, move), y, r, 0.1)
        low = low_rank_step(low, move, y, r, 0.1)
    return dense, shared, low


@pytest.mark.parametrize("reading", ["gibbs", "slowgibbs"])
def test_shared_basis_and_low_rank_equal_dense_with_the_same_prior(reading: str) -> None:
    """Criterion 8: at the prior's full rank to 1e-10."""
    dense, shared, low = _case(reading, rank=143, steps=15)
    scale = np.abs(dense.mean).max()
    assert np.abs(shared.estimates[0] - dense.mean).max() < 1e-10 * scale
    assert np.abs(shared.covariance(0) - dense.covariance).max() < 1e-10
    assert np.abs(low.mean - dense.mean).max() < 1e-10 * scale
    assert np.abs(shared.variances[0] - np.diag(dense.covariance)).max() < 1e-10


def test_truncated_prior_is_close_to_the_whole() -> None:
    """Criterion 8: r = 100 to 1e-5 in the fast case."""
    whole, *_ = _case("gibbs", rank=143, steps=40)
    _, cut, _ = _case("gibbs", rank=100, steps=40)
    assert np.linalg.norm(cut.estimates[0] - whole.mean) < 1e-5 * np.linalg.norm(whole.mean)


@pytest.mark.slow
def test_truncated_prior_on_the_papers_grid() -> None:
    """Criterion 8 on 30 by 30 cells over six seconds, fast case: r = 100 to 1e-5, fifty to 1e-4."""
    grid, swarm, rng = Grid((30, 30)), rotating_swarm("gibbs"), np.random.default_rng(2)
    flow, full = FokkerPlanck(swarm, grid), zero_mean_prior(grid, rank=899)
    x = rng.random((100, 2))
    y = kernel_density(x, grid, bandwidth=0.08)
    dense = Dense(y, full @ full.T)
    cut = {r: shared_start(full[:, :r], y[None]) for r in (50, 100)}
    k = kernel_information(grid, bandwidth=0.08, agents=100)
    for j in range(60):
        move = flow.solver(0.1 * j, 0.1)
        x = swarm.step(x, 0.1 * j, 0.1, rng=rng, substeps=2)
        y = kernel_density(x, grid, bandwidth=0.08)
        r = k * np.maximum(move(dense.mean), 0.1)
        dense = dense_step(dense, move, y, r, 0.1)
        cut = {n: shared_step(shared_moved(s, move), y, r, 0.1) for n, s in cut.items()}
    apart = {n: np.linalg.norm(s.estimates[0] - dense.mean) for n, s in cut.items()}
    size = np.linalg.norm(dense.mean)
    assert apart[100] < 1e-5 * size and apart[50] < 1e-4 * size
    assert apart[100] < 0.1 * apart[50]


def test_mass_stays_over_hundreds_of_steps() -> None:
    grid = Grid((12, 12))
    dense, shared, low = _case("slowgibbs", rank=60, steps=600)
    for mean in (dense.mean, shared.estimates[0], low.mean):
        assert abs(grid.integral(mean) - 1) < 1e-12
    assert np.linalg.eigvalsh(shared.information[0]).min() > 1 - 1e-9


def test_stable_over_thousands_of_steps_with_process_noise() -> None:
    grid = Grid((12, 12))
    flow, s = FokkerPlanck(rotating_swarm("gibbs"), grid), zero_mean_prior(grid, rank=30)
    state, rng = low_rank_start(np.ones(144), s), np.random.default_rng(3)
    for j in range(2000):
        move = flow.solver(0.1 * j, 0.1)
        y = 1 + 0.3 * rng.standard_normal(144)
        state = low_rank_step(state, move, y, np.full(144, 0.1), 0.1, process=0.1 * s)
    assert np.isfinite(state.mean).all() and abs(grid.integral(state.mean) - 1) < 1e-10
    assert 1e-3 < np.linalg.norm(state.factor) < 100


def test_filters_do_not_see_each_other() -> None:
    grid = Grid((10, 10))
    move = FokkerPlanck(rotating_swarm(), grid).solver(0.0, 0.1)
    s = zero_mean_prior(grid, rank=40)
    base, y = RNG.random((6, 100)), RNG.random((6, 100))
    r = 0.1 + RNG.random((6, 100))
    many = shared_step(shared_moved(shared_start(s, base), move), y, r, 0.1)
    for i in range(6):
        one = shared_step(shared_moved(shared_start(s, base[i : i + 1]), move), y[i], r[i], 0.1)
        assert np.abs(one.estimates[0] - many.estimates[i]).max() < 1e-13
    everyone = shared_step(shared_moved(shared_start(s, base[:1]), move), y[0], r[0], 0.1)
    assert np.abs(everyone.information[0] - many.information[0]).max() < 1e-12


def test_an_infinite_noise_measures_nothing() -> None:
    grid = Grid((10, 10))
    state = shared_start(zero_mean_prior(grid, rank=40), RNG.random((3, 100)))
    r = np.ones((3, 100))
    r[1], r[2, 50:] = np.inf, np.inf
    after, huge = (shared_step(state, np.ones(100), np.minimum(r, m), 0.1) for m in (np.inf, 1e15))
    assert np.array_equal(after.estimates[1], state.estimates[1])
    assert np.abs(after.estimates - huge.estimates).max() < 1e-12


def test_prior_has_the_variance_and_the_mass_that_it_says() -> None:
    grid = Grid((20, 20), high=[2.0, 1.0])
    s = zero_mean_prior(grid, rank=399, length=0.2, std=0.7)
    assert (s**2).sum() / grid.size == pytest.approx(0.49, rel=1e-10)
    assert np.abs(s.sum(axis=0)).max() < 1e-10
    correlation = (s @ s.T)[190, 190 + 40] / (s @ s.T)[190, 190]  # two cells, 0.2, along axis 0
    assert correlation == pytest.approx(np.exp(-0.5), abs=0.1)
    assert np.array_equal(zero_mean_prior(grid, rank=50, length=0.2, std=0.7), s[:, :50])


def test_prior_may_leave_the_mass_open() -> None:
    grid = Grid((20, 20), high=[2.0, 1.0])
    s = zero_mean_prior(grid, rank=30, mass_std=0.2)
    assert np.array_equal(s[:, 1:], zero_mean_prior(grid, rank=30))
    assert np.ptp(s[:, 0]) == 0 and grid.integral(s[:, 0]) == pytest.approx(0.2, rel=1e-12)


def test_gain_from_the_observed_density_loses_mass() -> None:
    """Criterion 11: P0 = R0 and R from y lose mass, R from the forecast does not as much."""
    grid, swarm = Grid((14, 14)), rotating_swarm("gibbs")
    flow = FokkerPlanck(swarm, grid)
    k = kernel_information(grid, bandwidth=0.08, agents=100)
    rng = np.random.default_rng(4)
    x = rng.random((100, 2))
    first = kernel_density(x, grid, bandwidth=0.08)
    states = {name: Dense(first, np.diag(k * np.maximum(first, 0.05))) for name in "yp"}
    for j in range(300):
        move = flow.solver(0.1 * j, 0.1)
        x = swarm.step(x, 0.1 * j, 0.1, rng=rng, substeps=2)
        y = kernel_density(x, grid, bandwidth=0.08)
        for name, state in states.items():
            level = y if name == "y" else move(state.mean)
            states[name] = dense_step(state, move, y, k * np.maximum(level, 0.05), 0.1)
    lost = {name: 1 - float(grid.integral(state.mean)) for name, state in states.items()}
    assert lost["y"] > 0.05
    assert abs(lost["p"]) < 0.02


_S = zero_mean_prior(Grid((4, 4)), rank=3)
_SHARED = shared_start(_S, np.ones((2, 16)))
_DENSE = Dense(np.ones(16), np.eye(16))
_LOW = LowRank(np.ones(16), _S)
_Y, _R = np.ones(16), np.ones(16)
BAD_INPUT = {
    "distfilt.density.prior.zero_mean_prior": [
        ("grid", lambda: zero_mean_prior(3, rank=3)),
        ("rank", lambda: zero_mean_prior(Grid((4, 4)), rank=16)),
        ("length", lambda: zero_mean_prior(Grid((4, 4)), rank=3, length=0.0)),
        ("std", lambda: zero_mean_prior(Grid((4, 4)), rank=3, std=0.0)),
        ("mass_std", lambda: zero_mean_prior(Grid((4, 4)), rank=3, mass_std=-0.1)),
    ],
    "distfilt.density.gain.Dense": [("covariance", lambda: Dense(np.ones(3), np.eye(2)))],
    "distfilt.density.gain.dense_step": [
        ("state", lambda: dense_step(_SHARED, _same, _Y, _R, 0.1)),
        ("observed", lambda: dense_step(_DENSE, _same, _Y[:3], _R, 0.1)),
        ("noise", lambda: dense_step(_DENSE, _same, _Y, 0 * _R, 0.1)),
        ("dt", lambda: dense_step(_DENSE, _same, _Y, _R, 0.0)),
    ],
    "distfilt.density.gain.Shared": [
        ("information", lambda: Shared(_S, np.ones((2, 16)), np.eye(3), np.ones((2, 3)))),
        ("k", lambda: _SHARED.covariance(2)),
        ("k", lambda: _SHARED.covariance(-1)),
        ("k", lambda: _SHARED.covariance(True)),
    ],
    "distfilt.density.gain.shared_start": [("base", lambda: shared_start(_S, np.ones((2, 9))))],
    "distfilt.density.gain.shared_moved": [("state", lambda: shared_moved(_DENSE, _same))],
    "distfilt.density.gain.shared_step": [
        ("state", lambda: shared_step(_DENSE, _Y, _R, 0.1)),
        ("observed", lambda: shared_step(_SHARED, np.ones((3, 16)), _R, 0.1)),
        ("noise", lambda: shared_step(_SHARED, _Y, -_R, 0.1)),
        ("noise", lambda: shared_step(_SHARED, _Y, np.nan * _R, 0.1)),
        ("dt", lambda: shared_step(_SHARED, _Y, _R, -0.1)),
    ],
    "distfilt.density.gain.LowRank": [("factor", lambda: LowRank(np.ones(3), np.eye(2)))],
    "distfilt.density.gain.low_rank_start": [("mean", lambda: low_rank_start([[1.0]], _S))],
    "distfilt.density.gain.low_rank_step": [
        ("state", lambda: low_rank_step(_DENSE, _same, _Y, _R, 0.1)),
        ("noise", lambda: low_rank_step(_LOW, _same, _Y, 0 * _R, 0.1)),
        ("process", lambda: low_rank_step(_LOW, _same, _Y, _R, 0.1, process=np.ones((3, 1)))),
    ],
}


def test_a_prior_is_a_tenth_of_the_box_long_and_has_unit_deviation() -> None:
    grid = Grid((12, 12))
    plain = zero_mean_prior(grid, rank=20)
    assert np.array_equal(plain, zero_mean_prior(grid, rank=20, length=0.1, std=1.0))
    assert not np.allclose(plain, zero_mean_prior(grid, rank=20, length=0.2), atol=0.1)


def test_states_of_lists_are_those_of_arrays() -> None:
    basis, eye = _S.tolist(), np.eye(3).tolist()
    shared = Shared(basis, [[1.0] * 16], [eye], [[0.5, 1.0, 2.0]])
    wanted = Shared(_S, np.ones((1, 16)), np.eye(3)[None], np.array([[0.5, 1.0, 2.0]]))
    assert np.array_equal(shared.estimates, wanted.estimates)
    low = low_rank_step(LowRank([1.0] * 16, basis), _same, 2 * _Y, _R, 0.1)
    assert np.array_equal(low.mean, low_rank_step(_LOW, _same, 2 * _Y, _R, 0.1).mean)
    dense = dense_step(Dense([1.0] * 16, np.eye(16).tolist()), _same, 2 * _Y, _R, 0.1)
    assert np.array_equal(dense.mean, dense_step(_DENSE, _same, 2 * _Y, _R, 0.1).mean)
