"""Following a moving average: lags, what is kept, stability, and steps within steps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.network import Channel, Faults, Graph, graphs, weights
from distfilt.network.tracking import (
    PIState,
    first_order,
    pi_start,
    pi_step,
    stable_substeps,
)
from tests.network.helpers import NAN, ONE_WAY, REFERENCE, UNBALANCED, rng, star

GAINS = {"alpha": 0.2, "a": 0.4, "b": 0.04}
_T = "distfilt.network.tracking."
_ZEROS = np.zeros((3, 2))


def _pi(**change: object) -> PIState:
    options: dict[str, object] = {"dt": 0.1, **GAINS} | change
    state = options.pop("state", pi_start(np.zeros((3, 1))))
    inputs = options.pop("inputs", np.zeros((3, 1)))
    return pi_step(state, inputs, options.pop("channel", star()), **options)


BAD_INPUT = {
    _T + "PIState": [
        ("estimate", lambda: PIState(np.zeros(3), np.zeros(3))),
        ("integral", lambda: PIState(np.zeros((3, 1)), np.zeros((2, 1)))),
    ],
    _T + "pi_start": [("estimate", lambda: pi_start([1.0, NAN]))],
    _T + "pi_step": [
        ("state", lambda: _pi(state=np.zeros((3, 1)))),
        ("state", lambda: _pi(state=pi_start(np.zeros((2, 1))))),
        ("inputs", lambda: _pi(inputs=np.zeros((3, 2)))),
        ("rate", lambda: _pi(rate=np.zeros((2, 1)))),
        ("dt", lambda: _pi(dt=0.0)),
        ("alpha", lambda: _pi(alpha=-0.1)),
        ("substeps", lambda: _pi(substeps=0)),
        ("substeps", lambda: _pi(substeps=3.9)),
        ("substeps", lambda: _pi(substeps=3.0)),
        ("channel", lambda: _pi(channel=Channel(ONE_WAY))),
        ("channel", lambda: _pi(channel=None)),
    ],
    _T + "stable_substeps": [
        ("channel", lambda: stable_substeps(graphs.star(3), 0.1, **GAINS)),
        ("dt", lambda: stable_substeps(star(), 0.0, **GAINS)),
        ("b", lambda: stable_substeps(star(), 0.1, alpha=0.2, a=0.4, b=-1.0)),
        ("alpha", lambda: stable_substeps(star(), 0.1, alpha=0.0, a=0.0, b=1.0)),
        ("safety", lambda: stable_substeps(star(), 0.1, **GAINS, safety=0.9)),
    ],
    _T + "first_order": [
        ("estimates", lambda: first_order(_ZEROS[:2], _ZEROS, _ZEROS, star())),
        ("inputs", lambda: first_order(_ZEROS, _ZEROS[:2], _ZEROS, star())),
        ("previous", lambda: first_order(_ZEROS, _ZEROS, NAN * _ZEROS, star())),
        ("channel", lambda: first_order(_ZEROS, _ZEROS, _ZEROS, None)),
        ("weights", lambda: first_order(_ZEROS, _ZEROS, _ZEROS, Channel(UNBALANCED),
                                        weights=weights.laplacian(UNBALANCED, 0.3))),
    ],
}


def _follow_ramp(graph: Graph, *, with_rate: bool, faults: Faults | None = None) -> np.ndarray:
    """Errors of the estimates' average after 100 s on inputs u_i = i + t, α = .2."""
    base = np.arange(graph.size, dtype=float)[:, None]
    state, ledger = pi_start(base), None
    for k in range(1000):
        channel = Channel(graph, ledger=ledger, faults=faults)
        rate = np.ones_like(base) if with_rate else None
        state = pi_step(state, base + 0.1 * k, channel, dt=0.1, rate=rate, **GAINS)
        ledger = channel.ledger
    return state.estimate - (base.mean() + 100.0)


@pytest.mark.parametrize("faults", [None, Faults(loss=0.2, seed=4)], ids=["whole", "lossy"])
def test_the_lag_behind_a_ramp_is_one_over_alpha(faults: Faults | None) -> None:
    lag = _follow_ramp(graphs.ring(5), with_rate=False, faults=faults).mean()
    assert abs(lag + 1 / GAINS["alpha"]) < 1e-6


