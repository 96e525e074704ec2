"""A component that is first seen later, and a reset, each in one call on a state.

| Project | Report | Here |
|---|---|---|
| own | a landmark begins where it is first seen | joint covariance by hand |
| own | a bias is unknown after a restart | the others as they were |
| own | one agent of a network restarts | the others as they were |

Moments of a linear function of a Gaussian are written out.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import filters
from distfilt.models import Model
from distfilt.network import graphs
from distfilt.sensors import component, distance

STILL = Model(
    3,
    lambda x, t, dt: x,
    lambda t, dt: 0.1 * dt * np.diag([1.0, 1.0, 0.0]),
    names=("robot", "speed", "landmark"),
)
PRIOR = (
    np.array([3.0, 1.0, 0.0]),
    np.array([[4.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 1e4]]),
)
EYES = [component([0], std=1.0)] * 2
FAMILIES = {
    "gaussian": filters.GaussianFilter,
    "unscented": partial(filters.GaussianFilter, linearization="unscented"),
    "ensemble": partial(filters.EnsembleFilter, members=100_000),
    "particle": partial(filters.ParticleFilter, members=100_000),
    "transport": partial(filters.TransportFilter, members=20_000),
}


def ahead(x: np.ndarray) -> np.ndarray:
    return x[..., :1] + 2.0 * x[..., 1:2] + 5.0


def moments(f: Any, state: Any, agent: int) -> tuple[np.ndarray, np.ndarray]:
    if hasattr(state, "means"):
        return state.means[agent], state.covariances[agent]
    x = state.belief[agent]
    return x.mean(axis=0), np.cov(x.T)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_landmark_begins_where_it_is_seen(family: str) -> None:
    """l = r + 2 v + 5 + e: Cov(r, l) = P_rr + 2 P_rv, and Var l = P_rr + 4 P_rv + 4 P_vv + R."""
    f = FAMILIES[family](STILL, EYES, graphs.path(2))
    start = f.start(PRIOR, rng=np.random.default_rng(0))
    state = f.reset(start, ["landmark"], ahead, [[0.25]])
    # 4 + 2 · 0.5 = 5, 0.5 + 2 · 1 = 2.5, and 4 + 4 · 0.5 + 4 · 1 + 0.25 = 10.25
    expected = np.array([[4.0, 0.5, 5.0], [0.5, 1.0, 2.5], [5.0, 2.5, 10.25]])
    close = 1e-8 if hasattr(state, "means") else 0.15
    for agent in range(2):
        mean, cov = moments(f, state, agent)
        assert np.allclose(mean, [3.0, 1.0, 10.0], atol=close)
        assert np.allclose(cov, expected, atol=close, rtol=close / 5)
    # The state before is as it was, and further draws are others.
    before, _ = moments(f, start, 0)
    assert abs(before[2]) < 2.0
    if family == "transport":
        assert (state.belief[0] == state.belief[1]).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_a_reset_leaves_the_other_components(family: str) -> None:
    f = FAMILIES[family](STILL, EYES, graphs.path(2))
    start = f.start(PRIOR, rng=np.random.default_rng(0))
    # A value that depends on the state, and then two that do not
    state = f.reset(start, [2], ahead, [[0.25]])
    state = f.reset(state, [2, 1], [7.0, -1.0], np.eye(2))
    mean, cov = moments(f, state, 1)
    close = 1e-9 if hasattr(state, "means") else 0.1
    assert np.allclose(mean, [3.0, -1.0, 7.0], atol=close)
    assert np.allclose(cov, np.diag([4.0, 1.0, 1.0]), atol=close)
    # Members keep their first component, to the bit.
    if family not in ("gaussian", "unscented"):
        assert (state.belief[..., 0] == start.belief[..., 0]).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_value_and_covariance_are_in_the_order_of_the_components(family: str) -> None:
    """Var(landmark) = 4, Var(speed) = 1 and their covariance 1.8, in whatever order they come."""
    f = FAMILIES[family](STILL, EYES, graphs.path(2))
    start = f.start(PRIOR, rng=np.random.default_rng(0))
    cov = np.array([[4.0, 1.8], [1.8, 1.0]])
    state = f.reset(start, ["landmark", "speed"], [7.0, -1.0], cov)
    mean, after = moments(f, state, 0)
    expected = np.array([[4.0, 0.0, 0.0], [0.0, 1.0, 1.8], [0.0, 1.8, 4.0]])
    close = 1e-9 if hasattr(state, "means") else 0.1
    assert np.allclose(mean, [3.0, -1.0, 7.0], atol=close)
    assert np.allclose(after, expected, atol=close)


@pytest.mark.parametrize("family", [name for name in FAMILIES if name != "transport"])
def test_one_agent_restarts_alone(family: str) -> None:
    f = FAMILIES[family](STILL, EYES, graphs.path(2))
    start = f.start(PRIOR, rng=np.random.default_rng(0), runs=(2,))
    state = f.reset(start, ["speed"], [9.0], [[0.0]], agents=[1])
    assert (state.belief[:, 0] == start.belief[:, 0]).all()
    mean = f.summarize(state).mean
    # By run, agent and component: the speed of agent 1, in both runs
    assert np.allclose(mean[:, 1, 1], 9.0)
    assert (mean[:, 0, 1] < 2.0).all()


def test_a_filter_goes_on_from_it() -> None:
    """The landmark that a robot begins helps the robot, as in a state that always had it."""
    sensors = [[component([0], std=1.0), distance([2], std=0.1)]]
    f = filters.GaussianFilter(STILL, sensors, lag=2)
    start = f.start(PRIOR)
    state = f.step(start, 1.0, [[filters.Observation(1.0, 0, [3.2])]])
    begun = f.reset(state, ["landmark"], ahead, [[0.25]])
    after = f.step(begun, 2.0, [[filters.Observation(2.0, 0, [11.0], 1)]])
    # To see the landmark says where the robot is, as they are correlated.
    variance_before = state.covariances[0, 0, 0]
    variance_after = after.covariances[0, 0, 0]
    assert variance_after < variance_before
    # The past has its former landmark, with which the robot is not correlated: of the joint
    # state the present robot is component 0, and the past landmark is component 3 + 2.
    cross_covariance = begun.joint_covariances[0, 0, 5]
    assert abs(cross_covariance) < 1e-9
    assert begun.times == state.times


def test_what_cannot_be_reset_is_refused_by_name() -> None:
    f = filters.GaussianFilter(STILL, EYES, graphs.path(2))
    start = f.start(PRIOR)
    with pytest.raises(ValueError, match="components must be names .* got 'bias'"):
        f.reset(start, ["bias"], [0.0], [[1.0]])
    with pytest.raises(ValueError, match="cov must be"):
        f.reset(start, [2], [0.0], [[-1.0]])
    with pytest.raises(ValueError, match="value must"):
        f.reset(start, [2], [0.0, 1.0], [[1.0]])
    with pytest.raises(ValueError, match="value must"):
        f.reset(start, [2], lambda x: x, [[1.0]])
    with pytest.raises(ValueError, match="agents below 2"):
        f.reset(start, [2], [0.0], [[1.0]], agents=[2])
    g = filters.TransportFilter(STILL, EYES, graphs.path(2), members=9)
    common = g.start(PRIOR, rng=np.random.default_rng(0))
    with pytest.raises(ValueError, match="agents must be all of a TransportFilter"):
        g.reset(common, [2], [0.0], [[1.0]], agents=[0])
    h = filters.MixtureFilter(STILL, EYES, target_dim=1)
    with pytest.raises(ValueError, match="state must be Gaussians or members"):
        h.reset(h.start(PRIOR), [2], [0.0], [[1.0]])
