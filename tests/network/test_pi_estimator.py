"""Proportional-integral estimators: lags, their equations, and the number of substeps."""

from __future__ import annotations

import numpy as np
import pytest

from distfilt import network
from distfilt.network import Channel, Faults, Graph, graphs
from tests.network.helpers import GRID, rng

GAINS = {"alpha": 0.2, "a": 0.4, "b": 0.04}


@pytest.mark.parametrize(("rate", "lag"), [(0.0, 1 / GAINS["alpha"]), (1.0, 0.0)])
def test_the_lag_behind_a_ramp(rate: float, lag: float) -> None:
    """1 / α without the derivative, none with it, through losses: inputs u_i = i + t for 100 s."""
    graph = graphs.ring(5)
    start = np.arange(5.0)[:, None]
    state = network.pi_start(start)
    ledger = None
    slope = rate * np.ones_like(start) if rate else None
    for k in range(1000):
        channel = Channel(graph, ledger=ledger, faults=Faults(loss=0.2, seed=4))
        inputs = start + 0.1 * k
        state = network.pi_step(state, inputs, channel, dt=0.1, rate=slope, **GAINS)
        ledger = channel.ledger
    # The consensus terms cancel in the mean, whose error follows e' = -α e + 1, or
    # e' = -α e with the rate: the limits are 1/α and 0.
    error = start.mean() + 100.0 - state.estimate.mean()
    assert abs(error - lag) < (1e-6 if lag else 1e-10)


@pytest.mark.parametrize("with_rate", [False, True])
def test_a_step_of_substeps_by_its_equations(with_rate: bool) -> None:
    """Euler steps of (25) with inputs that change inside the step, or stay."""
    n = 7
    dt = 0.3
    h = dt / n
    u, nu, eta = rng(2).standard_normal((3, GRID.n_agents, 2))
    slope = rng(3).standard_normal(u.shape) if with_rate else np.zeros_like(u)
    laplacian = GRID.laplacian.toarray()
    expected_nu = nu
    expected_eta = eta
    for j in range(n):
        inputs = u + j * h * slope
        derivative = (
            -GAINS["alpha"] * (expected_nu - inputs)
            - GAINS["a"] * laplacian @ expected_nu
            + GAINS["b"] * laplacian.T @ expected_eta
            + slope
        )
        # The integral takes the estimate from the beginning of the substep.
        expected_eta = expected_eta - h * GAINS["b"] * laplacian @ expected_nu
        expected_nu = expected_nu + h * derivative
    channel = Channel(GRID)
    rate = slope if with_rate else None
    start = network.PIState(nu, eta)
    options = {"dt": dt, "rate": rate, "substeps": n}
    state = network.pi_step(start, u, channel, **options, **GAINS)
    assert np.abs(state.estimate - expected_nu).max() < 1e-13
    assert np.abs(state.integral - expected_eta).max() < 1e-13
    # Estimates and integrals of two components on each link and substep.
    assert channel.ledger.rounds == n
    assert (channel.ledger.scalars == 4 * n * GRID.out_degree).all()


@pytest.mark.parametrize(
    ("graph", "dt", "gains", "limit"),
    [
        # λ = 2 · 99, and then 2 · 1
        (graphs.complete(100), 9.9, (0.2, 0.4, 0.04), 2 / (0.2 + 0.4 * 198)),
        (graphs.path(2), 5.0, (0.3, 0.1, 0.14), 2 / (0.3 + 0.1 * 2)),
        # The shorter of both: of 2 / 0.5 = 4 and 0.5 / 0.28² = 6.4 above, of 4 and 3.1 here
        (graphs.path(2), 5.0, (0.3, 0.1, 0.2), (0.3 + 0.1 * 2) / (0.2 * 2) ** 2),
        (graphs.path(2), 1e-6, (0.3, 0.1, 0.2), 1.0),
    ],
)
def test_substeps_are_half_as_long_as_the_bound(
    graph: Graph, dt: float, gains: tuple[float, float, float], limit: float
) -> None:
    """2 / (α + a λ), or (α + a λ) / (b λ)² where 2 b λ exceeds that, with λ twice the degree."""
    alpha, a, b = gains
    number = network.stable_substeps(Channel(graph), dt, alpha=alpha, a=a, b=b)
    # Substeps of half the bound: Δ / n <= limit / 2.
    assert number == np.ceil(2 * dt / limit)