@pytest.mark.parametrize("faults", [None, Faults(loss=0.2, seed=4)], ids=["whole", "lossy"])
def test_no_lag_with_the_derivative(faults: Faults | None) -> None:
    lag = _follow_ramp(graphs.ring(5), with_rate=True, faults=faults).mean()
    assert abs(lag) < 1e-10


@pytest.mark.parametrize("with_rate", [False, True])
def test_a_step_of_substeps_by_its_equations(with_rate: bool) -> None:
    """Euler steps of (25) with the inputs moving on inside the step, or standing still."""
    graph, n, dt = REFERENCE["grid"], 7, 0.3
    draw = rng(2)
    u, nu, eta = draw.standard_normal((3, graph.size, 2))
    slope = draw.standard_normal(u.shape) if with_rate else np.zeros_like(u)
    laplacian, h = graph.laplacian.toarray(), dt / n
    wanted_nu, wanted_eta = nu, eta
    for j in range(n):
        now = u + j * h * slope
        change = (-GAINS["alpha"] * (wanted_nu - now) - GAINS["a"] * laplacian @ wanted_nu
                  + GAINS["b"] * laplacian.T @ wanted_eta + slope)
        wanted_nu, wanted_eta = (
            wanted_nu + h * change, wanted_eta - h * GAINS["b"] * laplacian @ wanted_nu)
    channel = Channel(graph)
    state = pi_step(PIState(nu, eta), u, channel, dt=dt, rate=slope if with_rate else None,
                    substeps=n, **GAINS)
    assert np.abs(state.estimate - wanted_nu).max() < 1e-13
    assert np.abs(state.integral - wanted_eta).max() < 1e-13
    assert channel.ledger.rounds == n and (channel.ledger.scalars == 4 * n * graph.listeners).all()


def test_sum_of_the_estimates_forgets_at_the_rate_alpha() -> None:
    """For still inputs the average error shrinks by exactly 1 - α h in each substep."""
    u, graph = rng(1).standard_normal((6, 2)), graphs.ring(6)
    state = pi_start(np.ones((6, 2)))
    start = state.estimate.mean(axis=0) - u.mean(axis=0)
    for k in range(1, 41):
        state = pi_step(state, u, Channel(graph), dt=0.1, substeps=1, **GAINS)
        now = state.estimate.mean(axis=0) - u.mean(axis=0)
        assert np.abs(now - (1 - 0.2 * 0.1) ** k * start).max() < 1e-12


def test_sum_decays_on_a_moving_network_from_any_start() -> None:
    """Criterion 5: graph, integrators and first estimates do not matter to the sum."""
    draw = rng(5)
    u, nu, eta = draw.standard_normal((3, 20, 2))
    state = PIState(nu, eta)
    for k in range(1, 61):
        channel = Channel(graphs.disk(draw.random((20, 2)), 0.3))
        state = pi_step(state, u, channel, dt=0.1, substeps=1, **GAINS)
        gap = (state.estimate - u).sum(axis=0)
        assert np.abs(gap - (1 - 0.2 * 0.1) ** k * (nu - u).sum(axis=0)).max() < 1e-12


@pytest.mark.parametrize("b", [0.04, 0.2])
def test_disagreement_shrinks_as_the_spectrum_says(b: float) -> None:
    """Criterion 6: the slowest mode of a well-connected graph, against its two by two matrix."""
    graph = graphs.complete(12)
    lam = graph.spectrum[1]
    modes = np.linalg.eigvals([[-0.2 - 0.4 * lam, b * lam], [-b * lam, 0.0]]).real
    state, size = pi_start(rng(3).standard_normal((12, 1))), []
    for _ in range(400):
        state = pi_step(state, np.zeros((12, 1)), Channel(graph), dt=0.05, alpha=0.2, a=0.4, b=b,
                        substeps=6)
        size.append(np.linalg.norm(state.integral - state.integral.mean(axis=0)))
    rate = np.log(size[199] / size[399]) / (200 * 0.05)
    assert abs(rate / -modes.max() - 1) < 0.02


