"""A known constant, a component of variance zero: the state without it has the same answer.

| Project | Report | Here |
|---|---|---|
| own | a calibrated bias in the state with variance zero, unscented | equals the state without |
| own | the same in `kalman_filter` and its smoother | equals the state without it |
| own | agents that share such a constant, by every rule of fusion | equals the state without it |
| own | ensembles that share it, by intersection | equals the ensembles without it |
| equinor/ert 9581, helske/bssm 5 | a constant in an ensemble that a map moves | as without it |
| CliMA/EnsembleKalmanProcesses.jl 517 | components that others determine | they follow |

A bias b that is known to be 0.5 adds to the observation; without it 0.5 is subtracted beforehand.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import filters, network
from distfilt.kalman import kalman_filter, rts_smoother
from distfilt.models import LinearModel, Model
from distfilt.network import Channel, graphs
from distfilt.sensors import Sensor, component
from distfilt.triangular import separable
from distfilt.updates import transport_map_update

BIAS = 0.5
PRIOR = (np.array([1.0, -0.5]), np.array([[1.0, 0.3], [0.3, 0.8]]))
WITH_BIAS = (np.array([1.0, -0.5, BIAS]), np.pad(PRIOR[1], ((0, 1), (0, 1))))
Q = np.array([[0.3, 0.1], [0.1, 0.2]])
SEEN = np.array([[1.2], [0.4], [np.nan], [0.9]])
TIMES = np.arange(1.0, 5.0)


def bend(x: np.ndarray, t: float, dt: float) -> np.ndarray:
    first = x[..., 0] + 0.5 * np.sin(x[..., 1])
    second = 0.9 * x[..., 1]
    moved = np.stack([first, second], axis=-1)
    return np.concatenate([moved, x[..., 2:]], axis=-1)


SHORT = Model(2, bend, lambda t, dt: Q)
LONG = Model(3, bend, lambda t, dt: np.pad(Q, ((0, 1), (0, 1))))
SQUARE = Sensor(1, lambda x: x[..., :1] ** 2, [[0.4]])
BIASED = Sensor(1, lambda x: x[..., :1] ** 2 + x[..., 2:], [[0.4]])
LONG_WALK = LinearModel.from_transition(
    3, lambda dt: np.eye(3), lambda t, dt: np.pad(Q, ((0, 1), (0, 1)))
)
LINEAR_BIASED = Sensor(
    1,
    lambda x: x[..., :1] + x[..., 2:],
    [[0.4]],
    linear=lambda d: np.array([[1.0, 0.0, 1.0]]),
)


@pytest.mark.parametrize("linearization", ["extended", "unscented"])
@pytest.mark.parametrize("lag", [0, 2])
def test_gaussian_filters_know_a_constant(linearization: Any, lag: int) -> None:
    """With κ larger by one in the shorter state, so that d + κ and the points are the same."""
    make = partial(filters.GaussianFilter, linearization=linearization, lag=lag)
    long = make(LONG, [BIASED], kappa=1.0)
    short = make(SHORT, [SQUARE], kappa=2.0)
    method = "smooth" if lag else "run"
    # Observations with the bias, and a filter that knows it, against those without it
    a = getattr(long, method)(long.start(WITH_BIAS), TIMES, [SEEN + BIAS])
    b = getattr(short, method)(short.start(PRIOR), TIMES, [SEEN])
    mean = a["mean"].values
    covariance = a["covariance"].values
    assert np.allclose(mean[..., :2], b["mean"].values, atol=1e-10)
    block = covariance[..., :2, :2]
    assert np.allclose(block, b["covariance"].values, atol=1e-10)
    # The constant stays, to the bit.
    assert (mean[..., 2] == BIAS).all()
    assert (covariance[..., 2, 2] == 0).all()


def test_a_covariance_that_is_not_one_still_ends_the_run() -> None:
    f = filters.GaussianFilter(SHORT, [SQUARE], linearization="unscented")
    state = f.start(PRIOR)
    wrong = state.replace(joint_covariances=np.diag([1.0, -1.0])[None])
    with pytest.raises(filters.FilterError, match="positive semidefinite"):
        f.step(wrong, 1.0, [[1.0]])


def test_kalman_filter_and_smoother_know_a_constant() -> None:
    f = np.array([[1.0, 0.5], [-0.2, 0.9]])
    long_f = np.pad(f, ((0, 1), (0, 1)))
    long_f[2, 2] = 1.0
    long_q = np.pad(Q, ((0, 1), (0, 1)))
    noise = {"R": [[0.4]]}
    long = kalman_filter(
        *WITH_BIAS,
        SEEN + BIAS,
        F=long_f,
        Q=long_q,
        H=[[1.0, 0.0, 1.0]],
        **noise,
    )
    short = kalman_filter(*PRIOR, SEEN, F=f, Q=Q, H=[[1.0, 0.0]], **noise)
    smooth_long = rts_smoother(long, F=long_f, Q=long_q)
    smooth_short = rts_smoother(short, F=f, Q=Q)
    # The blocks of the first two components, filtered and smoothed
    for a, b in ((long, short), (smooth_long, smooth_short)):
        assert np.allclose(a.means[..., :2], b.means, atol=1e-12)
        assert np.allclose(a.covariances[..., :2, :2], b.covariances, atol=1e-12)
        assert np.allclose(a.means[..., 2], BIAS)
        assert not a.covariances[..., 2, 2].any()
    assert np.allclose(long.log_likelihood, short.log_likelihood)


RULES = {
    "equal": network.covariance_intersection,
    **{
        rule: partial(network.covariance_intersection, rule=rule)
        for rule in ("trace", "determinant", "min_trace", "min_determinant")
    },
    "naive": partial(network.naive_fusion, rounds=2),
    "average": network.arithmetic_average,
    "pull": partial(network.consensus_pull, gain=0.1),
}


@pytest.mark.parametrize("name", RULES)
def test_rules_of_fusion_know_a_constant(name: str) -> None:
    rng = np.random.default_rng(0)
    roots = rng.standard_normal((4, 2, 2))
    covs = roots @ roots.mT + 0.1 * np.eye(2)
    means = rng.standard_normal((4, 2))
    long_covs = np.zeros((4, 3, 3))
    # The constant is the middle component.
    long_covs[np.ix_(range(4), [0, 2], [0, 2])] = covs
    long_means = np.insert(means, 1, BIAS, axis=1)
    rule = RULES[name]
    fused_means, fused_covs = rule((long_means, long_covs), Channel(graphs.ring(4)))
    short_means, short_covs = rule((means, covs), Channel(graphs.ring(4)))
    # The other components are fused as if the constant were not there.
    assert np.allclose(fused_means[:, [0, 2]], short_means, atol=1e-12)
    block = np.ix_(range(4), [0, 2], [0, 2])
    assert np.allclose(fused_covs[block], short_covs, atol=1e-12)
    assert (fused_means[:, 1] == BIAS).all()
    assert not fused_covs[:, 1].any()


@pytest.mark.parametrize("name", [name for name in RULES if name != "pull"])
def test_constants_that_agents_know_differently_are_refused(name: str) -> None:
    covs = np.array([np.diag([1.0, 0.0])] * 2)
    means = np.array([[0.0, 1.0], [0.0, 2.0]])
    with pytest.raises(ValueError, match="equal means where no agent has a variance"):
        RULES[name]((means, covs), Channel(graphs.path(2)))
    # One agent knows it, the other does not.
    mixed = np.array([np.diag([1.0, 0.0]), np.eye(2)])
    with pytest.raises(ValueError, match="must be a positive definite matrix"):
        RULES[name]((0 * means, mixed), Channel(graphs.path(2)))


@pytest.mark.parametrize("linearization", ["extended", "unscented"])
def test_networks_of_filters_fuse_beside_a_constant(linearization: Any) -> None:
    move = LinearModel.from_transition(
        2, lambda dt: np.eye(2), lambda t, dt: np.diag([0.1, 0.0])
    )
    short = LinearModel.from_transition(
        1, lambda dt: np.eye(1), lambda t, dt: np.array([[0.1]])
    )
    options = {
        "fusion": network.covariance_intersection,
        "share_observations": False,
        "linearization": linearization,
        "lag": 1,
    }
    eyes = [component([0], std=0.5), component([0], std=0.8)]
    f = filters.GaussianFilter(move, eyes, graphs.path(2), **options)
    g = filters.GaussianFilter(short, eyes, graphs.path(2), **options)
    seen = [[[1.0], [0.5]], [[0.2], [0.1]]]
    start = f.start(([0.0, 3.0], np.diag([1.0, 0.0])))
    mean = f.run(start, [1.0, 2.0], seen)["mean"].values
    start = g.start(([0.0], [[1.0]]))
    # The filter of the first component alone
    expected = g.run(start, [1.0, 2.0], seen)["mean"].values
    assert np.allclose(mean[..., :1], expected, atol=1e-12)
    assert np.allclose(mean[..., 1], 3.0)


@pytest.mark.parametrize(
    "make",
    [
        filters.MixtureFilter,
        partial(filters.InformationIncrementFilter, graph=graphs.complete(1)),
    ],
)
def test_mixtures_refuse_it_by_name(make: Any) -> None:
    f = make(LONG, [BIASED], target_dim=2)
    with pytest.raises(ValueError, match="variance 0 of component 2: give a known"):
        f.start(WITH_BIAS)


@pytest.mark.parametrize("scale", [None, [2.0, 3.0, 0.1]])
@pytest.mark.parametrize("rule", ["equal", "min_determinant"])
def test_ensembles_are_intersected_beside_a_constant(rule: Any, scale: Any) -> None:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((2, 4, 9, 2)) + rng.standard_normal((2, 4, 1, 2))
    # A constant of 0.1 between the two components, in all members of all agents
    long = np.insert(x, 1, 0.1, axis=-1)
    options: dict[str, Any] = {"rule": rule, "rounds": 2}
    short_scale = None if scale is None else [scale[0], scale[2]]
    channel = Channel(graphs.ring(4), runs=(2,))
    short = Channel(graphs.ring(4), runs=(2,))
    a = network.intersect_ensembles(long, channel, scale=scale, **options)
    b = network.intersect_ensembles(x, short, scale=short_scale, **options)
    assert np.allclose(a[..., [0, 2]], b, atol=1e-12)
    assert np.allclose(a[..., 1], 0.1, rtol=1e-15)
    # The constant is not sent.
    assert (channel.ledger.scalars == short.ledger.scalars).all()
    # Agents that know it differently, and an ensemble that is constant at one agent alone
    long[:, 1, :, 1] = 0.2
    with pytest.raises(ValueError, match="equal means where no agent has a variance"):
        network.intersect_ensembles(long, channel)
    long[:, 1:, :, 1] = x[:, 1:, :, 0] ** 2
    with pytest.raises(ValueError, match="ensembles must be a positive definite"):
        network.intersect_ensembles(long, channel)


@pytest.mark.parametrize("turns", [0, 1])
def test_a_constant_heading_is_known_in_every_turn(turns: int) -> None:
    """Agents may write one heading with different numbers of turns; others contradict."""
    period = 2 * np.pi
    heading = 3.0 + np.array([0.0, turns]) * period
    covs = np.array([np.diag([1.0, 0.0]), np.diag([4.0, 0.0])])
    means = np.stack([np.array([0.0, 6.0]), heading], axis=-1)
    channel = Channel(graphs.path(2))
    channel.periods = (None, period)
    moved, _covs = network.diffuse_means((means, covs), channel)
    # Metropolis weights of two agents are equal.
    assert np.allclose(moved[:, 0], 3.0)
    turned = np.exp(1j * moved[:, 1])
    assert np.allclose(turned, np.exp(3j), atol=1e-12)
    means[1, 1] += 0.5
    with pytest.raises(ValueError, match="equal means where no agent has a variance"):
        network.diffuse_means((means, covs), channel)


def test_small_ensembles_are_refused_by_their_size() -> None:
    """N - 1 anomalies span a space of N - 1 components; a constant needs none."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((2, 3, 3))
    channel = Channel(graphs.path(2))
    with pytest.raises(ValueError, match="got 3 members of 3 components"):
        network.intersect_ensembles(x, channel)
    with pytest.raises(ValueError, match="got 1 members of"):
        network.intersect_ensembles(x[:, :1], channel)
    x[..., 2] = 0.7
    fused = network.intersect_ensembles(x, channel)
    assert np.allclose(fused[..., 2], 0.7)
    plain = network.intersect_ensembles(x[..., :2], channel)
    assert np.allclose(fused[..., :2], plain)


