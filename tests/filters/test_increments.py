"""Information increments: against one Kalman filter of all observations; nothing counts twice."""

from __future__ import annotations

from dataclasses import replace

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

from .families import still_model

T = np.array([[1.0, 0.3], [0.0, 1.0]])
E = np.array([[0.9]])
MOVE = block_diag(T, E)
NOISE = np.diag([0.0, 0.0, 0.2])
MODEL = Model(3, lambda x, t, dt: x @ MOVE.T, lambda t, dt: NOISE)


def relative(x: np.ndarray) -> np.ndarray:
    """The target's first component as seen from the agent, whose place is the last one."""
    return x[..., :1] - x[..., -1:]


# How far the target is from the agent, and a measurement of its speed that all receive.
SEEN = Sensor(1, relative, [[0.3]])
EYE = stack([SEEN, component([1], std=0.5)])
TARGET_COV = np.array([[2.0, 0.4], [0.4, 1.0]])
EGO_COV = 0.7
TARGET_MEAN = [1.0, -0.5]
EGO_MEAN = 0.2
PRIOR_COV = block_diag(TARGET_COV, EGO_COV)
PRIOR = GaussianMixture.gaussian([*TARGET_MEAN, EGO_MEAN], PRIOR_COV)


def network(agents: int, **options: object) -> InformationIncrementFilter:
    full = {"target_dim": 2, "shared_components": [1], **options}
    graph = graphs.complete(agents)
    return InformationIncrementFilter(MODEL, [EYE] * agents, graph, **full)


def joint(agents: int, readings: np.ndarray, speed: np.ndarray) -> tuple:
    """The Kalman filter of [target; all egos] with all observations, (T, agents) and (T,)."""
    m = np.array(TARGET_MEAN + [EGO_MEAN] * agents)
    p = block_diag(TARGET_COV, *[EGO_COV] * agents)
    f = block_diag(T, *[E] * agents)
    # Row a: target minus ego a; the last row: the target's speed.
    h = np.zeros((agents + 1, agents + 2))
    h[:agents, 0] = 1.0
    h[agents, 1] = 1.0
    h[:agents, 2:] = -np.eye(agents)
    r = np.diag([0.3] * agents + [0.25])
    # Only the egos move with noise.
    q = np.diag([0.0, 0.0] + [0.2] * agents)
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
        seen = [[one, v] for one in y]
        state = f.step(state, k + 1.0, seen)
    m, p = joint(agents, readings, speed)
    for a, belief in enumerate(state.mixtures):
        ego = [0, 1, 2 + a]
        expected = p[np.ix_(ego, ego)]
        assert np.allclose(belief.means[0], m[ego], rtol=0, atol=1e-10)
        # Egos have noise of their own, so an agent's target and its ego miss nothing else.
        assert np.allclose(belief.covs[0], expected, rtol=0, atol=1e-10)


def test_what_all_receive_counts_twice_if_it_is_told() -> None:
    readings = np.full((1, 2), np.nan)
    speed = np.array([0.4])
    _, p = joint(2, readings, speed)
    start = network(2).start([PRIOR] * 2)
    seen = [[np.nan, 0.4]] * 2
    once = network(2, shared_components=[1]).step(start, 1.0, seen)
    twice = network(2, shared_components=[]).step(start, 1.0, seen)
    target = (slice(2), slice(2))
    exact = p[target]
    cov_once = once.mixtures[0].covs[0][target]
    cov_twice = twice.mixtures[0].covs[0][target]
    assert np.allclose(cov_once, exact, atol=1e-10)
    assert once.ledger.scalars.sum() == 0
    # The information that the measurement adds to the forecast's is doubled.
    forecast = np.linalg.inv(T @ TARGET_COV @ T.T)
    increment = np.linalg.inv(exact) - forecast
    counted = np.linalg.inv(cov_twice) - forecast
    assert np.allclose(counted, 2 * increment, atol=1e-9)


@pytest.mark.parametrize("rank", range(1, 5))
def test_an_increment_is_the_readings_that_taught_it(rank: int) -> None:
    rng = default_rng(rank)
    root = rng.standard_normal((4, 4))
    before = GaussianMixture.gaussian(rng.standard_normal(4), root @ root.T)
    h = rng.standard_normal((rank, 4))
    z = rng.standard_normal(rank)
    # A Kalman update with z = h x + noise of unit covariance
    m = before.means[0]
    p = before.covs[0]
    innovation_cov = h @ p @ h.T + np.eye(rank)
    gain = p @ h.T @ np.linalg.inv(innovation_cov)
    mean = m + gain @ (z - h @ m)
    cov = p - gain @ h @ p
    after = GaussianMixture.gaussian(mean, cov)
    increment = information_increment(before, after)
    assert increment.shape == (rank, 5)
    # Its rows [H | z] give the same HᵀH and Hᵀz, in triangular form.
    rows = increment[:, :-1]
    values = increment[:, -1]
    assert np.allclose(rows.T @ rows, h.T @ h, atol=1e-9)
    assert np.allclose(rows.T @ values, h.T @ z, atol=1e-9)
    assert np.array_equal(rows, np.triu(rows))
    # An update by nothing has no rows.
    assert information_increment(before, before).shape == (0, 5)


