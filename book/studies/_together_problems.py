"""The problems of chapter 11: model, sensors, graph, prior, and the times of silence.

Four problems are tuned and compared; three more are held out, for the decision tree to
be tried on. Every number comes from ``data/scenarios/together``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from bookkit.published import Scenario, scenario
from distfilt import models, sensors
from distfilt.models import LinearModel, Model
from distfilt.network import Graph, graphs
from distfilt.sensors import Sensor

Array = np.ndarray
Data = tuple[Array, list[Array]]
"""Truths (T, runs, d) and each agent's observations (T, runs, m)."""

LINEAR = scenario("together", "linear")
RANGE = scenario("together", "range")
LORENZ = scenario("together", "lorenz")
PLACES = scenario("together", "places")
STUDY = scenario("together", "study")
TUNED = scenario("together", "tuned")
HELD = scenario("together", "held")
BATCH = STUDY["batch"]
TUNING = (STUDY["tuning_seed"], STUDY["tuning_runs"])

PLANE = ("x", "y")
SPACE = ("x", "y", "z")
WALKER = ("x", "y", "u", "v")
"""Position and velocity in the plane."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A filtering problem, the same for all filters; `scored` names the scored components.

    `silent` marks the agents (T, A) that observe nothing at a time. Where agents are
    uncertain of their own positions, `local` is the problem of one agent: [target; own
    position].
    """

    name: str
    model: Model
    sensors: list[Sensor]
    graph: Graph
    prior: tuple[Array, Array]
    times: Array
    burn_in: int
    scored: tuple[str, ...]
    silent: Array | None = None
    local: Any = None
    scenario: Any = field(default=None, kw_only=True)
    traits: tuple[str, ...] = field(default=(), kw_only=True)

    @property
    def n_agents(self) -> int:
        """Number of agents."""
        return len(self.sensors)

    @property
    def all_sensors(self) -> Sensor:
        """The sensors of all agents, stacked into one."""
        return sensors.stack(self.sensors)

    def simulate(self, runs: int, rng: np.random.Generator) -> Data:
        """Draw truths (T, runs, d) and observations (T, runs, m), NaN where an agent is silent."""
        # The truth starts from the prior and draws process noise.
        first = rng.multivariate_normal(*self.prior, size=runs)
        truth = models.simulate(self.model, first, self.times, rng=rng)
        # Each sensor has errors of its own.
        observed = [sensor.observe(truth, rng=rng) for sensor in self.sensors]
        if self.silent is not None:
            for agent, values in enumerate(observed):
                values[self.silent[:, agent]] = np.nan
        return truth, observed

    def scored_truth(self, truth: Array) -> dict[str, Array]:
        """The truth of the scored components, by name."""
        # Errors are scored by name: of a joint state only the target counts.
        names = list(self.model.names)
        return {name: truth[..., names.index(name)] for name in self.scored}

    def with_agents(self, agents: int) -> Problem:
        """The same problem with another number of agents."""
        return MAKERS[self.name](self.scenario, agents)


def observation_times(s: Scenario) -> Array:
    """Return the observation times of a scenario, (T,)."""
    return s["dt"] * np.arange(1, s["steps"] + 1)


# ------------------------------------------------------------------- the four tuned problems


def linear(s: Scenario = LINEAR, agents: int | None = None) -> Problem:
    """Eight agents on a ring observe one coordinate each of a walker."""
    agents = agents or s["agents"]
    # ṗ = v and v̇ = σ ẇ
    model = replace(models.constant_velocity(sigma=s["sigma"]), names=WALKER)
    # z = x for even agents and z = y for odd ones
    coordinates = [
        sensors.component([k % 2], std=s["reading_std"]) for k in range(agents)
    ]
    return Problem(
        "linear",
        model,
        coordinates,
        graphs.ring(agents),
        (np.zeros(4), np.diag(np.square(s["prior_std"]))),
        observation_times(s),
        s["burn"],
        WALKER,
        scenario=s,
        traits=("linear",),
    )