def test_networks_of_exact_ensembles_know_a_constant() -> None:
    make = partial(filters.EnsembleFilter.exact, graph=graphs.path(2), members=40)
    f = make(LONG_WALK, [LINEAR_BIASED] * 2)
    state = f.start(WITH_BIAS, rng=np.random.default_rng(0))
    run = f.run(state, TIMES, [SEEN + BIAS] * 2)
    # The Gaussian filter by the same rule has the same covariances, whatever the means are.
    fusion = partial(network.covariance_intersection, rule="min_determinant")
    g = filters.GaussianFilter(
        LONG_WALK, [LINEAR_BIASED] * 2, graphs.path(2), fusion=fusion
    )
    # It starts with the sample moments of the members.
    sample_cov = np.cov(state.ensembles[0].T)
    prior = [(e.mean(axis=0), np.cov(e.T)) for e in state.ensembles]
    assert np.allclose(sample_cov[2], 0.0, atol=1e-28)
    start = g.start(prior)
    expected = g.run(start, TIMES, [SEEN + BIAS] * 2)
    assert np.allclose(run["mean"].values, expected["mean"].values, atol=1e-8)
    assert np.allclose(run["variance"].values, expected["variance"].values, atol=1e-8)


MAPS: dict[str, Any] = {
    "affine": transport_map_update,
    "separable": partial(transport_map_update, fit=partial(separable.fit, order=1)),
}


