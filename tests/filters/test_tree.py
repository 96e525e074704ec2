"""Channel filters on a tree: all information reaches an agent, and none twice."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.random import default_rng

from distfilt.filters import ChannelFilter, FilterError, GaussianFilter
from distfilt.kalman import kalman_filter
from distfilt.models import LinearModel
from distfilt.network import Faults, Graph, graphs, naive_fusion
from distfilt.sensors import Sensor, bearing, component
from tests.filters.families import PRIOR, PRIOR_MEAN, still_model

TREES = {
    "path": graphs.path(5),
    "star": graphs.star(5),
    "fork": Graph.from_edges(5, [(0, 1), (1, 2), (1, 3), (3, 4)]),
}
each_tree = pytest.mark.parametrize("tree", TREES.values(), ids=TREES.keys())
TIMES = np.cumsum([0.1, 0.3, 0.2, 0.4, 0.1])


def rotation(noise: float = 0.0) -> LinearModel:
    """A turning state, without process noise by default."""

    def transition(dt: float) -> np.ndarray:
        c = np.cos(dt)
        s = np.sin(dt)
        return np.array([[c, s], [-s, c]])

    return LinearModel.from_transition(2, transition, lambda t, dt: noise * np.eye(2))


def sensors(agents: int = 5) -> list[Any]:
    kinds = [component([0], std=0.6), Sensor(2, lambda x: x, np.eye(2), linear=np.eye)]
    return [kinds[k % 2] for k in range(agents)]


def observations(runs: tuple[int, ...] = ()) -> list[np.ndarray]:
    rng = default_rng(5)
    return [rng.standard_normal((TIMES.size, *runs, s.dim)) for s in sensors()]


def run(f: Any, seen: list[np.ndarray], quiet: int, runs: tuple[int, ...] = ()) -> Any:
    """Return the last state after steps with observations, then some without."""
    state = f.start(PRIOR, runs=runs)
    for k, t in enumerate(TIMES):
        state = f.step(state, float(t), [y[k] for y in seen])
    # Steps in which nothing is observed, but beliefs are exchanged.
    for k in range(quiet):
        state = f.step(state, float(TIMES[-1]) + 0.1 * (k + 1), [None] * 5)
    return state


def central(seen: list[np.ndarray], quiet: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the Kalman filter of all observations, at the end of the quiet steps."""
    steps = [*np.diff(TIMES, prepend=0.0), *[0.1] * quiet]
    model = rotation()
    # One sensor with all components stands for the network.
    h = np.concatenate([s.H(2) for s in sensors()])
    noise = np.zeros((len(h), len(h)))
    start = 0
    for s in sensors():
        stop = start + s.dim
        noise[start:stop, start:stop] = s.noise_cov
        start = stop
    y = np.concatenate(seen, axis=-1)
    # In the quiet steps all components are missing.
    nothing = np.full((quiet, *y.shape[1:]), np.nan)
    y = np.concatenate([y, nothing])
    result = kalman_filter(
        *PRIOR,
        y,
        F=np.array([model.F(dt) for dt in steps]),
        H=h,
        R=noise,
        Q=np.zeros((2, 2)),
    )
    return result.means[-1], result.covariances[-1]


@each_tree
def test_all_agents_become_the_central_filter(tree: Graph) -> None:
    """After as many quiet steps as the diameter, to rounding."""
    seen = observations()
    mean, cov = central(seen, tree.diameter)
    f = ChannelFilter(rotation(), sensors(), tree)
    state = run(f, seen, tree.diameter)
    assert np.allclose(state.means, mean, rtol=0, atol=1e-12)
    assert np.allclose(state.covariances, cov, rtol=0, atol=1e-12)
    # Both ends of a link know the same.
    assert np.allclose(state.link_means, mean, atol=1e-12)
    # Control: beliefs that are multiplied count observations again and again.
    naive = GaussianFilter(
        rotation(), sensors(), tree, share_observations=False, fusion=naive_fusion
    )
    wrong = run(naive, seen, tree.diameter)
    wrong_traces = np.trace(wrong.covariances, axis1=1, axis2=2)
    assert (wrong_traces < 0.5 * np.trace(cov)).all()


def test_links_are_inflated_as_the_agents_are() -> None:
    """All information of a state at rest is divided by the same number: that of the links too."""
    tree = graphs.path(2)
    team = [component([0], std=0.6), component([0], std=1.0)]
    f = ChannelFilter(still_model(1), team, tree, inflation=1.2)
    g = GaussianFilter(still_model(1), team, tree, inflation=1.2)
    prior = ([0.0], [[1.0]])
    a = f.start(prior)
    b = g.start(prior)
    for t in (1.0, 2.0, 3.0):
        a = f.step(a, t, [[t], [-t]])
        b = g.step(b, t, [[t], [-t]])
        # Neighbours have all information at once, as if they sent each other observations.
        assert np.allclose(a.means, b.means, rtol=1e-12)
        assert np.allclose(a.covariances, b.covariances, rtol=1e-12)


@each_tree
def test_information_travels_one_link_a_step(tree: Graph) -> None:
    """One observation each; after k steps an agent has those of k links away."""
    f = ChannelFilter(still_model(1), [component([0], std=1.0)] * 5, tree)
    start = f.start(([0.0], [[1.0]]))
    state = f.step(start, 1.0, [[1.0]] * 5)
    for k in range(1, 5):
        # 1 / P = 1 + number of observations
        count = 1 / state.covariances.ravel() - 1
        expected = [(tree.hops(agent) <= k).sum() for agent in range(5)]
        assert np.allclose(count, expected)
        state = f.step(state, 1.0 + k, [None] * 5)