def rotation(angle: float) -> Array:
    """Return the rotation matrix of an angle, (2, 2)."""
    c = np.cos(angle)
    s = np.sin(angle)
    return np.array([[c, -s], [s, c]])


def silence(s: Scenario, agents: int) -> Array:
    """Return who is silent when, (T, A): in each spell all agents but two on a diameter."""
    # Steps are counted from zero; the end of a spell is not in it.
    silent = np.zeros((s["steps"], agents), dtype=bool)
    for (begin, end), quarter in zip(s["silences"], s["speakers"], strict=True):
        diameter = np.array([0, agents // 2]) + quarter * (agents // 4)
        speakers = diameter % agents
        silent[begin:end] = ~np.isin(np.arange(agents), speakers)
    return silent


def ranges(s: Scenario = RANGE, agents: int | None = None) -> Problem:
    """A ring of agents measures the range of a turning target; at times only two observe."""
    agents = agents or s["agents"]
    rate = s["turn_rate"]
    q = s["process_std"] ** 2
    # x(t + dt) = R(ω dt) x(t) + noise of variance q dt
    model = LinearModel.from_transition(
        2,
        lambda dt: rotation(rate * dt),
        lambda t, dt: q * dt * np.eye(2),
        names=PLANE,
    )
    # The agents stand on a circle about the origin.
    angle = 2 * np.pi * np.arange(agents) / agents
    places = s["radius"] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    std = s["reading_std"]
    # z = |p - sᵢ|
    rangers = [sensors.distance([0, 1], std=std, origin=place) for place in places]
    return Problem(
        "range",
        model,
        rangers,
        graphs.ring(agents),
        (np.zeros(2), s["prior_std"] ** 2 * np.eye(2)),
        observation_times(s),
        s["burn"],
        PLANE,
        silence(s, agents),
        scenario=s,
        traits=("curved", "several"),
    )


def lorenz(s: Scenario = LORENZ, agents: int | None = None) -> Problem:
    """Three agents on a path observe one component each of the Lorenz system of 1963."""
    agents = agents or s["agents"]
    # The parameters 10, 28 and 8/3 are those of 1963.
    model = models.lorenz63(sigma=s["sigma"], step=s["longest_step"])
    std = s["reading_std"]
    components = [sensors.component([k % 3], std=std) for k in range(agents)]
    return Problem(
        "lorenz",
        model,
        components,
        graphs.path(agents),
        (s["first"], s["prior_std"] ** 2 * np.eye(3)),
        observation_times(s),
        s["burn"],
        SPACE,
        scenario=s,
        traits=("chaotic",),
    )


def places(s: Scenario = PLACES, agents: int | None = None) -> Problem:
    """Agents uncertain of their own positions observe where a target is relative to them."""
    agents = agents or s["agents"]
    times = observation_times(s)
    ring = graphs.ring(agents)
    # Each agent's own problem has the state [target; own position].
    model, cov = target_and_egos(s, 1)
    local = Problem(
        "places",
        model,
        [relative_position_sensor(s, 0, 1)] * agents,
        ring,
        (np.zeros(6), cov),
        times,
        s["burn"],
        WALKER,
    )
    model, cov = target_and_egos(s, agents)
    return Problem(
        "places",
        model,
        [relative_position_sensor(s, agent, agents) for agent in range(agents)],
        ring,
        (np.zeros(len(cov)), cov),
        times,
        s["burn"],
        WALKER,
        local=local,
        scenario=s,
        traits=("linear", "uncertain"),
    )


def target_and_egos(s: Scenario, agents: int) -> tuple[LinearModel, Array]:
    """Return model and prior covariance of [target; agents]; the agents stand still."""
    # The target walks; the agents have no noise.
    walk = models.constant_velocity(sigma=s["sigma"])
    d = 4 + 2 * agents

    def transition(dt: float) -> Array:
        F = np.eye(d)
        F[:4, :4] = walk.F(dt)
        return F

    def noise(t: float, dt: float) -> Array:
        Q = np.zeros((d, d))
        Q[:4, :4] = walk.Q(t, dt)
        return Q

    # Names such as x0, y0, x1 for the agents' positions
    egos = [f"{axis}{agent}" for agent in range(agents) for axis in "xy"]
    names = WALKER + tuple(egos)
    model = LinearModel.from_transition(d, transition, noise, names=names)
    ego_stds = [s["ego_std"]] * (2 * agents)
    # The prior has no correlation between target and agents.
    stds = list(s["prior_std"]) + ego_stds
    return model, np.diag(np.square(stds))


def relative_position_sensor(s: Scenario, agent: int, agents: int) -> Sensor:
    """Return a sensor of the target's position minus that of one agent."""
    first = 4 + 2 * agent
    # H x = target - own position
    H = np.zeros((2, 4 + 2 * agents))
    H[:, :2] = np.eye(2)
    H[:, first : first + 2] = -np.eye(2)
    noise_cov = s["reading_std"] ** 2 * np.eye(2)
    return Sensor(2, lambda x: x @ H.T, noise_cov, linear=lambda d: H)


# ------------------------------------------------------------------- three held-out problems


def random_walk(std: float, names: tuple[str, ...]) -> LinearModel:
    """Return a random walk whose variance grows by std² a second in each component."""
    d = len(names)
    q = std**2
    return LinearModel.from_transition(
        d, lambda dt: np.eye(d), lambda t, dt: q * dt * np.eye(d), names=names
    )


def star(s: Scenario = HELD, agents: int | None = None) -> Problem:
    """Agents on a star observe one component each of a random walk in space."""
    agents = agents or s["star_agents"]
    std = s["reading_std"]
    components = [sensors.component([k % 3], std=std) for k in range(agents)]
    return Problem(
        "star",
        random_walk(s["star_step_std"], SPACE),
        components,
        graphs.star(agents),
        (np.zeros(3), 4 * np.eye(3)),
        observation_times(s),
        s["burn"],
        SPACE,
        scenario=s,
        traits=("linear",),
    )


def angles(s: Scenario = HELD, agents: int | None = None) -> Problem:
    """Agents along a road observe bearings of a walker; the graph is complete."""
    agents = agents or s["road_agents"]
    model = replace(models.constant_velocity(sigma=s["road_sigma"]), names=WALKER)
    # Sensors stand on a road beside the target, which does not reach it: no bearing wraps.
    road = np.linspace(-6, 6, agents)
    places = np.stack([road, np.full(agents, -s["road_distance"])], axis=-1)
    std = s["angle_std"]
    bearings = [sensors.bearing((0, 1), std=std, origin=place) for place in places]
    return Problem(
        "angles",
        model,
        bearings,
        graphs.complete(agents),
        (np.zeros(4), np.diag(np.square(s["road_prior_std"]))),
        observation_times(s),
        s["burn"],
        WALKER,
        scenario=s,
        traits=("curved",),
    )


def mirror(s: Scenario = HELD, agents: int | None = None) -> Problem:
    """Agents on a line measure ranges, which do not tell on which side of it the target is."""
    agents = agents or s["line_agents"]
    # From a line the two sides look alike.
    line = np.linspace(-5, 5, agents)
    places = np.stack([line, np.zeros(agents)], axis=-1)
    std = s["range_std"]
    rangers = [sensors.distance([0, 1], std=std, origin=place) for place in places]
    return Problem(
        "mirror",
        random_walk(s["line_step_std"], PLANE),
        rangers,
        graphs.path(agents),
        # The prior's mean lies on one side of the line.
        (np.array([0.0, 1.0]), 4 * np.eye(2)),
        observation_times(s),
        s["burn"],
        PLANE,
        scenario=s,
        traits=("curved", "several"),
    )


MAKERS: dict[str, Callable[..., Problem]] = {
    "linear": linear,
    "range": ranges,
    "lorenz": lorenz,
    "places": places,
    "star": star,
    "angles": angles,
    "mirror": mirror,
}
FOUR = tuple(MAKERS)[:4]
THREE = tuple(MAKERS)[4:]


@cache
def problem(name: str) -> Problem:
    """Return a problem by its name, made once."""
    return MAKERS[name]()