@pytest.mark.parametrize("units", [1.0, 1e-9, 1e9])
@pytest.mark.parametrize("name", MAPS)
def test_maps_leave_constants_and_move_what_is_determined(
    name: str, units: float
) -> None:
    """Beside x: 7, and 3 x - 1, which stay 7 and 3 x' - 1. Alone x moves as before."""
    rng = np.random.default_rng(1)
    x = rng.standard_normal((300, 2))
    first = x[:, 0]
    seven = np.full(300, 7.0)
    determined = units * (3 * first - 1)
    long = np.c_[seven, first, determined, x[:, 1]]
    update = partial(MAPS[name], predicted=x[:, :1], observed=[1.0], noise=[[0.5]])
    short = update(ensemble=x, rng=np.random.default_rng(2))
    moved = update(ensemble=long, rng=np.random.default_rng(2))
    assert (moved[:, 0] == 7.0).all()
    assert np.allclose(moved[:, [1, 3]], short, atol=1e-9)
    expected = 3 * short[:, 0] - 1
    assert np.allclose(moved[:, 2] / units, expected, atol=1e-8)
    # In a stack too
    both = np.stack([long, long[::-1]])
    update = partial(MAPS[name], observed=[1.0], noise=[[0.5]])
    stack = update(both, both[..., 1:2], rng=np.random.default_rng(2))
    assert (stack[..., 0] == 7.0).all()


