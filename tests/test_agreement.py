"""Following a moving average, consensus ADMM, and fusing Gaussians that share information."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt.checks import SolverError
from distfilt.network import Channel, Faults, Graph, graphs, weights
from distfilt.network.admm import AdmmRun, admm
from distfilt.network.consensus import average
from distfilt.network.fusion import (
    arithmetic_average,
    covariance_intersection,
    exchanged,
    naive_fusion,
)
from distfilt.network.tracking import (
    PIState,
    first_order,
    pi_start,
    pi_step,
    stable_substeps,
)

NAN = float("nan")
GAINS = {"alpha": 0.2, "a": 0.4, "b": 0.04}


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def _star(**options: object) -> Channel:
    return Channel(graphs.star(3), **options)


def _pi(**change: object) -> PIState:
    options: dict[str, object] = {"dt": 0.1, **GAINS}
    options.update(change)
    state = options.pop("state", pi_start(np.zeros((3, 1))))
    inputs = options.pop("inputs", np.zeros((3, 1)))
    return pi_step(state, inputs, options.pop("channel", _star()), **options)


def _quadratic(v: np.ndarray, rho: float) -> np.ndarray:
    return (np.array([[1.0], [2.0], [6.0]]) + rho * v) / (1 + rho)


_ZEROS, _EYES = np.zeros((3, 2)), np.tile(np.eye(2), (3, 1, 1))
_ONE_WAY = Graph.from_edges(3, [(0, 2), (1, 0), (2, 1)], directed=True)
_UNBALANCED = Graph.from_edges(3, [(0, 2), (1, 0), (2, 1), (0, 1)], directed=True)
_T = "distfilt.network.tracking."
_F = "distfilt.network.fusion."
_A = "distfilt.network.admm."


def _fusion_cases(rule: object) -> list[tuple[str, object]]:
    return [
        ("means", lambda: rule(np.zeros((2, 2)), _EYES, _star())),
        ("means", lambda: rule(NAN * _ZEROS, _EYES, _star())),
        ("covs", lambda: rule(_ZEROS, -_EYES, _star())),
        ("covs", lambda: rule(_ZEROS, _EYES[:, :1, :1], _star())),
        ("covs", lambda: rule(_ZEROS, np.triu(np.ones((3, 2, 2))) + _EYES, _star())),
        ("channel", lambda: rule(_ZEROS, _EYES, graphs.star(3))),
        ("rounds", lambda: rule(_ZEROS, _EYES, _star(), rounds=0)),
    ]


BAD_INPUT = {
    _T + "PIState": [("integral", lambda: PIState(np.zeros((3, 1)), np.zeros((2, 1))))],
    _T + "pi_start": [("estimate", lambda: pi_start([1.0, NAN]))],
    _T + "pi_step": [
        ("state", lambda: _pi(state=np.zeros((3, 1)))),
        ("state", lambda: _pi(state=pi_start(np.zeros((2, 1))))),
        ("inputs", lambda: _pi(inputs=np.zeros((3, 2)))),
        ("rate", lambda: _pi(rate=np.zeros((2, 1)))),
        ("dt", lambda: _pi(dt=0.0)),
        ("alpha", lambda: _pi(alpha=-0.1)),
        ("substeps", lambda: _pi(substeps=0)),
        ("channel", lambda: _pi(channel=Channel(_ONE_WAY))),
    ],
    _T + "stable_substeps": [
        ("dt", lambda: stable_substeps(_star(), 0.0, **GAINS)),
        ("b", lambda: stable_substeps(_star(), 0.1, alpha=0.2, a=0.4, b=-1.0)),
        ("alpha", lambda: stable_substeps(_star(), 0.1, alpha=0.0, a=0.0, b=1.0)),
    ],
    _T + "first_order": [
        ("estimates", lambda: first_order(_ZEROS[:2], _ZEROS, _ZEROS, _star())),
        ("inputs", lambda: first_order(_ZEROS, _ZEROS[:2], _ZEROS, _star())),
        ("previous", lambda: first_order(_ZEROS, _ZEROS, NAN * _ZEROS, _star())),
        ("channel", lambda: first_order(_ZEROS, _ZEROS, _ZEROS, None)),
        ("weights", lambda: first_order(_ZEROS, _ZEROS, _ZEROS, Channel(_UNBALANCED),
                                        weights=weights.laplacian(_UNBALANCED, 0.3))),
    ],
    _F + "covariance_intersection": [
        *_fusion_cases(covariance_intersection),
        ("weights", lambda: covariance_intersection(_ZEROS, _EYES, _star(), weights="best")),
    ],
    _F + "naive_fusion": _fusion_cases(naive_fusion),
    _F + "arithmetic_average": _fusion_cases(arithmetic_average),
    _F + "exchanged": [
        ("channel", lambda: exchanged(_ZEROS, _EYES, None, 1, lambda m, p, here: (m[0], p[0]))),
        ("rounds", lambda: exchanged(_ZEROS, _EYES, _star(), 0, lambda m, p, here: (m[0], p[0]))),
    ],
    _A + "admm": [
        ("local_solve", lambda: admm(3, np.zeros((3, 1)), _star())),
        ("local_solve", lambda: admm(lambda v, rho: v[:2], np.zeros((3, 1)), _star())),
        ("start", lambda: admm(_quadratic, np.zeros((2, 1)), _star())),
        ("channel", lambda: admm(_quadratic, np.zeros((3, 1)), _star(runs=(2,)))),
        ("rho", lambda: admm(_quadratic, np.zeros((3, 1)), _star(), rho=0.0)),
        ("tolerance", lambda: admm(_quadratic, np.zeros((3, 1)), _star(), tolerance=0.0)),
        ("iterations", lambda: admm(_quadratic, np.zeros((3, 1)), _star(), iterations=0)),
        ("admm", lambda: admm(_quadratic, np.zeros((3, 1)), _star(), iterations=2)),
        ("agree", lambda: admm(_quadratic, np.zeros((3, 1)), _star(), agree=None)),
    ],
}
EXEMPT = {_A + "AdmmRun": "a record that admm fills"}


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


def test_sum_of_the_estimates_forgets_at_the_rate_alpha() -> None:
    """For still inputs the average error shrinks by exactly 1 - α h in each substep."""
    u, graph = _rng(1).standard_normal((6, 2)), graphs.ring(6)
    state = pi_start(np.ones((6, 2)))
    start = state.estimate.mean(axis=0) - u.mean(axis=0)
    for k in range(1, 41):
        state = pi_step(state, u, Channel(graph), dt=0.1, substeps=1, **GAINS)
        now = state.estimate.mean(axis=0) - u.mean(axis=0)
        assert np.abs(now - (1 - 0.2 * 0.1) ** k * start).max() < 1e-12


def test_pi_agrees_on_the_average_of_still_inputs() -> None:
    u = _rng(1).standard_normal((6, 2))
    state = pi_start(u)
    for _ in range(800):
        channel = Channel(graphs.ring(6))
        state = pi_step(state, u, channel, dt=0.2, alpha=1.0, a=1.0, b=1.0)
    assert np.abs(state.estimate - u.mean(axis=0)).max() < 1e-9
    assert np.abs(state.integral.sum(axis=0)).max() < 1e-9


def test_explicit_steps_blow_up_where_the_substeps_do_not() -> None:
    """A crowded graph, λ_max = 100: one step of .1 s is unstable, the chosen substeps are not."""
    graph, u = graphs.complete(100), _rng(1).standard_normal((100, 1))
    ends = []
    for substeps in (1, None):
        state = pi_start(u)
        for _ in range(150):
            state = pi_step(state, u, Channel(graph), dt=0.1, substeps=substeps, **GAINS)
        ends.append(np.abs(state.estimate - u.mean()).max())
    assert ends[0] > 1e6 and ends[1] < 0.1


def test_first_order_tracking_on_a_digraph_with_balanced_weights() -> None:
    u = x = _rng(3).standard_normal((3, 2))
    channel = Channel(_UNBALANCED)
    for _ in range(200):
        new = u + 0.1 * np.array([1.0, -2.0])
        x, u = first_order(x, new, u, channel, weights=weights.balanced(_UNBALANCED)), new
    assert np.abs(x - u.mean(axis=0)).max() < 1e-10


@given(st.integers(0, 500), st.floats(0.01, 2), st.floats(0, 2), st.floats(0, 2))
def test_the_chosen_substeps_are_stable(seed: int, alpha: float, a: float, b: float) -> None:
    """Every eigenvalue of every mode stays inside the unit circle."""
    graph = graphs.disk(_rng(seed).random((12, 2)), 0.5)
    h = 0.1 / stable_substeps(Channel(graph), 0.1, alpha=alpha, a=a, b=b)
    for value in graph.spectrum:
        mode = np.array([[-alpha - a * value, b * value], [-b * value, 0.0]])
        moduli = np.abs(1 + h * np.linalg.eigvals(mode))
        assert (moduli <= 1 + 1e-12).all()


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_first_order_tracking_keeps_the_average_exactly(loss: float) -> None:
    graph, rng = graphs.ring(7), _rng(3)
    u = x = rng.standard_normal((7, 2))
    for k in range(50):
        new = u + 0.1 * rng.standard_normal(u.shape)
        x = first_order(x, new, u, Channel(graph, faults=Faults(loss=loss, seed=k)))
        u = new
        assert np.abs(x.mean(axis=0) - u.mean(axis=0)).max() < 1e-12


@given(st.integers(0, 1000), st.integers(2, 6), st.floats(0.3, 3))
def test_admm_finds_the_common_minimiser(seed: int, agents: int, rho: float) -> None:
    """Quadratic private objectives with different curvatures: the minimiser is a linear solve."""
    rng = _rng(seed)
    curvature = rng.uniform(0.5, 2, (agents, 3))
    own = rng.standard_normal((agents, 3))
    run = admm(
        lambda v, r: (curvature * own + r * v) / (curvature + r),
        np.zeros((agents, 3)), Channel(graphs.path(agents)), rho=rho, tolerance=1e-9,
    )
    exact = (curvature * own).sum(axis=0) / curvature.sum(axis=0)
    assert np.abs(run.common - exact).max() < 1e-7
    assert np.abs(run.multipliers.sum(axis=0)).max() < 1e-9


def test_admm_counts_what_it_sends_and_says_when_it_stops_short() -> None:
    channel = Channel(graphs.star(3))
    run = admm(_quadratic, np.zeros((3, 1)), channel)
    assert isinstance(run, AdmmRun)
    assert channel.ledger.rounds == 2 * run.iterations
    with pytest.raises(SolverError, match="after 2 iterations"):
        admm(_quadratic, np.zeros((3, 1)), _star(), iterations=2)


def test_admm_with_an_approximate_average() -> None:
    run = admm(
        _quadratic, np.zeros((3, 1)), _star(), tolerance=1e-5,
        agree=lambda v, c: average(v, c, rounds=30),
    )
    assert np.abs(run.common - 3.0).max() < 1e-3


def _gaussians(seed: int, agents: int, d: int) -> tuple[np.ndarray, np.ndarray]:
    rng = _rng(seed)
    a = rng.standard_normal((agents, d, d))
    return rng.standard_normal((agents, d)), a @ np.swapaxes(a, -1, -2) + 0.2 * np.eye(d)


@pytest.mark.parametrize("rule", ["fixed", "trace", "determinant"])
@given(seed=st.integers(0, 1000), d=st.integers(1, 4))
def test_fusing_the_same_belief_changes_nothing(rule: str, seed: int, d: int) -> None:
    m, p = (np.repeat(v[:1], 3, axis=0) for v in _gaussians(seed, 1, d))
    mean, cov = covariance_intersection(m, p, _star(), weights=rule)
    assert np.allclose(mean, m, atol=1e-9) and np.allclose(cov, p, atol=1e-9)
    mean, cov = arithmetic_average(m, p, _star())
    assert np.allclose(mean, m, atol=1e-9) and np.allclose(cov, p, atol=1e-9)


@pytest.mark.parametrize("rule", ["fixed", "trace", "determinant"])
@given(seed=st.integers(0, 1000), d=st.integers(1, 3))
def test_covariance_intersection_bounds_the_true_covariance(rule: str, seed: int, d: int) -> None:
    """Whatever the errors' correlation, P - P_true has no negative eigenvalue."""
    rng = _rng(seed)
    root = rng.standard_normal((2 * d, 2 * d))
    joint = root @ root.T + 0.1 * np.eye(2 * d)
    covs = np.stack([joint[:d, :d], joint[d:, d:]])
    _, fused = covariance_intersection(
        np.zeros((2, d)), covs, Channel(graphs.path(2)), weights=rule
    )
    # Unit means in place of data read off the linear map from both means to the fused one.
    maps = []
    for j in range(2):
        columns = []
        for k in range(d):
            means = np.zeros((2, d))
            means[j, k] = 1.0
            both, _ = covariance_intersection(
                means, covs, Channel(graphs.path(2)), weights=rule
            )
            columns.append(both[0])
        maps.append(np.array(columns).T)
    whole = np.hstack(maps)
    gap = fused[0] - whole @ joint @ whole.T
    assert np.linalg.eigvalsh(gap).min() > -1e-9 * np.abs(fused).max()


