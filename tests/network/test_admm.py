"""Consensus ADMM: the common minimiser, an honest stop, and what both residuals mean."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.checks import SolverError
from distfilt.network import Channel, Faults, graphs
from distfilt.network.admm import AdmmRun, admm
from distfilt.network.consensus import average, finite_time
from tests.network.helpers import NAN, STAR, lossy, rng, star

_A = "distfilt.network.admm."
_OWN = np.array([[1.0], [2.0], [6.0]])
_ZERO = np.zeros((3, 1))


def _quadratic(v: np.ndarray, rho: float) -> np.ndarray:
    return (_OWN + rho * v) / (1 + rho)


BAD_INPUT = {
    _A + "admm": [
        ("local_solve", lambda: admm(3, _ZERO, star())),
        ("local_solve", lambda: admm(lambda v, rho: v[:2], _ZERO, star())),
        ("local_solve", lambda: admm(lambda v, rho: NAN * v, _ZERO, star())),
        ("start", lambda: admm(_quadratic, np.zeros((2, 1)), star())),
        ("channel", lambda: admm(_quadratic, _ZERO, star(runs=(2,)))),
        ("channel", lambda: admm(_quadratic, _ZERO, None)),
        ("rho", lambda: admm(_quadratic, _ZERO, star(), rho=0.0)),
        ("tolerance", lambda: admm(_quadratic, _ZERO, star(), tolerance=0.0)),
        ("iterations", lambda: admm(_quadratic, _ZERO, star(), iterations=0)),
        ("admm", lambda: admm(_quadratic, _ZERO, star(), iterations=2)),
        ("agree", lambda: admm(_quadratic, _ZERO, star(), agree=None)),
        ("agree", lambda: admm(_quadratic, _ZERO, star(), agree=lambda v, c: v[:1])),
        ("check", lambda: admm(_quadratic, _ZERO, star(), check=0)),
        ("check", lambda: admm(_quadratic, _ZERO, lossy(), agree=average)),
    ],
}
EXEMPT = {_A + "AdmmRun": "a record that admm fills"}


def _by_hand(rho: float, iterations: int) -> list[tuple[float, float]]:
    """Residuals of every iteration from the printed formulas, with a true average."""
    z = w = _ZERO
    out = []
    for _ in range(iterations):
        u = _quadratic(z - w, rho)
        new = np.full_like(z, (u + w).mean())
        w = w + u - new
        out.append((float(np.abs(u - new).max()), float(rho * np.abs(new - z).max())))
        z = new
    return out


@given(st.integers(0, 1000), st.integers(2, 6), st.floats(0.3, 3))
def test_admm_finds_the_common_minimiser(seed: int, agents: int, rho: float) -> None:
    """Quadratic private objectives with different curvatures: the minimiser is a linear solve."""
    draw = rng(seed)
    curvature = draw.uniform(0.5, 2, (agents, 3))
    own = draw.standard_normal((agents, 3))
    run = admm(
        lambda v, r: (curvature * own + r * v) / (curvature + r),
        np.zeros((agents, 3)), Channel(graphs.path(agents)), rho=rho, tolerance=1e-9,
    )
    exact = (curvature * own).sum(axis=0) / curvature.sum(axis=0)
    assert np.abs(run.common - exact).max() < 1e-7
    assert np.abs(run.multipliers.sum(axis=0)).max() < 1e-9


@pytest.mark.parametrize("rho", [0.05, 0.3, 1.0, 8.0])
@pytest.mark.parametrize("check", [1, 3])
def test_it_stops_at_the_first_check_below_the_tolerance(rho: float, check: int) -> None:
    """Both residuals, the dual one with its ρ: each is the last to fall for some ρ."""
    series = _by_hand(rho, 600)
    tolerance = 1e-4
    run = admm(_quadratic, _ZERO, star(), rho=rho, tolerance=tolerance, check=check)
    good = [n for n, pair in enumerate(series, start=1) if max(pair) < tolerance]
    assert run.iterations == next(n for n in good if n % check == 0)
    assert np.isclose(run.primal, series[run.iterations - 1][0], rtol=1e-6, atol=1e-12)
    assert np.isclose(run.dual, series[run.iterations - 1][1], rtol=1e-6, atol=1e-12)


def test_each_residual_can_be_the_last() -> None:
    """The test above needs both cases: small ρ leaves the primal, large ρ the dual behind."""
    last = {}
    for rho in (0.05, 8.0):
        primal, dual = np.array(_by_hand(rho, 600)).T
        last[rho] = (np.flatnonzero(primal >= 1e-4).max(initial=-1),
                     np.flatnonzero(dual >= 1e-4).max(initial=-1))
    assert last[0.05][0] > last[0.05][1] or last[8.0][0] > last[8.0][1]
    assert last[0.05][1] > last[0.05][0] or last[8.0][1] > last[8.0][0]


def test_the_decision_to_stop_is_paid_for() -> None:
    """Rounds of averaging, and of the maximum of two numbers, which take the diameter each."""
    for check in (1, 4):
        channel = star()
        run = admm(_quadratic, _ZERO, channel, check=check)
        assert isinstance(run, AdmmRun)
        looks = run.iterations // check
        assert channel.ledger.rounds == 2 * run.iterations + 2 * looks
        sent = (2 * run.iterations + 2 * 2 * looks) * STAR.listeners
        assert (channel.ledger.scalars == sent).all()


def test_no_agent_looks_without_a_check() -> None:
    channel = star()
    run = admm(_quadratic, _ZERO, channel, check=None, iterations=7)
    assert run.iterations == 7 and channel.ledger.rounds == 14
    assert np.isclose(run.primal, _by_hand(1.0, 7)[-1][0])
    through = lossy(0.3)
    run = admm(_quadratic, _ZERO, through, check=None, iterations=60,
               agree=lambda v, c: average(v, c, rounds=60))
    assert np.abs(run.common - 3.0).max() < 1e-3


def test_the_residual_of_one_far_agent_keeps_all_going() -> None:
    """Only the last of a row has not settled: agent 0 hears of it in as many hops."""
    graph = graphs.path(5)
    own = np.array([[0.0], [0.0], [0.0], [0.0], [50.0]])
    calls = []

    def agree(values: np.ndarray, channel: Channel) -> np.ndarray:
        calls.append(1)
        return finite_time(values, channel)

    run = admm(lambda v, r: (own + r * v) / (1 + r), np.zeros((5, 1)), Channel(graph), agree=agree,
               tolerance=1e-3)
    assert len(calls) == run.iterations > 3 and max(run.primal, run.dual) < 1e-3
    assert np.abs(run.common - 10.0).max() < 0.01


def test_it_says_when_it_stops_short() -> None:
    primal, dual = _by_hand(1.0, 2)[-1]
    with pytest.raises(SolverError, match=f"{primal:.3g} and {dual:.3g} after 2 iterations"):
        admm(_quadratic, _ZERO, star(), iterations=2)
    with pytest.raises(SolverError, match="after 2 iterations"):
        admm(_quadratic, _ZERO, star(), iterations=2, check=5)


def test_admm_with_an_approximate_average() -> None:
    run = admm(_quadratic, _ZERO, star(), tolerance=1e-5,
               agree=lambda v, c: average(v, c, rounds=30))
    assert np.abs(run.common - 3.0).max() < 1e-3
    start = np.array([[1.0], [-4.0], [2.0]])
    before = start.copy()
    other = admm(_quadratic, start, star(), tolerance=1e-8)
    assert np.abs(other.common - 3.0).max() < 1e-6 and (start == before).all()


def test_faults_that_only_delay_are_faults_too() -> None:
    with pytest.raises(ValueError, match="check: needs a channel without faults"):
        admm(_quadratic, _ZERO, star(faults=Faults(delay=1)), agree=average)