def test_lost_messages_come_later() -> None:
    """Nothing is counted twice, and nothing is missing in the end."""
    tree = TREES["fork"]
    seen = observations((7,))
    faults = Faults(loss=0.4, seed=3)
    # Forty steps are enough for every link to be repaired.
    f = ChannelFilter(rotation(), sensors(), tree, faults=faults)
    state = run(f, seen, 40, (7,))
    mean, cov = central(seen, 40)
    assert state.ledger.lost.sum() > 0
    assert np.allclose(state.means, mean[:, None], atol=1e-10)
    assert np.allclose(state.covariances, cov, atol=1e-10)


def test_each_run_of_a_batch_is_that_run_alone() -> None:
    seen = observations((3,))
    f = ChannelFilter(rotation(0.1), sensors(), TREES["fork"])
    batch = run(f, seen, 2, (3,))
    for k in range(3):
        alone = run(f, [y[:, k] for y in seen], 2)
        assert np.allclose(batch.means[k], alone.means, atol=1e-12)
        assert np.allclose(batch.link_covariances[k], alone.link_covariances)


def test_a_failed_run_leaves_the_others_alone() -> None:
    seen = observations((3,))
    f = ChannelFilter(rotation(), sensors(), TREES["path"], on_error="keep")
    bad = [y.copy() for y in seen]
    bad[0][1, 1] = 1e308
    bad[2][1, 1] = -1e308
    # Two huge numbers of opposite sign overflow in the fusion.
    with np.errstate(all="ignore"):
        state = run(f, bad, 1, (3,))
    good = run(f, seen, 1, (3,))
    assert state.failed.tolist() == [False, True, False]
    assert np.allclose(state.means[[0, 2]], good.means[[0, 2]])


def test_a_saved_state_goes_on(tmp_path: Any) -> None:
    f = ChannelFilter(rotation(), sensors(), TREES["star"])
    state = run(f, observations(), 0)
    state.save(tmp_path / "state.npz")
    loaded = f.state_class.load(tmp_path / "state.npz")
    after = [f.step(s, 2.0, [None] * 5) for s in (state, loaded)]
    assert (after[0].means == after[1].means).all()
    assert (after[0].link_means == after[1].link_means).all()


def test_a_reset_is_common_knowledge() -> None:
    """Links forget as the agents do: all observations afterwards count once."""
    f = ChannelFilter(still_model(2), sensors(), TREES["path"])
    state = run(f, observations(), 4)
    state = f.reset(state, [1], [0.0], [[1.0]])
    # All agents have the same belief here, and so do the links.
    assert np.allclose(state.link_covariances, state.covariances[0])
    assert np.allclose(state.link_means, state.means[0])
    with pytest.raises(ValueError, match="^agents must be all of them"):
        f.reset(state, [1], [0.0], [[1.0]], agents=[0])
    # P⁺⁻¹ = P⁻¹ + Σ Hᵀ R⁻¹ H and P⁺⁻¹ m⁺ = P⁻¹ m + Σ Hᵀ R⁻¹ y, over all agents
    matrix = np.linalg.inv(state.covariances[0])
    vector = matrix @ state.means[0]
    seen = [y[0] for y in observations()]
    for sensor, y in zip(sensors(), seen, strict=True):
        weighted = sensor.H(2).T @ np.linalg.inv(sensor.noise_cov)
        matrix = matrix + weighted @ sensor.H(2)
        vector = vector + weighted @ y
    for k, entries in enumerate([seen, *[[None] * 5] * 4]):
        state = f.step(state, 3.0 + k, entries)
    mean = np.linalg.solve(matrix, vector)
    cov = np.linalg.inv(matrix)
    assert np.allclose(state.means, mean, atol=1e-10)
    assert np.allclose(state.covariances, cov, atol=1e-10)


@pytest.mark.parametrize(
    ("graph", "text"),
    [
        (graphs.ring(5), "graph without circles, got 5 links between 5 agents"),
        (Graph.from_edges(5, [(0, 1)], directed=True), "links both ways"),
    ],
)
def test_other_graphs_are_refused(graph: Graph, text: str) -> None:
    # The graph is looked at when messages are sent.
    f = ChannelFilter(rotation(), sensors(), graph)
    with pytest.raises(ValueError, match=text):
        f.step(f.start(PRIOR), 1.0, [None] * 5)
    for moving in (None, lambda t: graph):
        with pytest.raises(ValueError, match="^graph must be a Graph that does not"):
            ChannelFilter(rotation(), sensors(), moving)


def test_priors_that_links_cannot_begin_with_are_refused() -> None:
    f = ChannelFilter(rotation(), sensors(), TREES["path"])
    with pytest.raises(ValueError, match="^prior must be one for all agents"):
        f.start([PRIOR] * 4 + [(PRIOR_MEAN + 1, np.eye(2))])
    with pytest.raises((ValueError, FilterError), match="positive definite"):
        f.start((PRIOR_MEAN, np.diag([1.0, 0.0])))


def test_a_nonlinear_sensor_with_angles() -> None:
    """Two agents with bearings: the links linearise as their agents do."""
    sensor = bearing([0, 1], std=0.1)
    f = ChannelFilter(still_model(2), [sensor] * 2, graphs.path(2))
    state = f.start(([-3.0, 0.1], 0.1 * np.eye(2)))
    # Directions on both sides of the cut
    for k in range(3):
        state = f.step(state, 1.0 + k, [[3.1], [-3.1]])
    assert np.allclose(state.means[0], state.means[1], atol=1e-2)
    assert (np.linalg.eigvalsh(state.covariances) > 0).all()