def test_determinant_weights_do_not_depend_on_units() -> None:
    m, p = _gaussians(1, 3, 2)
    units = np.diag([1000.0, 0.01])
    plain = covariance_intersection(m, p, _star(), weights="determinant")
    other = covariance_intersection(
        m @ units, units @ p @ units, _star(), weights="determinant"
    )
    assert np.allclose(other[0], plain[0] @ units)
    assert np.allclose(other[1], units @ plain[1] @ units)


def test_naive_fusion_grows_sure_of_one_measurement() -> None:
    """The same datum passed round and round: variance falls, although nothing new was learned."""
    m, p = np.zeros((3, 1)), np.ones((3, 1, 1))
    assert naive_fusion(m, p, _star(), rounds=5)[1].max() < 0.02
    assert np.allclose(covariance_intersection(m, p, _star(), rounds=5)[1], 1.0)


def test_naive_fusion_of_independent_estimates_is_right() -> None:
    m, p = _gaussians(2, 2, 2)
    mean, cov = naive_fusion(m, p, Channel(graphs.path(2)))
    info = np.linalg.inv(p)
    exact = np.linalg.inv(info.sum(axis=0))
    assert np.allclose(cov[0], exact)
    assert np.allclose(mean[0], exact @ (info @ m[..., None]).sum(axis=0)[:, 0])