def test_a_large_gain_does_not_hide_a_small_one() -> None:
    before = GaussianMixture.gaussian([0.0, 0.0, 0.0], np.eye(3))
    after = GaussianMixture.gaussian([2.0, -1.0, 0.0], np.diag([1e-10, 0.5, 1.0]))
    increment = information_increment(before, after)
    # The third component learned nothing: two rows.
    assert increment.shape == (2, 4)
    rows = increment[:, :-1]
    # 1/P⁺ - 1/P is 1e10 - 1 and 2 - 1; m⁺/P⁺ - m/P is 2e10 and -2.
    information = np.diag([1e10, 1.0, 0.0])
    assert np.allclose(rows.T @ rows, information, rtol=1e-6)
    vector = rows.T @ increment[:, -1]
    assert np.allclose(vector, [2e10, -2.0, 0.0], rtol=1e-6)


@pytest.mark.parametrize(("rank", "numbers"), [(1, 7), (2, 13), (3, 18), (6, 27)])
def test_no_zero_is_sent(rank: int, numbers: int) -> None:
    # A triangle with `rank` rows of 6 + 1 numbers, without the zeros below the diagonal
    eye = component(range(rank), std=1.0)
    sensors = [eye, None]
    f = InformationIncrementFilter(
        still_model(6), sensors, graphs.path(2), target_dim=6
    )
    prior = GaussianMixture.gaussian(np.zeros(6), np.eye(6) + 0.3)
    start = f.start([prior] * 2)
    after = f.step(start, 1.0, [np.ones(rank), None])
    assert after.ledger.scalars.tolist() == [numbers, 0]
    # Both agents estimate the same target and nothing else.
    first, second = after.mixtures
    assert np.allclose(first.covs, second.covs, atol=1e-12)
    assert np.allclose(first.means, second.means, atol=1e-12)


def test_news_that_are_lost_leave_the_own_belief() -> None:
    seen = [[0.7, np.nan], [-0.4, np.nan]]
    deaf = network(2, faults=Faults(loss=1.0))
    single = MixtureFilter(
        MODEL, [EYE] * 2, target_dim=2, n_components=1, max_components=1
    )
    priors = [PRIOR] * 2
    a = deaf.step(deaf.start(priors), 1.0, seen)
    b = single.step(single.start(priors), 1.0, seen)
    for x, y in zip(a.mixtures, b.mixtures, strict=True):
        assert np.allclose(x.covs, y.covs)
        assert np.allclose(x.means, y.means)
    assert a.ledger.lost.sum() == 2


def test_mixands_are_weighed_by_the_news() -> None:
    f = InformationIncrementFilter(
        still_model(1),
        [component([0], std=1.0), None],
        graphs.path(2),
        target_dim=1,
        n_components=2,
        max_components=2,
    )
    weights = np.array([0.3, 0.7])
    means = np.array([-2.0, 1.0])
    variances = np.array([1.0, 2.0])
    prior = GaussianMixture(weights, means[:, None], variances[:, None, None])
    one = GaussianMixture.gaussian([0.0], [[3.0]])
    start = f.start([one, prior])
    after = f.step(start, 1.0, [[0.5], None]).mixtures[1]
    # Means and variances of products of Gaussians; weights by each component's prediction.
    predicted_std = np.sqrt(variances + 1)
    w = weights * norm.pdf(0.5, means, predicted_std)
    assert np.allclose(after.weights, w / w.sum())
    assert np.allclose(after.means.ravel(), [-0.75, 2 / 3])
    assert np.allclose(after.covs.ravel(), [1 / 2, 2 / 3])


def test_a_gated_reading_is_no_news() -> None:
    f = network(2, gate_probability=0.99)
    start = f.start([PRIOR] * 2)
    after = f.step(start, 1.0, [[500.0, np.nan], None])
    assert after.ledger.scalars.sum() == 0
    # The sum 3.0 passes the gate only after the update by the first component, 1.2.
    sums = np.tri(2)
    noise = np.diag([0.09, 0.2])
    eye = Sensor(2, lambda x: x @ sums.T, noise)
    f = InformationIncrementFilter(
        still_model(2),
        [eye] * 2,
        graphs.path(2),
        target_dim=2,
        shared_components=[1],
        gate_probability=0.95,
    )
    start = f.start((np.zeros(2), np.eye(2)))
    y = [[1.2, 3.0]] * 2
    nothing = [None] * 2
    # The gate decides when an observation arrives, not when it is exchanged.
    rare = replace(f, exchange_interval=2.0)
    a = f.step(f.step(start, 1.0, y), 2.0, nothing)
    b = rare.step(rare.step(start, 1.0, y), 2.0, nothing)
    assert np.allclose(a.mixtures[0].covs, b.mixtures[0].covs, atol=1e-12)
    correlated = eye.replace(noise_cov=TARGET_COV)
    refusing = replace(f, sensors=[correlated] * 2)
    message = "shared_components must have noise that is independent"
    with pytest.raises(ValueError, match=message):
        refusing.step(start, 1.0, y)


