"""Filters by events and by arrays against plain numpy that gives the same numbers.

Each plain filter is one that a user would write for its problem: arrays, a loop, the
equations of one step. Ours gets the same sensors and times, and records everything that
it records by default. Times are of the processor, in turns; a row misses where the two
differ by more than 1e-9 or ours takes longer than its limit allows.

Joint state: five robots (x, y, heading) and seven landmarks, 29 numbers, in one filter,
or in each of five agents. Target: four numbers, seen by five agents. Both come as
events. Orbit: six numbers, two observed, as arrays and as events. A loop that is compiled
by jax, where jax can be imported, is an anchor without a limit.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(1, str(Path(__file__).resolve().parents[2]))

import numpy as np
from _bench import Row, compare_times, main, peak_mb, peer, table

from distfilt.filters import (
    GaussianFilter,
    InformationIncrementFilter,
    MixtureFilter,
    Observation,
)
from distfilt.mixtures import target_fusion
from distfilt.models import Model, constant_velocity
from distfilt.network import covariance_intersection, graphs
from distfilt.sensors import Sensor, range_bearing

Moments = tuple[np.ndarray, np.ndarray]

SPEED = 0.3
ROBOTS = 5
LANDMARKS = 7
DIM = 3 * ROBOTS + 2 * LANDMARKS
EVENTS = 2000
STEPS = 1000
LONG = 100_000
LONG_SECONDS = 15.0
LONG_MB = 200.0
TOLERANCE = 1e-9
ROUNDS = 7


class Problem(NamedTuple):
    """A prior, a model, each agent's sensors, and the events (time, agent, sensor, value)."""

    mean: np.ndarray
    cov: np.ndarray
    model: Model
    sensors: list[list[Sensor]]
    events: list[tuple[float, int, int, np.ndarray]]

    def observations(self) -> list[Observation]:
        """Return the events as a filter takes them."""
        return [Observation(t, agent, y, k) for t, agent, k, y in self.events]


# Plain numpy ---------------------------------------------------------------------------


def wrap(angle: np.ndarray) -> np.ndarray:
    """Bring angles into [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def update(
    x: np.ndarray, p: np.ndarray, r: np.ndarray, h: np.ndarray, noise: np.ndarray
) -> Moments:
    """Return a Gaussian after an observation with innovation r and slope h."""
    s = h @ p @ h.T + noise
    gain = np.linalg.solve(s, h @ p).T
    rest = np.eye(x.size) - gain @ h
    # Joseph's form
    p = rest @ p @ rest.T + gain @ noise @ gain.T
    return x + gain @ r, p


def intersect(x: np.ndarray, p: np.ndarray, links: np.ndarray) -> Moments:
    """Return the agents' Gaussians after covariance intersection with equal weights."""
    weights = links / links.sum(axis=1, keepdims=True)
    information = np.linalg.inv(p)
    vectors = (information @ x[..., None])[..., 0]
    fused = np.linalg.inv(np.einsum("ab,bij->aij", weights, information))
    return (fused @ (weights @ vectors)[..., None])[..., 0], fused


def joint_ekf(problem: Problem, n_agents: int, links: np.ndarray | None) -> Moments:
    """Filter the robots' events, each by the agent that saw it, and fuse if there are links."""
    x = np.tile(problem.mean, (n_agents, 1))
    p = np.tile(problem.cov, (n_agents, 1, 1))
    rates = noise_rates()
    means = np.empty((len(problem.events), n_agents, DIM))
    covs = np.empty((len(problem.events), n_agents, DIM, DIM))
    before = 0.0
    for k, (t, agent, number, y) in enumerate(problem.events):
        dt = t - before
        before = t
        f = drive_slope(x, 0.0, dt)
        x = drive(x, 0.0, dt)
        p = f @ p @ f.swapaxes(1, 2)
        p += dt * rates
        robot, landmark = divmod(number, LANDMARKS)
        if n_agents > 1:
            robot, landmark = agent, number
        seen, h = sight(x[agent], robot, landmark)
        r = y - seen
        r[1] = wrap(r[1])
        x[agent], p[agent] = update(x[agent], p[agent], r, h, SIGHT_COV)
        if links is not None:
            # Headings on the branch of the first agent's
            first = x[0, HEADINGS]
            x[:, HEADINGS] = first + wrap(x[:, HEADINGS] - first)
            x, p = intersect(x, p, links)
        x[:, HEADINGS] = wrap(x[:, HEADINGS])
        means[k] = x
        covs[k] = p
    return means, covs