def test_fusion_sends_mean_and_half_the_covariance() -> None:
    for d, floats in ((6, 27), (13, 104)):
        channel = _star()
        covariance_intersection(np.zeros((3, d)), np.tile(np.eye(d), (3, 1, 1)), channel)
        assert (channel.ledger.scalars == floats * np.array([2, 1, 1])).all()


@pytest.mark.parametrize("rule", [covariance_intersection, arithmetic_average, naive_fusion])
def test_fusion_in_a_batch_is_fusion_run_by_run(rule: object) -> None:
    m = _rng(1).standard_normal((4, 3, 2))
    p = np.tile(np.eye(2), (4, 3, 1, 1)) * _rng(2).uniform(0.5, 2, (4, 3, 1, 1))
    faults = Faults(loss=0.4, seed=1)
    whole = rule(m, p, _star(runs=(4,), faults=faults))
    first = rule(m[0], p[0], _star(faults=faults))
    assert np.allclose(whole[0][0], first[0]) and np.allclose(whole[1][0], first[1])
    alone = rule(m, p, _star(runs=(4,), faults=Faults(loss=1.0)))
    assert np.allclose(alone[0], m) and np.allclose(alone[1], p)


def test_repeated_intersection_agrees() -> None:
    m, p = _gaussians(5, 5, 2)
    mean, cov = covariance_intersection(m, p, Channel(graphs.ring(5)), rounds=60)
    assert np.ptp(mean, axis=0).max() < 1e-6 and np.ptp(cov, axis=0).max() < 1e-6
    assert weights.metropolis(graphs.ring(5)).own.min() > 0
