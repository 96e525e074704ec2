"""What agents see and share: numbers of single rules, and the whole chain in other units."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt import density
from distfilt.density.snapshot import SwarmSnapshot
from distfilt.filters import DensityFilter
from distfilt.models import Swarm, rotating_swarm
from distfilt.network import Channel, graphs, weights

GRID = density.Grid((10, 10))
H = 0.12
X = np.random.default_rng(1).random((2, 6, 2))


def test_noise_is_the_constant_times_a_density_that_is_nowhere_zero() -> None:
    """Infinite for an agent that has gone; and nobody hears of less than one."""
    seen = SwarmSnapshot(
        np.where([[True]] * 5 + [[False]], X[0], np.nan), GRID, H, 0.0, (0, 5, 2)
    )
    p = np.random.default_rng(3).random((3, 100))
    got = seen.noise_strength(p, np.array([4.0, 9.0, 0.5, 1.0, 1.0, 7.0]), 0.3)
    one = density.kernel_constant(GRID, bandwidth=H, agents=1)
    assert np.allclose(got[0], one / 4 * np.where(p[0] < 0.3, 0.3, p[0]), rtol=1e-14)
    assert np.isinf(got[1]).all() and np.allclose(
        got[2], one * p[2].clip(0.3), rtol=1e-14
    )


def test_the_change_of_the_inputs_is_added() -> None:
    rule = density.DynamicAverage(modes=None)
    graph = graphs.path(6)
    before, now = (
        SwarmSnapshot(x, GRID, H, t) for x, t in zip(X, (0.0, 0.1), strict=True)
    )
    _, y, _ = rule.update(rule.initial_state(before), now, Channel(graph), 0.1)
    w = weights.metropolis(graph).matrix.toarray()
    wanted = w @ before.kernels + now.kernels - before.kernels
    assert np.abs(y - wanted).max() < 1e-12
    assert (
        np.abs(y.mean(axis=0) - density.kernel_density(X[1], GRID, bandwidth=H)).max()
        < 1e-12
    )
    for rate, wanted in ((True, now), (False, before)):
        pi = density.PIConsensus(alpha=0.5, a=1e-12, b=0.0, rate=rate)
        _, y, _ = pi.update(pi.initial_state(before), now, Channel(graph), 0.1)
        assert np.abs(y - wanted.kernels).max() < 1e-9


def test_agents_that_have_gone_do_not_count_in_the_noise() -> None:
    """Of six agents that all know each other two go: the others' data are worth four."""
    f = DensityFilter(
        density.FokkerPlanck(rotating_swarm(), GRID),
        6,
        graphs.complete(6),
        fusion=density.Flooding(forget=0.05),
        bandwidth=H,
        rank=20,
        initial_density=np.ones(100),
    )
    x = X[1].copy()
    x[4:] = np.nan
    start = f.start(X[0])
    state = f.step(start, 0.1, x)
    flat = np.maximum(f.model.solver(0.0, 0.1)(np.ones(100)), 0.1)
    S = f.model.solver(0.0, 0.1)(start.filters.basis.T).T
    R = density.kernel_constant(GRID, bandwidth=H, agents=4) * flat
    wanted = np.eye(20) + 0.1 * (S.T / R) @ S
    assert np.allclose(state.filters.information[:4], wanted, rtol=1e-10)
    assert np.array_equal(state.filters.information[4], np.eye(20))


@pytest.mark.parametrize("unit", [1e-3, 1e5])
@pytest.mark.parametrize(
    "rule",
    [
        density.Flooding(),
        density.PIConsensus(modes=30),
        density.PIConsensus(),
        density.DynamicAverage(modes=30),
    ],
)
def test_the_whole_chain_does_not_depend_on_units(unit: float, rule: object) -> None:
    """Swarm, grid, modes, prior, kernels, sharing and filters; defaults go with the box."""
    inside = rotating_swarm("gibbs")

    def made(u: float) -> tuple[np.ndarray, ...]:
        swarm = Swarm(
            lambda x, t: u * inside.drift_at(x / u, t),
            u**2 * 0.03,
            low=[0.0, 0.0],
            high=[u, u],
        )
        grid = density.Grid((10, 10), high=[u, u])
        f = DensityFilter(
            density.FokkerPlanck(swarm, grid),
            6,
            0.6 * u,
            fusion=rule,
            bandwidth=H * u,
            rank=20,
            process=0.3,
        )
        state = f.start(u * X[0])
        for k in range(4):
            state = f.step(state, 0.1 * (k + 1), u * X[k % 2])
        mass = f.summarize(state).numbers["mass"]
        return u**2 * state.estimates, u**4 * state.variances, mass

    for got, wanted in zip(made(unit), made(1.0), strict=True):
        assert np.abs(got - wanted).max() < 1e-9 * np.abs(wanted).max()