def target_ekf(problem: Problem, links: np.ndarray | None, shares: bool) -> Moments:
    """Filter a target's events in each agent: its own, or its neighbours' too."""
    n_agents = len(problem.sensors)
    x = np.tile(problem.mean, (n_agents, 1))
    p = np.tile(problem.cov, (n_agents, 1, 1))
    means = np.empty((len(problem.events), n_agents, 4))
    covs = np.empty((len(problem.events), n_agents, 4, 4))
    before = 0.0
    for k, (t, agent, _, y) in enumerate(problem.events):
        dt = t - before
        before = t
        f = np.eye(4)
        f[0, 2] = f[1, 3] = dt
        x = x @ f.T
        p = f @ p @ f.T + problem.model.noise_cov(0.0, dt)
        receivers = [agent]
        if shares and links is not None:
            receivers = np.flatnonzero(links[agent]).tolist()
        for receiver in receivers:
            seen, h = polar(x[receiver], ANCHORS[agent])
            r = y - seen
            r[1] = wrap(r[1])
            x[receiver], p[receiver] = update(x[receiver], p[receiver], r, h, POLAR_COV)
        if links is not None and not shares:
            x, p = intersect(x, p, links)
        means[k] = x
        covs[k] = p
    return means, covs


def orbit_ekf(problem: Problem) -> Moments:
    """Filter a turning body of six numbers by an extended filter."""
    x = problem.mean
    p = problem.cov
    means = np.empty((len(problem.events), 6))
    covs = np.empty((len(problem.events), 6, 6))
    before = 0.0
    for k, (t, _, _, y) in enumerate(problem.events):
        dt = t - before
        before = t
        f = turn_slope(x, 0.0, dt)
        x = turn(x, 0.0, dt)
        p = f @ p @ f.T + dt * TURN_RATES
        seen, h = polar(x, ANCHORS[0])
        r = y - seen
        r[1] = wrap(r[1])
        x, p = update(x, p, r, h, POLAR_COV)
        means[k] = x
        covs[k] = p
    return means, covs


def orbit_ukf(problem: Problem) -> Moments:
    """Filter a turning body of six numbers by an unscented filter, kappa = 1."""
    x = problem.mean
    p = problem.cov
    weights = np.full(13, 1 / 14)
    weights[0] = 1 / 7
    means = np.empty((len(problem.events), 6))
    covs = np.empty((len(problem.events), 6, 6))
    before = 0.0
    for k, (t, _, _, y) in enumerate(problem.events):
        dt = t - before
        before = t
        moved = turn(sigma_points(x, p), 0.0, dt)
        x = weights @ moved
        anomalies = moved - x
        p = (weights[:, None] * anomalies).T @ anomalies + dt * TURN_RATES
        points = sigma_points(x, p)
        seen = polar_of(points, ANCHORS[0])
        # All on the branch of the first
        seen[:, 1] = seen[0, 1] + wrap(seen[:, 1] - seen[0, 1])
        predicted = weights @ seen
        differences = seen - predicted
        s = (weights[:, None] * differences).T @ differences + POLAR_COV
        cross = (weights[:, None] * (points - x)).T @ differences
        r = y - predicted
        r[1] = wrap(r[1])
        gain = np.linalg.solve(s, cross.T).T
        x = x + gain @ r
        p = p - gain @ s @ gain.T
        means[k] = x
        covs[k] = p
    return means, covs