@pytest.mark.parametrize("name", MAPS)
@pytest.mark.parametrize("lag", [0, 2])
def test_ensembles_with_maps_know_a_constant(name: str, lag: int) -> None:
    """At rest and with a lag, earlier states are copies of the present one."""
    rest = LinearModel.from_transition(
        3, lambda dt: np.eye(3), lambda t, dt: np.zeros((3, 3))
    )
    f = filters.EnsembleFilter(
        rest, [LINEAR_BIASED], update=MAPS[name], members=4000, lag=lag
    )
    state = f.start(WITH_BIAS, rng=np.random.default_rng(0))
    state = f.step(state, 1.0, [None])
    state = f.step(state, 2.0, [[1.5]])
    summary = f.summarize(state)
    # As the Kalman filter without the bias: S = 1 + .4, of an observation of 1
    assert np.allclose(summary.mean[0], [1.0, -0.5, BIAS], atol=0.05)
    assert np.isclose(summary.variance[0, 0], 1 - 1 / 1.4, atol=0.03)
    assert summary.variance[0, 2] < 1e-20


def test_a_map_without_anything_to_move() -> None:
    y = np.random.default_rng(0).standard_normal((9, 1))
    after = transport_map_update(
        np.ones((9, 2)), y, [0.0], [[1.0]], rng=np.random.default_rng(1)
    )
    assert (after == 1.0).all()
