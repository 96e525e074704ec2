"""A model for each agent: robots with odometry of their own.

| Report | Situation |
|---|---|
| review L 1 | odometry of each robot, where the robots' states differ |
| HULKs/hulk pull 2359 | the noise of odometry acts in the robot's frame, not in the field's |

Right values are those of filters in plain numpy, one for each robot, of filters of one agent, and
of draws from the same generator.
"""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import numpy as np
import pytest

from distfilt import filters
from distfilt.filters import Observation
from distfilt.kalman import filterpy_ekf
from distfilt.models import (
    AgentModels,
    InputModel,
    Inputs,
    LinearModel,
    Model,
    simulate,
)
from distfilt.network import average_consensus, graphs
from distfilt.sensors import Sensor, component, distance

TURN = {2: 2 * np.pi}


def drive(x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
    heading = x[..., 2]
    return np.stack(
        [
            x[..., 0] + dt * u[..., 0] * np.cos(heading),
            x[..., 1] + dt * u[..., 0] * np.sin(heading),
            heading + dt * u[..., 1],
        ],
        axis=-1,
    )


# Logs of three robots, each with times of its own and wheels of its own.
LOGS = [
    Inputs(
        [0.0, 1.0, 2.0], [[1.0, 0.2], [2.0, -0.1], [0.5, 0.0]], np.diag([0.04, 0.01])
    ),
    Inputs([0.0, 0.7], [[0.3, -0.5], [1.5, 0.4]], np.diag([0.01, 0.09])),
    Inputs([-1.0], [[2.5, 0.1]], np.array([[0.09, 0.02], [0.02, 0.02]])),
]
ROBOTS = [InputModel.from_inputs(3, drive, log, periods=TURN) for log in LOGS]
TEAM = AgentModels.from_models(ROBOTS)


def drive_slowly(x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
    return drive(x, 0.5 * u, dt)


def make_team(delay: float, functions: list[Any]) -> list[InputModel]:
    """Return robots whose second inputs begin by a delay after each other's, with other noises."""
    team = []
    for k, (log, function) in enumerate(zip(LOGS, functions, strict=True)):
        values = np.array([[1.0, 0.2], [2.0, -0.1]]) + k
        inputs = Inputs([0.0, 1.2 + k * delay], values, log.cov)
        extra = 0.01 * k * np.diag([1.0, 2.0, 0.5])
        noise = partial(lambda extra, t, dt: dt * extra, extra)
        team.append(InputModel.from_inputs(3, function, inputs, noise, periods=TURN))
    return team


# Robots of one function whose inputs have the same times are moved at once.
LOG_KINDS = {
    "different times": ROBOTS,
    "same times": make_team(0.0, [drive] * 3),
    "times of equal number": make_team(0.1, [drive] * 3),
    "different functions": make_team(0.0, [drive, drive_slowly, drive]),
}
PRIORS = [
    (np.array([0.0, 0.0, 0.7]), np.diag([0.1, 0.1, 0.05])),
    (np.array([5.0, -1.0, 3.1]), np.diag([0.3, 0.2, 0.02])),
    (
        np.array([-2.0, 4.0, -1.5]),
        np.array([[0.2, 0.1, 0], [0.1, 0.3, 0], [0, 0, 0.1]]),
    ),
]
SENSORS = [
    distance([0, 1], std=0.1, origin=[9.0, 9.0]),
    component([0, 1], std=0.2),
    None,
]
TIMES = [0.5, 1.75, 3.0]
SEEN = [[[12.0], [11.0], [10.0]], [[4.8, -1.0], [np.nan, -1.2], [5.0, 0.0]], None]


def plain_ekf(agent: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of one robot at the end, by an extended filter in numpy."""
    m, p = PRIORS[agent]
    log = LOGS[agent]
    now = 0.0
    for k, t in enumerate(TIMES):
        # The step is cut where an input begins.
        changes = [s for s in log.times.tolist() if now < s < t]
        edges = [now, *changes, t]
        for a, b in zip(edges[:-1], edges[1:], strict=True):
            # The input that began last
            row = np.flatnonzero(log.times <= a)[-1]
            u = log.values[row]
            v = u[0]
            dt = b - a
            c = np.cos(m[2])
            s = np.sin(m[2])
            # F = ∂x'/∂x and G = ∂x'/∂u of x' = x + dt (v cos θ, v sin θ, ω) with u = (v, ω)
            f = np.array([[1, 0, -dt * v * s], [0, 1, dt * v * c], [0, 0, 1]])
            g = np.array([[dt * c, 0], [dt * s, 0], [0, dt]])
            p = f @ p @ f.T + g @ log.cov @ g.T
            m = drive(m, u, dt)
        now = t
        if agent == 0:
            # The derivative of a distance is the unit vector.
            offset = m[:2] - [9.0, 9.0]
            r = np.linalg.norm(offset)
            h = np.array([[offset[0] / r, offset[1] / r, 0.0]])
            innovation = np.array(SEEN[0][k]) - r
            noise = np.array([[0.01]])
        elif agent == 1:
            # Components that are there
            rows = np.flatnonzero(~np.isnan(SEEN[1][k]))
            h = np.eye(3)[rows]
            innovation = np.array(SEEN[1][k])[rows] - h @ m
            noise = 0.04 * np.eye(len(rows))
        else:
            continue
        # K = P Hᵀ S⁻¹ with S = H P Hᵀ + R
        innovation_cov = h @ p @ h.T + noise
        gain = np.linalg.solve(innovation_cov, h @ p).T
        m = m + gain @ innovation
        p = p - gain @ h @ p
    return m, p


def test_every_robot_is_an_extended_filter_with_its_own_odometry() -> None:
    """HULKs/hulk pull 2359: G Σ Gᵀ turns the noise of the wheels into the field's frame."""
    f = filters.GaussianFilter(TEAM, SENSORS, share_observations=False)
    run = f.run(f.start(PRIORS), TIMES, SEEN)
    for agent in range(3):
        mean, cov = plain_ekf(agent)
        error = run["mean"].values[-1, agent] - mean
        assert np.abs(error[:2]).max() < 1e-8
        # The heading, up to whole turns
        assert abs(np.angle(np.exp(1j * error[2]))) < 1e-8
        assert np.allclose(run["covariance"].values[-1, agent], cov, atol=1e-8)


OPTIONS: dict[str, dict[str, Any]] = {
    "extended": {},
    "unscented": {"linearization": "unscented"},
    "iterated": {"iterations": 3},
    "lag": {"lag": 2},
}


@pytest.mark.parametrize("logs", LOG_KINDS)
@pytest.mark.parametrize("option", OPTIONS)
def test_a_team_is_its_robots_one_by_one_for_each_run(option: str, logs: str) -> None:
    """Two runs of different data, one delayed observation between two steps."""
    options = OPTIONS[option]
    robots = LOG_KINDS[logs]
    models = AgentModels.from_models(robots)
    rng = np.random.default_rng(0)
    noise = [0.1 * rng.standard_normal((3, 2, m)) for m in (1, 2)]
    seen = [np.array(y)[:, None] + e for y, e in zip(SEEN[:2], noise, strict=True)]
    delayed = []
    if option == "lag":
        late = np.array([[4.9, -1.1], [5.3, -0.8]])
        delayed = [Observation(1.1, 1, late, arrival_time=3.0)]
    team = filters.GaussianFilter(models, SENSORS, share_observations=False, **options)
    start = team.start(PRIORS, runs=(2,))
    run = team.run(start, TIMES, [*seen, None], delayed=delayed)
    for agent in range(3):
        # A filter of this robot only, with its observations
        single = filters.GaussianFilter(robots[agent], [SENSORS[agent]], **options)
        observed = [seen[agent]] if agent < 2 else [None]
        late = [o.replace(agent=0) for o in delayed if o.agent == agent]
        start = single.start(PRIORS[agent], runs=(2,))
        expected = single.run(start, TIMES, observed, delayed=late)
        for name in ("mean", "covariance"):
            in_team = run[name].isel(agent=agent).values
            by_itself = expected[name].values[:, :, 0]
            assert np.allclose(in_team, by_itself, atol=1e-10)


@pytest.mark.parametrize("runs", [(), (2,)])
@pytest.mark.parametrize("family", ["ensemble", "particle"])
def test_members_move_with_draws_of_their_own_robots_inputs(
    family: str, runs: tuple[int, ...]
) -> None:
    """The same draws, robot by robot, from the same generator."""
    make = {"ensemble": filters.EnsembleFilter, "particle": filters.ParticleFilter}[
        family
    ]
    plain = [InputModel.from_inputs(3, drive, log) for log in LOGS]
    f = make(
        AgentModels.from_models(plain), [None] * 3, share_observations=False, members=50
    )
    members = np.random.default_rng(1).standard_normal((*runs, 3, 50, 3))
    state = f.start(members, rng=np.random.default_rng(2), runs=runs)
    after = f.step(state, 1.5, [None] * 3).belief
    (child,) = np.random.default_rng(2).spawn(1)
    if family == "particle":
        # The offset of a resampling that is not due.
        child.random((*runs, 3, 1))
    for agent, robot in enumerate(plain):
        x = members[..., agent, :, :]
        for _, dt, u in LOGS[agent].pieces(0.0, 1.5):
            # u + L z with Σ = L Lᵀ, for each piece of the step
            root = np.linalg.cholesky(LOGS[agent].cov)
            draws = child.standard_normal((*x.shape[:-1], 2)) @ root.T
            x = drive(x, u + draws, dt)
        # It draws for the noise that it does not have, too.
        child.standard_normal(x.shape)
        assert np.allclose(after[..., agent, :, :], x, atol=1e-12), robot


@pytest.mark.parametrize("family", ["ensemble", "particle"])
def test_members_of_a_team_have_the_moments_of_its_robots_alone(family: str) -> None:
    """In each of two runs, with a delayed observation, and such that the robots expect."""
    make: Any = {
        "ensemble": filters.EnsembleFilter,
        "particle": filters.ParticleFilter,
    }[family]
    make = partial(make, members=8000)
    sensors = [
        distance([0, 1], std=0.3, origin=[9.0, 9.0]),
        component([0, 1], std=0.3),
        None,
    ]
    paths = [
        simulate(robot, m, TIMES, rng=np.random.default_rng(5))
        for robot, (m, _) in zip(ROBOTS, PRIORS, strict=True)
    ]
    rng = np.random.default_rng(6)
    seen = [s and s.observe(x, rng=rng) for s, x in zip(sensors, paths, strict=True)]
    team = make(TEAM, sensors, share_observations=False, lag=2)
    start = team.start(PRIORS, rng=np.random.default_rng(0), runs=(2,))
    # Between the robot's places at the first two times
    halfway = (paths[1][0] + paths[1][1]) / 2
    late = Observation(1.1, 1, halfway[:2], arrival_time=3.0)
    run = team.run(start, TIMES, seen, delayed=[late])
    for agent in range(3):
        # Other draws, so that both differ by the errors of 8000 members.
        single = make(ROBOTS[agent], [sensors[agent]], lag=2)
        delayed = [late.replace(agent=0)] if agent == 1 else []
        start = single.start(PRIORS[agent], rng=np.random.default_rng(9))
        expected = single.run(start, TIMES, [seen[agent]], delayed=delayed)
        std = np.sqrt(expected["variance"].values[-1, 0])
        mean = run["mean"].values[-1, :, agent]
        error = mean - expected["mean"].values[-1, 0]
        assert np.abs(error / std).max() < 0.1
        variance = run["variance"].values[-1, :, agent]
        assert np.allclose(variance, std**2, rtol=0.1)


def test_robots_whose_states_are_the_same_target_share_and_fuse() -> None:
    """Two agents assume different process noises of one target, and share their observations."""
    walks = [
        LinearModel.from_transition(
            1, lambda dt: np.eye(1), lambda t, dt, q=q: q * dt * np.eye(1)
        )
        for q in (0.5, 2.0)
    ]
    f = filters.GaussianFilter(
        AgentModels.from_models(walks), [component([0], std=1.0)] * 2, graphs.path(2)
    )
    state = f.step(f.start(([0.0], [[1.0]])), 1.0, [[1.0], [3.0]])
    # Both see both: precision 1 / (1 + q) + 2, and the sum 4.
    for agent, q in enumerate((0.5, 2.0)):
        precision = 1 / (1 + q) + 2
        assert np.isclose(state.covariances[agent, 0, 0], 1 / precision)
        assert np.isclose(state.means[agent, 0], 4 / precision)


@pytest.mark.parametrize("logs", LOG_KINDS)
def test_simulations_and_derivatives_are_those_of_each(logs: str) -> None:
    robots = LOG_KINDS[logs]
    team = AgentModels.from_models(robots)
    x0 = np.array([m for m, _ in PRIORS])
    moved = simulate(team, x0, [1.0, 2.5], rng=np.random.default_rng(0))
    assert moved.shape == (2, 3, 3)
    std = np.array([0.1, 0.2, 0.3])
    # Twice: the first time checks the agents' models one by one.
    for _ in range(2):
        step = team.step(x0, 0.5, 1.0)
        slope = team.jacobian(x0, 0.5, 1.0, std=std)
        noise = team.noise_at(x0, 0.5, 1.0)
        for agent, robot in enumerate(robots):
            x = x0[agent]
            assert np.array_equal(step[agent], robot.step(x, 0.5, 1.0))
            expected = robot.jacobian(x, 0.5, 1.0, std=std)
            assert np.allclose(slope[agent], expected, atol=1e-9)
            assert np.allclose(noise[agent], robot.noise_at(x, 0.5, 1.0), atol=1e-9)
    # Members of two runs, whose agents stand on the second axis.
    batch = np.random.default_rng(1).standard_normal((2, 3, 4, 3))
    behind_runs = team.at_axis(1)
    for _ in range(2):
        moved = behind_runs.step(batch, 0.0, 1.5)
        noise = behind_runs.noise_at(batch, 0.0, 1.5)
        for agent, robot in enumerate(robots):
            members = batch[:, agent]
            assert np.array_equal(moved[:, agent], robot.step(members, 0.0, 1.5))
            expected = robot.noise_at(members, 0.0, 1.5)
            assert np.allclose(noise[:, agent], expected, atol=1e-9)


class Echo(Model):
    """A model whose derivative is the deviations that it is given."""

    def jacobian(
        self, x: Any, t: float, dt: float, *, std: np.ndarray | None = None
    ) -> np.ndarray:
        assert std is not None and std.shape == x.shape
        return std[..., None]


@pytest.mark.parametrize("axis", [0, 1])
def test_each_model_is_told_its_own_deviations(axis: int) -> None:
    echoes = [
        Echo(1, lambda x, t, dt: x, lambda t, dt: np.zeros((1, 1))) for _ in range(2)
    ]
    std = np.array([[1.0], [5.0]])
    if axis:
        std = np.array([[[1.0], [5.0]], [[2.0], [6.0]]])
    team = AgentModels.from_models(echoes).at_axis(axis)
    slopes = team.jacobian(np.zeros_like(std), 0.0, 1.0, std=std)
    assert np.array_equal(slopes[..., 0], std)


def test_a_robot_that_wraps_undeclared_is_named_once() -> None:
    """The second robot's own transition wraps its heading."""

    def wrap(x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        moved = drive(x, u, dt)
        moved[..., 2] = np.angle(np.exp(1j * moved[..., 2]))
        return moved

    robots = [
        InputModel.from_inputs(3, drive, LOGS[0]),
        InputModel.from_inputs(3, wrap, LOGS[1]),
    ]
    compass = Sensor(
        1,
        lambda x: x[..., 2:],
        [[0.01]],
        periods=(2 * np.pi,),
    )
    f = filters.EnsembleFilter(
        AgentModels.from_models(robots),
        [compass] * 2,
        share_observations=False,
        members=50,
    )
    prior = (np.array([0.0, 0.0, 3.1]), np.diag([0.1, 0.1, 0.04]))
    state = f.start(prior, rng=np.random.default_rng(0))
    with pytest.warns(RuntimeWarning, match="transition wraps component 2"):
        state = f.step(state, 0.1, [None, None])
    with warnings.catch_warnings(action="error"):
        f.step(state, 0.2, [None, None])


def test_families_of_one_common_state_refuse_a_team_by_name() -> None:
    walks = [
        Model(2, lambda x, t, dt: x, lambda t, dt: dt * np.eye(2)) for _ in range(2)
    ]
    two = AgentModels.from_models(walks)
    eyes = [component([0], std=1.0)] * 2
    ring = graphs.path(2)
    rule = partial(average_consensus, rounds=3)
    makers: list[Any] = [
        lambda: filters.TransportFilter(two, eyes, ring),
        lambda: filters.MixtureFilter(two, eyes, ring, target_dim=1),
        lambda: filters.InformationIncrementFilter(two, eyes, ring, target_dim=1),
        lambda: filters.InformationConsensusFilter(two, eyes, ring, fusion=rule),
        lambda: filters.ChannelFilter(two, eyes, ring),
        lambda: filters.GaussianSumFilter(two, eyes, ring),
        lambda: filters.LikelihoodConsensusFilter(
            two, eyes, ring, basis=filters.PolynomialBasis([0]), fusion=rule
        ),
    ]
    for make in makers:
        with pytest.raises(
            ValueError, match=r"model must be one for all agents of a \w+Filter"
        ):
            make()
    with pytest.raises(ValueError, match="one for each of 3 agents, got 2"):
        filters.GaussianFilter(two, [None] * 3, share_observations=False)
    with pytest.raises(ValueError, match="same dim for all agents, got 2 and 3"):
        AgentModels.from_models([walks[0], ROBOTS[0]])
    with pytest.raises(ValueError, match="must be a Model for each agent, got a list"):
        AgentModels.from_models([[walks[0]]])  # type: ignore[list-item]
    with pytest.raises(
        ValueError, match="models must have one for each agent, got none"
    ):
        AgentModels.from_models([])
    with pytest.raises(ValueError, match="axis 0 of 2 agents .* got shape .3, 2."):
        two.step(np.zeros((3, 2)), 0.0, 1.0)
    with pytest.raises(ValueError, match="noise_at has the noise of each"):
        two.Q(0.0, 1.0)
    with pytest.raises(ValueError, match="axis 0 of 2 agents"):
        filterpy_ekf(
            [0, 0], np.eye(2), [[1.0]], model=two, sensors=[eyes[0]], times=[1.0]
        )
    exact = partial(filters.EnsembleFilter.exact, two, eyes, share_observations=False)
    f = exact(members=9)
    state = f.start((np.zeros(2), np.eye(2)), rng=np.random.default_rng(0))
    with pytest.raises(ValueError, match="noise that does not depend on the state"):
        f.step(state, 1.0, [None, None])