def test_pi_agrees_on_the_average_of_still_inputs() -> None:
    u = rng(1).standard_normal((6, 2))
    before = u.copy()
    state = pi_start(u)
    for _ in range(800):
        state = pi_step(state, u, Channel(graphs.ring(6)), dt=0.2, alpha=1.0, a=1.0, b=1.0)
    assert np.abs(state.estimate - u.mean(axis=0)).max() < 1e-9
    assert np.abs(state.integral.sum(axis=0)).max() < 1e-9 and (u == before).all()


def test_explicit_steps_blow_up_where_the_substeps_do_not() -> None:
    """A crowded graph, λ_max = 100: one step of .1 s is unstable, the chosen substeps are not."""
    graph, u = graphs.complete(100), rng(1).standard_normal((100, 1))
    ends = []
    for substeps in (1, None):
        state = pi_start(u)
        for _ in range(150):
            state = pi_step(state, u, Channel(graph), dt=0.1, substeps=substeps, **GAINS)
        ends.append(np.abs(state.estimate - u.mean()).max())
    assert ends[0] > 1e6 and ends[1] < 0.1


def test_the_safety_factor_is_what_it_says() -> None:
    """Twice the steps of the bound itself; at the bound the fastest possible mode only swings."""
    channel = Channel(graphs.complete(100))
    few, many = (stable_substeps(channel, 9.9, **GAINS, safety=s) for s in (1.0, 2.0))
    assert many in (2 * few, 2 * few - 1)
    bound = 2 * 99
    assert few == np.ceil(9.9 * (GAINS["alpha"] + GAINS["a"] * bound) / 2)
    assert stable_substeps(channel, 9.9, **GAINS) == many
    assert stable_substeps(channel, 1e-6, **GAINS) == 1


@given(st.integers(0, 500), st.floats(0.01, 2), st.floats(0, 2), st.floats(0, 2))
def test_the_chosen_substeps_are_stable(seed: int, alpha: float, a: float, b: float) -> None:
    """Every eigenvalue of every mode stays inside the unit circle."""
    graph = graphs.disk(rng(seed).random((12, 2)), 0.5)
    for safety in (1.0, 2.0):
        h = 0.1 / stable_substeps(Channel(graph), 0.1, alpha=alpha, a=a, b=b, safety=safety)
        for value in graph.spectrum:
            mode = np.array([[-alpha - a * value, b * value], [-b * value, 0.0]])
            moduli = np.abs(1 + h * np.linalg.eigvals(mode))
            assert (moduli <= 1 + 1e-12).all()


def test_first_order_tracking_on_a_digraph_with_balanced_weights() -> None:
    u = x = rng(3).standard_normal((3, 2))
    channel = Channel(UNBALANCED)
    for _ in range(200):
        new = u + 0.1 * np.array([1.0, -2.0])
        x, u = first_order(x, new, u, channel, weights=weights.balanced(UNBALANCED)), new
    assert np.abs(x - u.mean(axis=0)).max() < 1e-10


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_first_order_tracking_keeps_the_average_exactly(loss: float) -> None:
    graph, draw = graphs.ring(7), rng(3)
    u = x = draw.standard_normal((7, 2))
    for k in range(50):
        new = u + 0.1 * draw.standard_normal(u.shape)
        x = first_order(x, new, u, Channel(graph, faults=Faults(loss=loss, seed=k)))
        u = new
        assert np.abs(x.mean(axis=0) - u.mean(axis=0)).max() < 1e-12
    assert np.ptp(x, axis=0).max() < np.ptp(u, axis=0).max()


def test_substeps_stay_below_the_bound_of_a_swinging_mode() -> None:
    """Where 2 b λ exceeds α + a λ the bound is (α + a λ) / (b λ)², with λ twice the degree."""
    for b in (3.0, 0.9):
        wanted = np.ceil(5.0 * (b * 2) ** 2 / (0.3 + 0.1 * 2))
        channel = Channel(graphs.path(2))
        assert stable_substeps(channel, 5.0, alpha=0.3, a=0.1, b=b, safety=1.0) == wanted
