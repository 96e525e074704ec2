"""Information increments: against one Kalman filter of all observations; nothing counts twice."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.linalg import block_diag
from scipy.stats import norm

from distfilt.filters import (
    GaussianFilter,
    InformationIncrementFilter,
    MixtureFilter,
    information_increment,
)
from distfilt.kalman import kalman_filter
from distfilt.mixtures import GaussianMixture
from distfilt.models import Model
from distfilt.network import Faults, graphs
from distfilt.sensors import Sensor, component, stack

T = np.array([[1.0, 0.3], [0.0, 1.0]])
E = np.array([[0.9]])
MOVE = block_diag(T, E)
NOISE = np.diag([0.0, 0.0, 0.2])
MODEL = Model(3, lambda x, t, dt: x @ MOVE.T, lambda t, dt: NOISE)
# How far the target is from the agent, and a reading of the target's speed that all receive.
SEEN = Sensor(1, lambda x: x[..., :1] - x[..., 2:], np.array([[0.3]]))
EYE = stack([SEEN, component([1], std=0.5)])
TARGET_COV = np.array([[2.0, 0.4], [0.4, 1.0]])
EGO_COV = 0.7
PRIOR = GaussianMixture.gaussian([1.0, -0.5, 0.2], block_diag(TARGET_COV, EGO_COV))


def network(agents: int, **options: object) -> InformationIncrementFilter:
    full = {"target_dim": 2, "shared_components": [1], **options}
    return InformationIncrementFilter(
        MODEL, [EYE] * agents, graphs.complete(agents), **full
    )


def joint(agents: int, readings: np.ndarray, speed: np.ndarray) -> tuple:
    """The Kalman filter of [target; all egos] with all readings, (steps, agents) and (steps,)."""
    d = 2 + agents
    m = np.concatenate([PRIOR.means[0, :2], np.full(agents, PRIOR.means[0, 2])])
    p = block_diag(TARGET_COV, *[EGO_COV] * agents)
    f = block_diag(T, *[E] * agents)
    h = np.zeros((agents + 1, d))
    h[:agents, 0] = 1.0
    h[agents, 1] = 1.0
    h[:agents, 2:] = -np.eye(agents)
    r = np.diag(np.concatenate([np.full(agents, 0.3), [0.25]]))
    q = np.diag(np.concatenate([np.zeros(2), np.full(agents, 0.2)]))
    seen = np.column_stack([readings, speed])
    exact = kalman_filter(m, p, seen, F=f, Q=q, H=h, R=r)
    return exact.means[-1], exact.covariances[-1]


@pytest.mark.parametrize(
    ("agents", "exchange_interval"), [(2, None), (3, 2.0), (5, None)]
)
def test_news_are_one_filter_with_everybodys_readings(
    agents: int, exchange_interval: float | None
) -> None:
    rng = default_rng(agents)
    readings = rng.standard_normal((4, agents))
    readings[1, 0] = np.nan
    speed = np.array([0.1, 0.3, np.nan, -0.2])
    f = network(agents, exchange_interval=exchange_interval)
    state = f.start([PRIOR] * agents)
    for k, (y, v) in enumerate(zip(readings, speed, strict=True)):
        state = f.step(state, k + 1.0, [[one, v] for one in y])
    m, p = joint(agents, readings, speed)
    for a, belief in enumerate(state.mixtures):
        ego = [0, 1, 2 + a]
        assert np.allclose(belief.means[0], m[ego], rtol=0, atol=1e-10)
        # Egos have noise of their own, so an agent's target and its ego miss nothing else.
        assert np.allclose(belief.covs[0], p[np.ix_(ego, ego)], rtol=0, atol=1e-10)


def test_what_all_receive_counts_twice_if_it_is_told() -> None:
    readings = np.full((1, 2), np.nan)
    speed = np.array([0.4])
    _, p = joint(2, readings, speed)
    start = network(2).start([PRIOR] * 2)
    once, twice = (
        network(2, shared_components=c).step(start, 1.0, [[np.nan, 0.4]] * 2)
        for c in ([1], [])
    )
    assert np.allclose(once.mixtures[0].covs[0, :2, :2], p[:2, :2], atol=1e-10)
    assert once.ledger.scalars.sum() == 0
    sent = np.linalg.inv(twice.mixtures[0].covs[0, :2, :2])
    single = np.linalg.inv(T @ TARGET_COV @ T.T)
    assert np.allclose(
        sent - single, 2 * (np.linalg.inv(p[:2, :2]) - single), atol=1e-9
    )


@pytest.mark.parametrize("rank", range(1, 5))
def test_an_increment_is_the_readings_that_taught_it(rank: int) -> None:
    rng = default_rng(rank)
    root = rng.standard_normal((4, 4))
    before = GaussianMixture.gaussian(rng.standard_normal(4), root @ root.T)
    h = rng.standard_normal((rank, 4))
    z = rng.standard_normal(rank)
    p = before.covs[0]
    gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + np.eye(rank))
    moved = before.means[0] + gain @ (z - h @ before.means[0])
    after = GaussianMixture.gaussian(moved, p - gain @ h @ p)
    news = information_increment(before, after)
    assert news.shape == (rank, 5)
    assert np.allclose(news[:, :-1].T @ news[:, :-1], h.T @ h, atol=1e-9)
    assert np.allclose(news[:, :-1].T @ news[:, -1], h.T @ z, atol=1e-9)
    assert np.array_equal(news[:, :-1], np.triu(news[:, :-1]))
    assert information_increment(before, before).shape == (0, 5)


def test_a_large_gain_does_not_hide_a_small_one() -> None:
    before = GaussianMixture.gaussian([0.0, 0.0, 0.0], np.eye(3))
    after = GaussianMixture.gaussian([2.0, -1.0, 0.0], np.diag([1e-10, 0.5, 1.0]))
    news = information_increment(before, after)
    assert news.shape == (2, 4)
    assert np.allclose(
        news[:, :-1].T @ news[:, :-1], np.diag([1e10, 1.0, 0.0]), rtol=1e-6
    )
    assert np.allclose(news[:, :-1].T @ news[:, -1], [2e10, -2.0, 0.0], rtol=1e-6)


@pytest.mark.parametrize(("rank", "numbers"), [(1, 7), (2, 13), (3, 18), (6, 27)])
def test_no_zero_is_sent(rank: int, numbers: int) -> None:
    still = Model(6, lambda x, t, dt: x, lambda t, dt: np.zeros((6, 6)))
    eye = component(range(rank), std=1.0)
    f = InformationIncrementFilter(still, [eye, None], graphs.path(2), target_dim=6)
    prior = GaussianMixture.gaussian(np.zeros(6), np.eye(6) + 0.3)
    after = f.step(f.start([prior] * 2), 1.0, [np.ones(rank), None])
    assert after.ledger.scalars.tolist() == [numbers, 0]
    assert np.allclose(after.mixtures[0].covs, after.mixtures[1].covs, atol=1e-12)
    assert np.allclose(after.mixtures[0].means, after.mixtures[1].means, atol=1e-12)


def test_news_that_are_lost_leave_the_own_belief() -> None:
    seen = [[0.7, np.nan], [-0.4, np.nan]]
    deaf = network(2, faults=Faults(loss=1.0))
    single = MixtureFilter(
        MODEL, [EYE] * 2, target_dim=2, n_components=1, max_components=1
    )
    a, b = (f.step(f.start([PRIOR] * 2), 1.0, seen) for f in (deaf, single))
    for x, y in zip(a.mixtures, b.mixtures, strict=True):
        assert np.allclose(x.covs, y.covs)
        assert np.allclose(x.means, y.means)
    assert a.ledger.lost.sum() == 2


def test_mixands_are_weighed_by_the_news() -> None:
    still = Model(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1)))
    f = InformationIncrementFilter(
        still,
        [component([0], std=1.0), None],
        graphs.path(2),
        target_dim=1,
        n_components=2,
        max_components=2,
    )
    prior = GaussianMixture([0.3, 0.7], [[-2.0], [1.0]], [[[1.0]], [[2.0]]])
    one = GaussianMixture.gaussian([0.0], [[3.0]])
    after = f.step(f.start([one, prior]), 1.0, [[0.5], None]).mixtures[1]
    # Means and variances of products of Gaussians; weights by each component's prediction.
    w = [0.3 * norm.pdf(0.5, -2, np.sqrt(2)), 0.7 * norm.pdf(0.5, 1, np.sqrt(3))]
    assert np.allclose(after.weights, np.array(w) / sum(w))
    assert np.allclose(after.means, [[-0.75], [2 / 3]])
    assert np.allclose(after.covs, [[[1 / 2]], [[2 / 3]]])


def test_a_gated_reading_is_no_news() -> None:
    f = network(2, gate_probability=0.99)
    after = f.step(f.start([PRIOR] * 2), 1.0, [[500.0, np.nan], None])
    assert after.ledger.scalars.sum() == 0
    # Of a sum that both receive only who has read the first component expects so much.
    still = Model(2, lambda x, t, dt: x, lambda t, dt: 0 * TARGET_COV)
    sums = np.tri(2)
    eye = Sensor(2, lambda x: x @ sums.T, np.diag([0.09, 0.2]))
    f = InformationIncrementFilter(
        still,
        [eye] * 2,
        graphs.path(2),
        target_dim=2,
        shared_components=[1],
        gate_probability=0.95,
    )
    start = f.start((np.zeros(2), np.eye(2)))
    y = [[1.2, 3.0]] * 2
    a, b = (
        g.step(g.step(start, 1.0, y), 2.0, [None] * 2)
        for g in (f, replace(f, exchange_interval=2.0))
    )
    assert np.allclose(a.mixtures[0].covs, b.mixtures[0].covs, atol=1e-12)
    with pytest.raises(
        ValueError, match="shared_components must have noise that is independent"
    ):
        replace(f, sensors=[eye.replace(noise_cov=TARGET_COV)] * 2).step(start, 1.0, y)


def test_everybody_hears_only_neighbours() -> None:
    f = InformationIncrementFilter(
        MODEL, [EYE] * 3, graphs.path(3), target_dim=2, shared_components=[1]
    )
    step = partial(f.step, f.start([PRIOR] * 3), 1.0)
    a, b = (step([[0.1, np.nan], None, [y, np.nan]]) for y in (0.2, 9.0))
    assert np.array_equal(a.mixtures[0].means, b.mixtures[0].means)
    assert not np.array_equal(a.mixtures[1].means, b.mixtures[1].means)


@pytest.mark.parametrize(
    ("q", "claimed", "least"),
    [(0.0, 0.4563, 0.4563), (0.1, 0.2965, 0.5289), (0.5, 0.191, 0.572)],
)
def test_a_target_that_moves_with_noise_needs_readings_in_place_of_news(
    q: float, claimed: float, least: float
) -> None:
    """Two agents with fixed doubtful places, ten readings each, on a line."""
    readings = default_rng(1).standard_normal((10, 2))
    ego = Model(2, lambda x, t, dt: x, lambda t, dt: np.diag([q, 0.0]))
    single = Sensor(1, lambda x: x[..., :1] - x[..., 1:], np.array([[0.3]]))
    prior = GaussianMixture.gaussian([0.0, 0.0], np.diag([4.0, 1.0]))
    news = InformationIncrementFilter(ego, [single] * 2, graphs.path(2), target_dim=1)
    all_ = Model(3, lambda x, t, dt: x, lambda t, dt: np.diag([q, 0.0, 0.0]))
    eyes = [
        Sensor(1, lambda x, a=a: x[..., :1] - x[..., a : a + 1], [[0.3]])
        for a in (1, 2)
    ]
    shared = GaussianFilter(all_, eyes, graphs.path(2))
    one = news.start([prior] * 2)
    joint = shared.start((np.zeros(3), np.diag([4.0, 1.0, 1.0])))
    for k, y in enumerate(readings):
        one = news.step(one, k + 1.0, y[:, None])
        joint = shared.step(joint, k + 1.0, y[:, None])
    h = np.array([[1.0, -1.0, 0.0], [1.0, 0.0, -1.0]])
    exact = kalman_filter(
        np.zeros(3),
        np.diag([4.0, 1.0, 1.0]),
        readings,
        F=np.eye(3),
        H=h,
        Q=np.diag([q, 0.0, 0.0]),
        R=0.3 * np.eye(2),
    )
    assert np.allclose(joint.means, exact.means[-1])
    assert joint.ledger.scalars.sum() == 20
    assert np.allclose(joint.covariances, exact.covariances[-1])
    variances = one.mixtures[0].covs[0, 0, 0], joint.covariances[0, 0, 0]
    assert np.allclose(variances, (claimed, least), atol=1e-3)
    gap = one.mixtures[0].means[0, 0] - joint.means[0, 0]
    assert (abs(gap) < 1e-9) == (q == 0.0)