@pytest.mark.parametrize("seed", range(4))
def test_in_any_order_of_senders_all_end_with_all_observations(seed: int) -> None:
    """What waits is neither lost nor sent twice while the others' increments arrive."""
    rng = default_rng(seed)
    agents, d = 4, 2
    speakers = [int(a) for a in rng.integers(agents, size=6)]
    # In the end everybody speaks once more, when there is nothing new to see.
    speakers += list(range(agents))
    readings = rng.standard_normal((len(speakers), agents))
    readings[rng.random(readings.shape) < 0.3] = np.nan
    readings[-agents:] = np.nan

    def links(t: float) -> graphs.Graph:
        """All hear the only one that speaks in a step."""
        speaker = speakers[round(t) - 1]
        pairs = [(a, speaker) for a in range(agents) if a != speaker]
        return graphs.Graph.from_edges(agents, pairs, directed=True)

    rows = rng.standard_normal((agents, 1, d))
    sensors = [
        Sensor(1, lambda x, h=h: x @ h.T, [[0.4]], linear=lambda d, h=h: h)
        for h in rows
    ]
    f = InformationIncrementFilter(still_model(d), sensors, links, target_dim=d)
    prior = GaussianMixture.gaussian([0.5, -0.3], TARGET_COV)
    state = f.start([prior] * agents)
    for k, y in enumerate(readings, start=1):
        seen = [None if np.isnan(one) else [one] for one in y]
        state = f.step(state, float(k), seen)
    exact = kalman_filter(
        prior.mean,
        prior.cov,
        readings,
        F=np.eye(d),
        H=rows[:, 0],
        Q=np.zeros((d, d)),
        R=0.4 * np.eye(agents),
    )
    assert not any(state.unsent)
    for belief in state.mixtures:
        assert np.allclose(belief.mean, exact.means[-1], rtol=0, atol=1e-9)
        assert np.allclose(belief.cov, exact.covariances[-1], rtol=0, atol=1e-9)


def test_everybody_hears_only_neighbours() -> None:
    f = InformationIncrementFilter(
        MODEL, [EYE] * 3, graphs.path(3), target_dim=2, shared_components=[1]
    )
    start = f.start([PRIOR] * 3)
    near = [0.1, np.nan]
    a = f.step(start, 1.0, [near, None, [0.2, np.nan]]).mixtures
    b = f.step(start, 1.0, [near, None, [9.0, np.nan]]).mixtures
    # Agent 2 is no neighbour of agent 0, but one of agent 1.
    assert np.array_equal(a[0].means, b[0].means)
    assert not np.array_equal(a[1].means, b[1].means)


@pytest.mark.parametrize(
    ("q", "claimed", "least"),
    [(0.0, 0.4563, 0.4563), (0.1, 0.2965, 0.5289), (0.5, 0.191, 0.572)],
)
def test_a_target_that_moves_with_noise_needs_readings_in_place_of_news(
    q: float, claimed: float, least: float
) -> None:
    """Two agents with fixed uncertain places, ten observations each, on a line.

    The agents' places are correlated with the target's past, which an increment does not say.
    """
    readings = default_rng(1).standard_normal((10, 2))
    path = graphs.path(2)
    # Each agent estimates the target and its own place.
    ego_noise = np.diag([q, 0.0])
    ego = Model(2, lambda x, t, dt: x, lambda t, dt: ego_noise)
    prior = GaussianMixture.gaussian([0.0, 0.0], np.diag([4.0, 1.0]))
    news = InformationIncrementFilter(ego, [SEEN] * 2, path, target_dim=1)
    one = news.start([prior] * 2)
    # With flooded measurements each agent estimates the target and both places.
    mean = np.zeros(3)
    cov = np.diag([4.0, 1.0, 1.0])
    noise = np.diag([q, 0.0, 0.0])
    h = np.array([[1.0, -1.0, 0.0], [1.0, 0.0, -1.0]])
    all_ = Model(3, lambda x, t, dt: x, lambda t, dt: noise)
    eyes = []
    for row in h:
        column = row[:, None]
        eyes.append(Sensor(1, lambda x, column=column: x @ column, [[0.3]]))
    shared = GaussianFilter(all_, eyes, path)
    joint = shared.start((mean, cov))
    for k, y in enumerate(readings, start=1):
        one = news.step(one, float(k), y[:, None])
        joint = shared.step(joint, float(k), y[:, None])
    r = 0.3 * np.eye(2)
    exact = kalman_filter(mean, cov, readings, F=np.eye(3), H=h, Q=noise, R=r)
    assert np.allclose(joint.means, exact.means[-1])
    assert joint.ledger.scalars.sum() == 20
    assert np.allclose(joint.covariances, exact.covariances[-1])
    # With increments the reported variance is too small, unless the target rests.
    belief = one.mixtures[0]
    assert np.isclose(belief.covs[0, 0, 0], claimed, atol=1e-3)
    assert np.isclose(joint.covariances[0, 0, 0], least, atol=1e-3)
    difference = belief.means[0, 0] - joint.means[0, 0]
    assert (abs(difference) < 1e-9) == (q == 0.0)