def sigma_points(x: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the 13 points of a Gaussian of six numbers, kappa = 1."""
    offsets = np.sqrt(7.0) * np.linalg.cholesky(p).T
    return np.concatenate([x[None], x + offsets, x - offsets])


def ring_ekf(problem: Problem, links: np.ndarray) -> Moments:
    """Filter a turning body in four agents that all observe, and fuse in every step."""
    n_agents = len(problem.sensors)
    x = np.tile(problem.mean, (n_agents, 1))
    p = np.tile(problem.cov, (n_agents, 1, 1))
    n_steps = len(problem.events) // n_agents
    means = np.empty((n_steps, n_agents, 6))
    covs = np.empty((n_steps, n_agents, 6, 6))
    before = 0.0
    for k in range(n_steps):
        events = problem.events[k * n_agents : (k + 1) * n_agents]
        dt = events[0][0] - before
        before = events[0][0]
        f = turn_slope(x, 0.0, dt)
        x = turn(x, 0.0, dt)
        p = f @ p @ f.swapaxes(1, 2) + dt * TURN_RATES
        for _, agent, _, y in events:
            seen, h = polar(x[agent], ANCHORS[agent])
            r = y - seen
            r[1] = wrap(r[1])
            x[agent], p[agent] = update(x[agent], p[agent], r, h, POLAR_COV)
        x, p = intersect(x, p, links)
        means[k] = x
        covs[k] = p
    return means, covs


# The problems --------------------------------------------------------------------------

HEADINGS = 3 * np.arange(ROBOTS) + 2
TURNS = 0.1 * np.array([1.0, -0.5, 0.7, -1.0, 0.4])
SIGHT_COV = np.diag([0.02, 0.001])
POLAR_COV = np.diag([0.25, 0.0004])
ANCHORS = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 60.0], [0.0, 60.0], [30.0, -20.0]])
TURN_RATES = np.diag([0.01, 0.01, 0.02, 0.02, 1e-4, 1e-5])


def noise_rates() -> np.ndarray:
    """Return the robots' noise covariance per second; landmarks stand still."""
    rates = np.zeros(DIM)
    rates[: 3 * ROBOTS] = np.tile([1e-3, 1e-3, 1e-4], ROBOTS)
    return np.diag(rates)


def drive(x: np.ndarray, t: float, dt: float) -> np.ndarray:
    """Move the robots along their headings, and turn them."""
    moved = x.copy()
    heading = x[..., HEADINGS]
    moved[..., HEADINGS - 2] += SPEED * dt * np.cos(heading)
    moved[..., HEADINGS - 1] += SPEED * dt * np.sin(heading)
    moved[..., HEADINGS] += TURNS * dt
    return moved


def drive_slope(x: np.ndarray, t: float, dt: float) -> np.ndarray:
    """Return the derivative of `drive`."""
    slope = np.zeros((*x.shape, DIM))
    slope[...] = np.eye(DIM)
    heading = x[..., HEADINGS]
    slope[..., HEADINGS - 2, HEADINGS] = -SPEED * dt * np.sin(heading)
    slope[..., HEADINGS - 1, HEADINGS] = SPEED * dt * np.cos(heading)
    return slope


def sight_of(x: np.ndarray, robot: int, landmark: int) -> np.ndarray:
    """Return distance and bearing of a landmark from a robot, off its heading."""
    at = 3 * ROBOTS + 2 * landmark
    east = x[..., at] - x[..., 3 * robot]
    north = x[..., at + 1] - x[..., 3 * robot + 1]
    seen = np.empty((*x.shape[:-1], 2))
    seen[..., 0] = np.sqrt(east * east + north * north)
    seen[..., 1] = np.arctan2(north, east) - x[..., 3 * robot + 2]
    return seen


def sight_slope(x: np.ndarray, robot: int, landmark: int) -> np.ndarray:
    """Return the derivative of `sight_of`."""
    at = 3 * ROBOTS + 2 * landmark
    base = 3 * robot
    east = x[..., at] - x[..., base]
    north = x[..., at + 1] - x[..., base + 1]
    square = east * east + north * north
    distance = np.sqrt(square)
    slope = np.zeros((*x.shape[:-1], 2, DIM))
    slope[..., 0, at] = east / distance
    slope[..., 0, at + 1] = north / distance
    slope[..., 1, at] = -north / square
    slope[..., 1, at + 1] = east / square
    slope[..., base : base + 2] = -slope[..., at : at + 2]
    slope[..., 1, base + 2] = -1.0
    return slope


def sight(x: np.ndarray, robot: int, landmark: int) -> Moments:
    """Return a robot's observation of a landmark, and its derivative."""
    return sight_of(x, robot, landmark), sight_slope(x, robot, landmark)


def polar_of(x: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """Return distance and bearing of a place from an anchor."""
    east = x[..., 0] - anchor[0]
    north = x[..., 1] - anchor[1]
    seen = np.empty((*x.shape[:-1], 2))
    seen[..., 0] = np.sqrt(east * east + north * north)
    seen[..., 1] = np.arctan2(north, east)
    return seen


def polar(x: np.ndarray, anchor: np.ndarray) -> Moments:
    """Return distance and bearing of a place from an anchor, and their derivative."""
    return polar_of(x, anchor), polar_slope(x, anchor)


def polar_slope(x: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """Return the derivative of `polar_of`."""
    east = x[..., 0] - anchor[0]
    north = x[..., 1] - anchor[1]
    square = east * east + north * north
    distance = np.sqrt(square)
    slope = np.zeros((*x.shape[:-1], 2, x.shape[-1]))
    slope[..., 0, 0] = east / distance
    slope[..., 0, 1] = north / distance
    slope[..., 1, 0] = -north / square
    slope[..., 1, 1] = east / square
    return slope


def turn(x: np.ndarray, t: float, dt: float) -> np.ndarray:
    """Move along a turn: place, velocity, the rate of turn and its drift."""
    angle = dt * x[..., 4]
    cos = np.cos(angle)
    sin = np.sin(angle)
    moved = np.empty(x.shape)
    moved[..., 2] = cos * x[..., 2] - sin * x[..., 3]
    moved[..., 3] = sin * x[..., 2] + cos * x[..., 3]
    moved[..., 0] = x[..., 0] + dt * x[..., 2]
    moved[..., 1] = x[..., 1] + dt * x[..., 3]
    moved[..., 4] = x[..., 4] + dt * x[..., 5]
    moved[..., 5] = x[..., 5]
    return moved


def turn_slope(x: np.ndarray, t: float, dt: float) -> np.ndarray:
    """Return the derivative of `turn`."""
    angle = dt * x[..., 4]
    cos = np.cos(angle)
    sin = np.sin(angle)
    slope = np.zeros((*x.shape, 6))
    slope[..., 0, 0] = slope[..., 1, 1] = slope[..., 4, 4] = slope[..., 5, 5] = 1.0
    slope[..., 0, 2] = slope[..., 1, 3] = slope[..., 4, 5] = dt
    slope[..., 2, 2] = slope[..., 3, 3] = cos
    slope[..., 2, 3] = -sin
    slope[..., 3, 2] = sin
    slope[..., 2, 4] = dt * (-sin * x[..., 2] - cos * x[..., 3])
    slope[..., 3, 4] = dt * (cos * x[..., 2] - sin * x[..., 3])
    return slope


def draw_times(rng: np.random.Generator, n: int, interval: float) -> np.ndarray:
    """Return increasing times with intervals that all differ."""
    return np.cumsum(interval * rng.uniform(0.5, 1.5, n))


def make_joint(n_agents: int) -> Problem:
    """Five robots that see seven landmarks, in one filter or in each of five agents."""
    rng = np.random.default_rng(29)
    x = np.zeros(DIM)
    x[: 3 * ROBOTS] = rng.uniform(-4.0, 4.0, 3 * ROBOTS)
    x[HEADINGS] = rng.uniform(-1.0, 1.0, ROBOTS)
    x[3 * ROBOTS :] = 12.0 * rng.choice([-1, 1], 2 * LANDMARKS)
    x[3 * ROBOTS :] += rng.uniform(-3.0, 3.0, 2 * LANDMARKS)
    variances = np.full(DIM, 0.25)
    variances[HEADINGS] = 0.01
    cov = np.diag(variances)
    mean = x + np.sqrt(variances) * rng.standard_normal(DIM)
    rates = noise_rates()
    model = Model(
        DIM,
        drive,
        lambda t, dt: dt * rates,
        derivative=drive_slope,
        periods={int(k): 2 * np.pi for k in HEADINGS},
    )
    sights = [
        [
            Sensor(
                2,
                partial(sight_of, robot=i, landmark=j),
                SIGHT_COV,
                derivative=partial(sight_slope, robot=i, landmark=j),
                periods=(None, 2 * np.pi),
            )
            for j in range(LANDMARKS)
        ]
        for i in range(ROBOTS)
    ]
    noise = np.sqrt(np.diag(SIGHT_COV))
    events = []
    before = 0.0
    for t in draw_times(rng, EVENTS, 0.05).tolist():
        x = drive(x, 0.0, t - before)
        before = t
        robot = int(rng.integers(ROBOTS))
        landmark = int(rng.integers(LANDMARKS))
        y = sight_of(x, robot, landmark) + noise * rng.standard_normal(2)
        y[1] = wrap(y[1])
        if n_agents == 1:
            events.append((t, 0, robot * LANDMARKS + landmark, y))
        else:
            events.append((t, robot, landmark, y))
    sensors = sights if n_agents > 1 else [[s for row in sights for s in row]]
    return Problem(mean, cov, model, sensors, events)


def make_target(n_events: int) -> Problem:
    """A target of four numbers, which five agents see one after the other."""
    rng = np.random.default_rng(4)
    model = constant_velocity(sigma=0.1)
    x = np.array([20.0, 20.0, 0.5, 0.2])
    mean = x + np.array([1.0, -1.0, 0.1, 0.1])
    noise = np.sqrt(np.diag(POLAR_COV))
    events = []
    before = 0.0
    for t in draw_times(rng, n_events, 0.05).tolist():
        dt = t - before
        before = t
        x[:2] += dt * x[2:]
        # It is held near the middle.
        x[2:] += dt * (0.01 * (25.0 - x[:2]) - 0.05 * x[2:])
        x[2:] += 0.1 * np.sqrt(dt) * rng.standard_normal(2)
        agent = int(rng.integers(5))
        y = polar_of(x, ANCHORS[agent]) + noise * rng.standard_normal(2)
        events.append((t, agent, 0, y))
    sensors = [[range_bearing([0, 1], std=noise, origin=place)] for place in ANCHORS]
    return Problem(mean, np.diag([4.0, 4.0, 0.25, 0.25]), model, sensors, events)


def make_orbit(n_agents: int) -> Problem:
    """A turning body of six numbers, which one agent or several see in every step."""
    rng = np.random.default_rng(6)
    x = np.array([20.0, 25.0, 1.0, 0.5, 0.1, 0.0])
    noise = np.sqrt(np.diag(POLAR_COV))
    sensors = [
        [
            Sensor(
                2,
                partial(polar_of, anchor=place),
                POLAR_COV,
                derivative=partial(polar_slope, anchor=place),
                periods=(None, 2 * np.pi),
            )
        ]
        for place in ANCHORS[:n_agents]
    ]
    model = Model(6, turn, lambda t, dt: dt * TURN_RATES, derivative=turn_slope)
    events = []
    for k in range(STEPS):
        x = turn(x, 0.0, 0.1)
        for agent in range(n_agents):
            y = polar_of(x, ANCHORS[agent]) + noise * rng.standard_normal(2)
            events.append((0.1 * (k + 1), agent, 0, y))
    mean = np.array([20.5, 24.5, 1.1, 0.4, 0.1, 0.0])
    cov = np.diag([1.0, 1.0, 0.1, 0.1, 1e-3, 1e-5])
    return Problem(mean, cov, model, sensors, events)


# Ours ----------------------------------------------------------------------------------


def run_events(f: Any, problem: Problem, events: list[Observation]) -> Any:
    """Run a filter through events and record it."""
    return f.run(f.start((problem.mean, problem.cov)), None, events)


def run_arrays(f: Any, problem: Problem) -> Any:
    """Run a filter through arrays, (T, m) for each agent, and record it."""
    times = np.unique([t for t, *_ in problem.events])
    series = [
        np.array([y for _, agent, _, y in problem.events if agent == k])
        for k in range(len(problem.sensors))
    ]
    return f.run(f.start((problem.mean, problem.cov)), times, series)


def largest_gap(run: Any, expected: Moments) -> float:
    """Return the largest relative difference of means and covariances."""
    gaps = []
    for name, values in zip(("mean", "covariance"), expected, strict=True):
        ours = run[name].values.reshape(values.shape)
        gaps.append(np.abs(ours - values).max() / np.abs(values).max())
    return float(max(gaps))


def compare(
    case: str, limit: float, plain: Callable[[], Moments], **ours: Callable[[], Any]
) -> Iterator[Row]:
    """Rows of a case: the plain filter's time, ours, and how many times as long ours takes."""
    expected = plain()
    gaps = {name: largest_gap(run(), expected) for name, run in ours.items()}
    times, ratios = compare_times({"plain numpy": plain, **ours}, ROUNDS)
    for name in ours:
        # `ratios` has each one's time as a multiple of the first one's.
        yield {
            "case": case,
            "input": name,
            "plain_s": f"{times['plain numpy']:.4f}",
            "distfilt_s": f"{times[name]:.4f}",
            "ratio": f"{ratios[name]:.2f}",
            "limit": limit,
            "gap": f"{gaps[name]:.0e}",
            "missed": gaps[name] > TOLERANCE or ratios[name] > limit,
        }


def links_of(graph: Any) -> np.ndarray:
    """Return the matrix of who hears whom, everyone itself too."""
    links = np.eye(graph.n_agents)
    links[graph.receivers, graph.senders] = 1.0
    return links


def joint_rows() -> Iterator[Row]:
    """The joint state of robots and landmarks: one filter, five that are silent, five that fuse."""
    one = make_joint(1)
    f = GaussianFilter(one.model, one.sensors)
    ours = partial(run_events, f, one, one.observations())
    yield from compare("joint, 29", 2.0, partial(joint_ekf, one, 1, None), events=ours)
    five = make_joint(ROBOTS)
    silent = GaussianFilter(five.model, five.sensors, share_observations=False)
    ours = partial(run_events, silent, five, five.observations())
    yield from compare(
        "no talk, 5 x 29", 2.0, partial(joint_ekf, five, ROBOTS, None), events=ours
    )
    ring = graphs.ring(ROBOTS)
    fusing = GaussianFilter(
        five.model,
        five.sensors,
        ring,
        share_observations=False,
        fusion=covariance_intersection,
    )
    ours = partial(run_events, fusing, five, five.observations())
    plain = partial(joint_ekf, five, ROBOTS, links_of(ring))
    yield from compare("intersection, 5 x 29", 2.0, plain, events=ours)


def target_filters(problem: Problem) -> dict[str, GaussianFilter]:
    """Return five agents that are silent, share their observations, or fuse their beliefs."""
    ring = graphs.ring(5)
    model = problem.model
    sensors = problem.sensors
    return {
        "no talk": GaussianFilter(model, sensors, share_observations=False),
        "sharing": GaussianFilter(model, sensors, ring),
        "intersection": GaussianFilter(
            model,
            sensors,
            ring,
            share_observations=False,
            fusion=covariance_intersection,
        ),
    }


def target_rows() -> Iterator[Row]:
    """A target of four numbers in five agents."""
    problem = make_target(EVENTS)
    events = problem.observations()
    links = links_of(graphs.ring(5))
    for name, f in target_filters(problem).items():
        plain = partial(
            target_ekf, problem, None if name == "no talk" else links, name == "sharing"
        )
        ours = partial(run_events, f, problem, events)
        yield from compare(f"target, 5 x 4, {name}", 3.0, plain, events=ours)


def orbit_rows() -> Iterator[Row]:
    """A turning body of six numbers: extended, unscented, and on a ring of four."""
    one = make_orbit(1)
    for name, plain in (("extended", orbit_ekf), ("unscented", orbit_ukf)):
        f = GaussianFilter(one.model, one.sensors, linearization=name)
        yield from compare(
            f"{name}, d = 6, m = 2",
            2.5,
            partial(plain, one),
            arrays=partial(run_arrays, f, one),
            events=partial(run_events, f, one, one.observations()),
        )
    four = make_orbit(4)
    ring = graphs.ring(4)
    f = GaussianFilter(
        four.model,
        four.sensors,
        ring,
        share_observations=False,
        fusion=covariance_intersection,
    )
    yield from compare(
        "ring of 4, intersection, d = 6",
        2.5,
        partial(ring_ekf, four, links_of(ring)),
        arrays=partial(run_arrays, f, four),
        events=partial(run_events, f, four, four.observations()),
    )


@table("events", "numpy", "scipy")
def ratios() -> Iterator[Row]:
    yield from joint_rows()
    yield from target_rows()
    yield from orbit_rows()


@table("events_families", "numpy", "scipy")
def families() -> Iterator[Row]:
    """Mixtures and increments beside Gaussians, and late observations beside punctual ones."""
    problem = make_target(EVENTS // 4)
    events = problem.observations()
    ring = graphs.ring(5)
    prior = (problem.mean, problem.cov)
    gaussian = target_filters(problem)["intersection"]
    mixture = MixtureFilter(
        problem.model,
        problem.sensors,
        ring,
        target_dim=4,
        n_components=1,
        max_components=1,
        fusion=partial(target_fusion, target_dim=4),
    )
    increments = InformationIncrementFilter(
        problem.model, problem.sensors, ring, target_dim=4
    )
    times, found = compare_times(
        {
            "Gaussian": partial(run_events, gaussian, problem, events),
            "mixture": partial(run_events, mixture, problem, events),
            "increments": partial(run_events, increments, problem, events),
        },
        ROUNDS,
    )
    for name in ("mixture", "increments"):
        yield family_row(f"{name} beside Gaussian", times[name], found[name])
    # Contact once in ten events; every tenth observation arrives three events late.
    prompt = target_filters(problem)["sharing"]
    waiting = GaussianFilter(
        problem.model, problem.sensors, ring, lag=25, exchange_interval=0.5
    )
    times, found = compare_times(
        {
            "late": partial(run_delayed, waiting, prior, events),
            "punctual": partial(run_events, waiting, problem, events),
            "prompt": partial(run_events, prompt, problem, events),
        },
        ROUNDS,
    )
    # `found` has the others as multiples of the late ones.
    for name, case in (
        ("punctual", "late beside punctual, both with rare contact"),
        ("prompt", "late with rare contact beside prompt without a lag"),
    ):
        yield family_row(case, times["late"], 1 / found[name])


def run_delayed(f: Any, prior: Moments, events: list[Observation]) -> Any:
    """Run a filter through events of which every tenth arrives three events late."""
    times = np.array([event.t for event in events])
    late = []
    punctual = []
    for k, event in enumerate(events):
        if k % 10 == 5 and k + 3 < len(events):
            arrival = float(times[k + 3])
            late.append(event.replace(arrival_time=arrival))
        else:
            punctual.append(event)
    return f.run(f.start(prior), times, punctual, delayed=late)


def family_row(case: str, seconds: float, ratio: float) -> Row:
    """A row of a ratio of two of our own times, at most three."""
    return {
        "case": case,
        "seconds": f"{seconds:.4f}",
        "ratio": f"{ratio:.2f}",
        "limit": 3.0,
        "missed": ratio > 3.0,
    }


@table("events_long", "numpy", "scipy")
def long_run() -> Iterator[Row]:
    """A hundred thousand events of a target in five agents, in a process of its own."""
    for keep in ("everything", "no covariance"):
        text = subprocess.run(
            [sys.executable, __file__, "long", keep],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        seconds, recorded, peak = [float(word) for word in text.split()]
        yield {
            "case": f"{LONG} events, 5 x 4, {keep}",
            "seconds": f"{seconds:.1f}",
            "limit_s": LONG_SECONDS,
            "recorded_mb": f"{recorded:.0f}",
            "limit_mb": LONG_MB,
            "peak_mb": f"{peak:.0f}",
            "missed": seconds > LONG_SECONDS or recorded > LONG_MB,
        }


def measure_long(keep: str) -> None:
    """Print the seconds of a long run, the size of its record, and the process's peak, in MB."""
    problem = make_target(LONG)
    f = target_filters(problem)["sharing"]
    events = problem.observations()
    options = {"keep": ("mean", "variance")} if keep == "no covariance" else {}
    began = time.process_time()
    run = f.run(f.start((problem.mean, problem.cov)), None, events, **options)
    seconds = time.process_time() - began
    print(seconds, run.nbytes / 2**20, peak_mb())


@table("events_compiled", "numpy", "jax")
def compiled() -> Iterator[Row]:
    """A compiled loop of the extended filter, as an anchor: no limit."""
    if peer("jax") is None:
        return
    problem = make_orbit(1)
    scan = compile_orbit(problem)
    f = GaussianFilter(problem.model, problem.sensors)
    expected = orbit_ekf(problem)
    means, covs = scan()
    gap = max(
        np.abs(means - expected[0]).max() / np.abs(expected[0]).max(),
        np.abs(covs - expected[1]).max() / np.abs(expected[1]).max(),
    )
    times, found = compare_times(
        {"scan": scan, "ours": partial(run_arrays, f, problem)}, ROUNDS
    )
    yield {
        "case": "extended, d = 6, m = 2, jax.lax.scan",
        "scan_s": f"{times['scan']:.5f}",
        "distfilt_s": f"{times['ours']:.4f}",
        "ratio": f"{found['ours']:.1f}",
        "gap": f"{gap:.0e}",
        "missed": gap > TOLERANCE,
    }


def compile_orbit(problem: Problem) -> Callable[[], Moments]:
    """Return a compiled run of the extended filter on a turning body."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    anchor = ANCHORS[0]

    def move(x: Any, dt: Any) -> Any:
        cos = jnp.cos(dt * x[4])
        sin = jnp.sin(dt * x[4])
        east = cos * x[2] - sin * x[3]
        north = sin * x[2] + cos * x[3]
        place = x[:2] + dt * x[2:4]
        rate = x[4] + dt * x[5]
        return jnp.array([place[0], place[1], east, north, rate, x[5]])

    def look(x: Any) -> Any:
        offset = x[:2] - anchor
        return jnp.array([jnp.hypot(*offset), jnp.arctan2(offset[1], offset[0])])

    def step(belief: Any, entry: Any) -> Any:
        x, p = belief
        dt, y = entry
        f = jax.jacfwd(move)(x, dt)
        x = move(x, dt)
        p = f @ p @ f.T + dt * TURN_RATES
        h = jax.jacfwd(look)(x)
        r = y - look(x)
        r = r.at[1].set((r[1] + jnp.pi) % (2 * jnp.pi) - jnp.pi)
        s = h @ p @ h.T + POLAR_COV
        gain = jnp.linalg.solve(s, h @ p).T
        rest = jnp.eye(6) - gain @ h
        x = x + gain @ r
        p = rest @ p @ rest.T + gain @ POLAR_COV @ gain.T
        return (x, p), (x, p)

    times = np.array([t for t, *_ in problem.events])
    lengths = np.diff(times, prepend=0.0)
    values = np.array([y for *_, y in problem.events])
    scan = jax.jit(
        lambda: jax.lax.scan(step, (problem.mean, problem.cov), (lengths, values))[1]
    )

    def run() -> Moments:
        means, covs = scan()
        return np.asarray(means), np.asarray(covs)

    return run


if __name__ == "__main__":
    if sys.argv[1:2] == ["long"]:
        measure_long(sys.argv[2])
    else:
        main()
