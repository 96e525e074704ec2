"""Noise of the agents' estimates, single steps of consensus, and filters in other units."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from distfilt import density
from distfilt.density.snapshot import SwarmSnapshot
from distfilt.filters import DensityFilter
from distfilt.models import Swarm, rotating_swarm
from distfilt.network import Channel, Faults, Graph, graphs, weights

GRID = density.Grid((10, 10))
H = 0.12
# Positions of six agents at two times
X = np.random.default_rng(1).random((2, 6, 2))


def test_the_noise_is_the_constant_times_a_density_bounded_below() -> None:
    """Infinite for an absent agent; and no estimate is of less than one agent."""
    positions = X[0].copy()
    positions[5] = np.nan
    snapshot = SwarmSnapshot(positions, GRID, H, 0.0, (0, 5, 2))
    p = np.random.default_rng(3).random((3, 100))
    agents = np.array([4.0, 9.0, 0.5, 1.0, 1.0, 7.0])
    noise = snapshot.noise_strength(p, agents, 0.3)
    # The variance of a mean of n kernels is k̄ p / n.
    constant = density.kernel_constant(GRID, bandwidth=H, agents=1)
    # Agent 0 averages four kernels, and agent 2 one.
    expected = constant / 4 * p[0].clip(0.3)
    assert np.allclose(noise[0], expected, rtol=1e-14)
    assert np.isinf(noise[1]).all()
    expected = constant * p[2].clip(0.3)
    assert np.allclose(noise[2], expected, rtol=1e-14)


def _snapshots() -> tuple[SwarmSnapshot, SwarmSnapshot]:
    first = SwarmSnapshot(X[0], GRID, H, 0.0)
    second = SwarmSnapshot(X[1], GRID, H, 0.1)
    return first, second


def test_dynamic_average_consensus_mixes_and_adds_the_change_of_the_inputs() -> None:
    """W u + (u' - u), by hand; its mean is the swarm's estimate."""
    first, second = _snapshots()
    graph = graphs.path(6)
    rule = density.DynamicAverage(modes=None)
    memory = rule.initial_state(first)
    _, y, _ = rule.update(memory, second, Channel(graph), 0.1)
    w = weights.metropolis(graph).matrix.toarray()
    mixed = w @ first.kernels
    expected = mixed + second.kernels - first.kernels
    assert np.abs(y - expected).max() < 1e-12
    # Doubly stochastic weights conserve the mean.
    swarm = density.kernel_density(X[1], GRID, bandwidth=H)
    assert np.abs(y.mean(axis=0) - swarm).max() < 1e-12


def test_losses_on_one_way_links_move_the_average_and_are_warned_of_once() -> None:
    """A message that is lost for good: its receiver keeps w of its own value in its place.

    On a circle 0 → 1 → ... → 5 → 0 all weights are 1/2. Without the message from 0 to 1, agent 1
    keeps its u₁, so that the sum moves by (u₁ - u₀) / 2.
    """
    first, _ = _snapshots()
    circle = Graph.from_edges(6, [((k + 1) % 6, k) for k in range(6)], directed=True)
    loss = np.zeros((6, 6))
    loss[1, 0] = 1.0
    u = first.kernels
    rule = density.DynamicAverage(modes=None)
    memory = rule.initial_state(first)
    with pytest.warns(density.BiasedAverage, match="links both ways, or Flooding"):
        _, y, _ = rule.update(
            memory, first, Channel(circle, faults=Faults(loss=loss)), 0.1
        )
    moved = y.sum(axis=0) - u.sum(axis=0)
    assert np.allclose(moved, (u[1] - u[0]) / 2, atol=1e-12)
    with warnings.catch_warnings(action="error"):
        # Once for each rule; and never without losses, or with links both ways.
        rule.update(memory, first, Channel(circle, faults=Faults(loss=loss)), 0.1)
        other = density.DynamicAverage(modes=None)
        other.update(memory, first, Channel(circle), 0.1)
        faults = Faults(loss=0.5, seed=3)
        _, y, _ = other.update(
            memory, first, Channel(graphs.ring(6), faults=faults), 0.1
        )
    assert np.allclose(y.sum(axis=0), u.sum(axis=0), atol=1e-12)


@pytest.mark.parametrize("rate", [True, False])
def test_the_rate_of_the_inputs_removes_the_lag_of_pi_consensus(rate: bool) -> None:
    """With tiny gains: with the rate it is at the new inputs, without it at the old ones."""
    first, second = _snapshots()
    rule = density.PIConsensus(alpha=0.5, a=1e-12, b=0.0, rate=rate)
    memory = rule.initial_state(first)
    _, y, _ = rule.update(memory, second, Channel(graphs.path(6)), 0.1)
    # Without coupling an estimate only follows its own input.
    expected = second if rate else first
    assert np.abs(y - expected.kernels).max() < 1e-9


def test_absent_agents_do_not_count_in_the_noise() -> None:
    """Two of six agents that know each other disappear: the data of the others are of four."""
    model = density.FokkerPlanck(rotating_swarm(), GRID)
    f = DensityFilter(
        model,
        6,
        graphs.complete(6),
        fusion=density.Flooding(forget=0.05),
        bandwidth=H,
        rank=20,
        initial_density=np.ones(100),
    )
    positions = X[1].copy()
    positions[4:] = np.nan
    start = f.start(X[0])
    state = f.step(start, 0.1, positions)
    # The forecast's density and basis
    transition = f.model.solver(0.0, 0.1)
    forecast = transition(np.ones(100))
    S = transition(start.filters.basis.T).T
    # M = I + Δ Sᵀ R⁻¹ S with R of four agents, and M = I for absent ones
    constant = density.kernel_constant(GRID, bandwidth=H, agents=4)
    R = constant * np.maximum(forecast, 0.1)
    measured = (S.T / R) @ S
    expected = np.eye(20) + 0.1 * measured
    information = state.filters.information
    assert np.allclose(information[:4], expected, rtol=1e-10)
    assert np.array_equal(information[4], np.eye(20))


PROTOCOLS = [
    density.Flooding(),
    density.PIConsensus(modes=30),
    density.PIConsensus(),
    density.DynamicAverage(modes=30),
]


def _run_in_unit(protocol: object, unit: float) -> tuple[np.ndarray, ...]:
    """Estimates, variances and masses after four steps in a box of this width, without units."""
    swarm = rotating_swarm("gibbs")
    # x = s x': velocities have the unit s / s, diffusions s² / s.
    scaled = Swarm(
        lambda x, t: unit * swarm.drift_at(x / unit, t),
        unit**2 * 0.03,
        low=[0.0, 0.0],
        high=[unit, unit],
    )
    grid = density.Grid((10, 10), high=[unit, unit])
    # The radius of communication and the bandwidth are lengths.
    f = DensityFilter(
        density.FokkerPlanck(scaled, grid),
        6,
        0.6 * unit,
        fusion=protocol,
        bandwidth=H * unit,
        rank=20,
        process=0.3,
    )
    state = f.start(unit * X[0])
    for k in range(4):
        positions = unit * X[k % 2]
        state = f.step(state, 0.1 * (k + 1), positions)
    mass = f.summarize(state).numbers["mass"]
    # A density is an inverse area.
    return unit**2 * state.estimates, unit**4 * state.variances, mass


@pytest.mark.parametrize("unit", [1e-3, 1e5])
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_density_filter_does_not_depend_on_units(
    unit: float, protocol: object
) -> None:
    """Swarm, grid, modes, prior, kernels, consensus and filters; defaults scale with the box."""
    results = _run_in_unit(protocol, unit)
    expected = _run_in_unit(protocol, 1.0)
    for result, reference in zip(results, expected, strict=True):
        error = np.abs(result - reference).max()
        assert error < 1e-9 * np.abs(reference).max()
