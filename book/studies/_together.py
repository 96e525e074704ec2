"""One network, every filter: the problems, the filters and the one loop of chapter 11's studies.

A `Problem` is a model, sensors, a graph, a prior and who is silent when. A `Cell` is a filter with
a rule of talking; it makes the filter for any problem and for any value of its one tuned number.
Cells draw from generators of their own, so that any of them can be run again alone.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import sys
import warnings
import zlib
from collections.abc import Callable, Iterable
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cache, partial
from typing import Any

import _together_mixtures
import numpy as np
from _together_mixtures import Mixtures

from bookkit.published import scenario
from distfilt import filters, metrics, models, network, sensors
from distfilt.ensembles import sample_covariance
from distfilt.filters import EnsembleFilter, GaussianFilter, Observation, ParticleFilter
from distfilt.network import covariance_intersection, graphs
from distfilt.triangular import separable
from distfilt.updates import (
    enkf,
    enkf_exact,
    enkf_sampled_covariance,
    etkf,
    resample,
    transport_map_update,
    with_inflation,
)

Array = np.ndarray
LINEAR = scenario("together", "linear")
RANGE = scenario("together", "range")
LORENZ = scenario("together", "lorenz")
PLACES = scenario("together", "places")
STUDY = scenario("together", "study")
TUNED = scenario("together", "tuned")
HELD = scenario("together", "held")
BATCH = STUDY["batch"]
TUNING = (STUDY["tuning_seed"], STUDY["tuning_runs"])


# ------------------------------------------------------------------------------------- problems


@dataclass(frozen=True, eq=False)
class Problem:
    """What all filters get alike; `scored` names the components that count."""

    name: str
    model: Any
    sensors: list[Any]
    graph: Any
    prior: tuple[Array, Array]
    times: Array
    burn: int
    scored: tuple[str, ...]
    silent: Array | None = None
    own: Any = None
    scenario: Any = field(default=None, kw_only=True)
    traits: tuple[str, ...] = field(default=(), kw_only=True)

    @property
    def agents(self) -> int:
        """How many."""
        return len(self.sensors)

    @property
    def together(self) -> Any:
        """All sensors as one."""
        return sensors.stack(self.sensors)

    def data(self, runs: int, rng: np.random.Generator) -> tuple[Array, list[Array]]:
        """Truths (T, runs, d) and each agent's readings (T, runs, m), NaN where it is silent."""
        first = rng.multivariate_normal(*self.prior, size=runs)
        truth = models.simulate(self.model, first, self.times, rng=rng)
        seen = [sensor.observe(truth, rng=rng) for sensor in self.sensors]
        if self.silent is not None:
            for agent, y in enumerate(seen):
                y[self.silent[:, agent]] = np.nan
        return truth, seen

    def known(self, truth: Array) -> dict[str, Array]:
        """The truth of the components that count."""
        names = list(self.model.names)
        return {name: truth[..., names.index(name)] for name in self.scored}

    def resized(self, agents: int) -> Problem:
        """The same with another number of agents."""
        return MAKERS[self.name](self.scenario, agents)


def clock(s: Any) -> Array:
    """The times of a scenario."""
    return s["dt"] * np.arange(1, s["steps"] + 1)


def linear(s: Any = LINEAR, agents: int | None = None) -> Problem:
    """Eight agents on a ring see one coordinate each of a walker."""
    agents = agents or s["agents"]
    model = replace(
        models.constant_velocity(sigma=s["sigma"]), names=("x", "y", "u", "v")
    )
    eyes = [sensors.component([k % 2], std=s["reading_std"]) for k in range(agents)]
    prior = np.zeros(4), np.diag(np.square(s["prior_std"]))
    return Problem(
        "linear",
        model,
        eyes,
        graphs.ring(agents),
        prior,
        clock(s),
        s["burn"],
        ("x", "y", "u", "v"),
        scenario=s,
    )


def turn(angle: float) -> Array:
    """The rotation by an angle."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def ranges(s: Any = RANGE, agents: int | None = None) -> Problem:
    """A turning target, seen in range by a ring; at times all are silent but one diameter."""
    agents = agents or s["agents"]
    rate = s["turn_rate"]
    q = s["process_std"] ** 2
    model = models.LinearModel.from_transition(
        2,
        lambda dt: turn(rate * dt),
        lambda t, dt: q * dt * np.eye(2),
        names=("x", "y"),
    )
    angles = 2 * np.pi * np.arange(agents) / agents
    at = s["radius"] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    eyes = [
        sensors.distance([0, 1], std=s["reading_std"], origin=place) for place in at
    ]
    silent = np.zeros((s["steps"], agents), dtype=bool)
    for (begin, end), quarter in zip(s["silences"], s["speakers"], strict=True):
        speak = (np.array([0, agents // 2]) + quarter * (agents // 4)) % agents
        silent[begin:end] = ~np.isin(np.arange(agents), speak)
    prior = np.zeros(2), s["prior_std"] ** 2 * np.eye(2)
    return Problem(
        "range",
        model,
        eyes,
        graphs.ring(agents),
        prior,
        clock(s),
        s["burn"],
        ("x", "y"),
        silent,
        scenario=s,
        traits=("curved", "several"),
    )


def lorenz(s: Any = LORENZ, agents: int | None = None) -> Problem:
    """Lorenz's convection on a path of three agents that see a component each."""
    agents = agents or s["agents"]
    model = models.lorenz63(sigma=s["sigma"], step=s["longest_step"])
    eyes = [sensors.component([k % 3], std=s["reading_std"]) for k in range(agents)]
    prior = s["first"], s["prior_std"] ** 2 * np.eye(3)
    return Problem(
        "lorenz",
        model,
        eyes,
        graphs.path(agents),
        prior,
        clock(s),
        s["burn"],
        ("x", "y", "z"),
        scenario=s,
        traits=("chaotic",),
    )


def places(s: Any = PLACES, agents: int | None = None) -> Problem:
    """Agents that doubt where they stand see where a target is from there."""
    agents = agents or s["agents"]
    model, whole = (egos_and_target(s, n) for n in (1, agents))
    eyes = [from_there(s, agent, agents) for agent in range(agents)]
    own = Problem(
        "places",
        model[0],
        [from_there(s, 0, 1)] * agents,
        graphs.ring(agents),
        (np.zeros(6), model[1]),
        clock(s),
        s["burn"],
        ("x", "y", "u", "v"),
    )
    return Problem(
        "places",
        whole[0],
        eyes,
        graphs.ring(agents),
        (np.zeros(len(whole[1])), whole[1]),
        clock(s),
        s["burn"],
        ("x", "y", "u", "v"),
        own=own,
        scenario=s,
        traits=("doubted",),
    )


def egos_and_target(s: Any, agents: int) -> tuple[Any, Array]:
    """Model and first covariance of [target; egos]; egos stand still."""
    walk = models.constant_velocity(sigma=s["sigma"])
    n = 4 + 2 * agents

    def move(dt: float) -> Array:
        out = np.eye(n)
        out[:4, :4] = walk.F(dt)
        return out

    def noise(t: float, dt: float) -> Array:
        out = np.zeros((n, n))
        out[:4, :4] = walk.Q(t, dt)
        return out

    names = ("x", "y", "u", "v", *(f"{c}{k}" for k in range(agents) for c in "xy"))
    model = models.LinearModel.from_transition(n, move, noise, names=names)
    stds = [*s["prior_std"], *[s["ego_std"]] * (2 * agents)]
    return model, np.diag(np.square(stds))


def from_there(s: Any, agent: int, agents: int) -> Any:
    """A sensor of the target's place as seen from an agent's own."""
    h = np.zeros((2, 4 + 2 * agents))
    h[:, :2] = np.eye(2)
    h[:, 4 + 2 * agent : 6 + 2 * agent] = -np.eye(2)
    return sensors.Sensor(
        2, lambda x: x @ h.T, s["reading_std"] ** 2 * np.eye(2), linear=lambda d: h
    )


def star(s: Any = HELD, agents: int | None = None) -> Problem:
    """Held out: a walk of three components, one of which each agent on a star sees."""
    agents = agents or s["star_agents"]
    q = s["star_step_std"] ** 2
    model = models.LinearModel.from_transition(
        3, lambda dt: np.eye(3), lambda t, dt: q * dt * np.eye(3), names=("x", "y", "z")
    )
    eyes = [sensors.component([k % 3], std=s["reading_std"]) for k in range(agents)]
    return Problem(
        "star",
        model,
        eyes,
        graphs.star(agents),
        (np.zeros(3), 4 * np.eye(3)),
        clock(s),
        s["burn"],
        ("x", "y", "z"),
        scenario=s,
    )


def angles(s: Any = HELD, agents: int | None = None) -> Problem:
    """Held out: a walker that agents along a road see in directions; all can talk to all."""
    agents = agents or s["road_agents"]
    model = replace(
        models.constant_velocity(sigma=s["road_sigma"]), names=("x", "y", "u", "v")
    )
    at = np.stack([np.linspace(-6, 6, agents), np.full(agents, -8.0)], axis=-1)
    eyes = [
        sensors.bearing((0, 1), std=s["angle_std"], origin=o) for o in at
    ]
    prior = np.zeros(4), np.diag([4.0, 4.0, 0.25, 0.25])
    return Problem(
        "angles",
        model,
        eyes,
        graphs.complete(agents),
        prior,
        clock(s),
        s["burn"],
        ("x", "y", "u", "v"),
        scenario=s,
        traits=("curved",),
    )


def mirror(s: Any = HELD, agents: int | None = None) -> Problem:
    """Held out: ranges from a line, on one side of which the target is likelier to be."""
    agents = agents or s["line_agents"]
    q = s["line_step_std"] ** 2
    model = models.LinearModel.from_transition(
        2, lambda dt: np.eye(2), lambda t, dt: q * dt * np.eye(2), names=("x", "y")
    )
    at = np.stack([np.linspace(-5, 5, agents), np.zeros(agents)], axis=-1)
    eyes = [sensors.distance([0, 1], std=s["range_std"], origin=o) for o in at]
    return Problem(
        "mirror",
        model,
        eyes,
        graphs.path(agents),
        (np.array([0.0, 1.0]), 4 * np.eye(2)),
        clock(s),
        s["burn"],
        ("x", "y"),
        scenario=s,
        traits=("curved", "several"),
    )


MAKERS = {
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
    """One of the four."""
    return MAKERS[name]()


# --------------------------------------------------------------------------- families of our own


class PassedOn:
    """Before it filters, every agent passes on what it hears.

    A reading goes over a link once in each direction at most, with
    the number of whose it is, until all have all readings.
    """

    def next_state(self, step: Any) -> Any:
        """Flood, then go on as the family does."""
        if step.channel is not None:
            step.observations = flooded(step.observations, step.channel, step.t)
        return super().next_state(step)  # type: ignore[misc]


def flooded(
    said: list[list[Observation]], channel: Any, t: float
) -> list[list[Observation]]:
    """Everybody's reading for everybody, of agents that have one reading at most."""
    known = [{r.agent: r for r in own} for own in said]
    news = [dict(own) for own in known]
    while any(news):
        told = []
        for some in news:
            values = [r.value for r in some.values()]
            whose = [
                np.full((*v.shape[:-1], 1), k)
                for k, v in zip(some, values, strict=True)
            ]
            told.append(tuple(values + whose) if some else None)
        news = [{} for _ in known]
        for agent, box in enumerate(channel.broadcast(told)):
            for payload in box.values():
                half = len(payload) // 2
                for value, name in zip(payload[:half], payload[half:], strict=True):
                    whose = int(name.flat[0])
                    if whose not in known[agent]:
                        news[agent][whose] = Observation.construct(t, whose, value)
        for own, new in zip(known, news, strict=True):
            own.update(new)
    return [[own[k] for k in sorted(own)] for own in known]


class FloodedGaussian(PassedOn, GaussianFilter):
    """Kalman filters with everybody's readings."""


class FloodedEnsemble(PassedOn, EnsembleFilter):
    """Ensembles with everybody's readings."""


class FloodedParticles(PassedOn, ParticleFilter):
    """Particles with everybody's readings."""


@dataclass(frozen=True, eq=False)
class MeasurementConsensus(GaussianFilter):
    """Agents agree on the average of what their readings say, HᵀR⁻¹H and HᵀR⁻¹z, times A."""

    _: KW_ONLY
    agree: Callable[..., Array] = network.finite_time_consensus
    share_observations: bool = False

    def next_state(self, step: Any) -> Any:
        """Forecast, linearise the own reading, agree, add the information."""
        t = step.state.t
        dt = step.dt
        d = self.model.dim
        slope = self.model.jacobian(step.state.means, t, dt)
        m = self.model.step(step.state.means, t, dt)
        P = slope @ step.state.covariances @ slope.mT + self.model.Q(t, dt)
        P = self.inflation**2 * P
        said = np.zeros((*m.shape[:-1], d, d + 1))
        for _, heard in step.received():
            a = heard.agents
            H = heard.jacobian(m[..., a, :])
            at = m[..., a, :, None]
            gap = heard.target - heard.predict(m[..., a, None, :])[..., 0, :]
            W = H.mT @ np.linalg.inv(heard.noise)
            z = gap[..., None] + H @ at
            said[..., a, :, :] = W @ np.concatenate([H, z], axis=-1)
        rows, columns = np.triu_indices(d, 0, d + 1)
        flat = np.ascontiguousarray(said[..., rows, columns])
        flat = self.n_agents * self.agree(flat, step.channel)
        said[..., rows, columns] = flat
        J = np.triu(said[..., :d]) + np.triu(said[..., :d], 1).mT
        P = P @ np.linalg.inv(np.eye(d) + J @ P)
        m = m + (P @ (said[..., d:] - J @ m[..., None]))[..., 0]
        P = 0.5 * (P + P.mT)
        return step.end(joint_means=m, joint_covariances=P, dim=d, history=())


class OnePlan(filters.TransportFilter):
    """Where agents' members and weights are alike, the plan of one is that of all."""

    def _transported(self, stack: Any, logs: Array, rng: Any) -> Any:
        """The coupling of the first agent, for all."""
        first = [x[..., :1, :, :] for x in stack]
        same = all(
            np.array_equal(x, np.broadcast_to(y, x.shape))
            for x, y in zip(stack, first, strict=True)
        )
        if not same or not np.allclose(logs, logs[..., :1, :], rtol=1e-9, atol=1e-9):
            return super()._transported(stack, logs, rng)
        one = filters.TransportFilter(
            self.model,
            self.sensors[:1],
            members=self.members,
            correct=self.correct,
            rejuvenation=self.rejuvenation,
        )
        moved, errors = one._transported(first, logs[..., :1, :], rng)
        return [np.repeat(x, self.n_agents, axis=-3) for x in moved], errors


@dataclass(frozen=True, eq=False)
class OwnState(GaussianFilter):
    """Each agent filters [target; own place], and tells of the target's `size` components.

    With `news` it tells what its reading taught, as two readings of unit noise; without, its whole
    belief of the target, and all it has and hears is fused with equal weights. The same as a
    `InformationIncrementFilter`, and as a `MixtureFilter` of one mixand, for many runs at once.
    """

    _: KW_ONLY
    size: int = 4
    news: bool = True
    share_observations: bool = False

    def next_state(self, step: Any) -> Any:
        """Forecast, take the own reading, tell, learn."""
        t = step.state.t
        dt = step.dt
        n = self.size
        d = self.model.dim
        F = self.model.jacobian(step.state.means, t, dt)
        m = self.model.step(step.state.means, t, dt)
        P = self.inflation**2 * (
            F @ step.state.covariances @ F.mT + self.model.Q(t, dt)
        )
        before = information(m, P, n)
        for _, heard in step.received():
            H = heard.jacobian(m)
            gain = P @ H.mT @ np.linalg.inv(H @ P @ H.mT + heard.noise)
            gap = heard.target - heard.predict(m[..., None, :])[..., 0, :]
            m = m + (gain @ gap[..., None])[..., 0]
            P = P - gain @ H @ P
        after = information(m, P, n)
        told = packed_news(before, after) if self.news else upper(after)
        inbox = step.channel.broadcast([told[..., k, :] for k in range(self.n_agents)])
        J = np.zeros((*m.shape[:-1], d, d))
        v = np.zeros_like(m)
        for k, box in enumerate(inbox):
            said = [unpacked(x, n, news=self.news) for x in box.values()]
            if not self.news:
                own = after[0][..., k, :, :], after[1][..., k, :]
                w = 1 / (len(said) + 1)
                said = [(w * a, w * b) for a, b in said]
                said.append(((w - 1) * own[0], (w - 1) * own[1]))
            J[..., k, :n, :n] = sum(a for a, _ in said)
            v[..., k, :n] = sum(b for _, b in said)
        P = P @ np.linalg.inv(np.eye(d) + J @ P)
        m = m + (P @ (v[..., None] - J @ m[..., None]))[..., 0]
        P = 0.5 * (P + P.mT)
        return step.end(joint_means=m, joint_covariances=P, dim=d, history=())


def information(mean: Array, cov: Array, n: int) -> tuple[Array, Array]:
    """Information matrix and vector of the first n components."""
    matrix = np.linalg.inv(cov[..., :n, :n])
    return matrix, (matrix @ mean[..., :n, None])[..., 0]


def upper(belief: tuple[Array, Array]) -> Array:
    """What is sent of a symmetric matrix and a vector."""
    rows, columns = np.triu_indices(belief[0].shape[-1])
    return np.concatenate([belief[0][..., rows, columns], belief[1]], axis=-1)


def packed_news(
    before: tuple[Array, Array], after: tuple[Array, Array], rank: int = 2
) -> Array:
    """A gain in information as `rank` readings of unit noise, zero below the diagonal."""
    sizes, axes = np.linalg.eigh(after[0] - before[0])
    H = np.sqrt(sizes[..., -rank:, None]) * axes[..., -rank:].mT
    z = np.linalg.solve(H @ H.mT, H @ (after[1] - before[1])[..., None])
    turn, H = np.linalg.qr(H)
    rows, columns = np.triu_indices(rank, 0, H.shape[-1])
    return np.concatenate([H[..., rows, columns], (turn.mT @ z)[..., 0]], axis=-1)


def unpacked(
    numbers: Array, n: int, *, news: bool, rank: int = 2
) -> tuple[Array, Array]:
    """Information matrix and vector of what was sent."""
    rows = np.triu_indices(rank if news else n, 0, n)
    H = np.zeros((*numbers.shape[:-1], rank if news else n, n))
    H[..., rows[0], rows[1]] = numbers[..., : rows[0].size]
    rest = numbers[..., rows[0].size :]
    if news:
        return H.mT @ H, (H.mT @ rest[..., None])[..., 0]
    return H + np.triu(H, 1).mT, rest


@dataclass(frozen=True, eq=False)
class LikelihoodConsensus(ParticleFilter):
    """Agents hold the same particles and agree on polynomials that stand for log-likelihoods.

    All draw from one seed. Each fits its own log-likelihood by polynomials that are orthonormal on
    the common particles, and they agree on the coefficients' average.
    """

    _: KW_ONLY
    agree: Callable[..., Array] = network.finite_time_consensus
    degree: int = 2
    places: tuple[int, ...] = (0, 1)
    share_observations: bool = False

    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """The same particles for all."""
        points = np.repeat(
            self.draw_prior(prior, (*runs, 1), rng), self.n_agents, axis=-3
        )
        return {
            "particles": points,
            "log_weights": np.full(points.shape[:-1], -np.log(self.members)),
        }

    def next_state(self, step: Any) -> Any:
        """Resample and move alike, agree on likelihoods, weigh."""
        from distfilt.updates.particles import log_likelihood

        x = step.state.particles[..., 0, :, :]
        w = step.state.weights.mean(axis=-2)
        x = np.take_along_axis(x, resample(w, rng=step.rng)[..., None], axis=-2)
        if self.jitter:
            spread = x.std(axis=-2, keepdims=True)
            x = x + self.jitter * spread * step.rng.standard_normal(x.shape)
        x = self.model.sample_step(x, step.state.t, step.dt, rng=step.rng)
        points = np.repeat(x[..., None, :, :], self.n_agents, axis=-3)
        logs = np.zeros(points.shape[:-1])
        for _, heard in step.received():
            a = heard.agents
            seen = heard.predict(points[..., a, :, :])
            logs[..., a, :] = log_likelihood(seen, heard.target, heard.noise)
        basis = polynomials(x[..., list(self.places)], self.degree)
        found = (logs[..., None, :] @ basis[..., None, :, :])[..., 0, :]
        found = self.n_agents * self.agree(found, step.channel)
        logs = (basis[..., None, :, :] @ found[..., None])[..., 0]
        logs = logs - logs.max(axis=-1, keepdims=True)
        logs = np.maximum(
            logs - np.log(np.exp(logs).sum(axis=-1, keepdims=True)), -1e300
        )
        return step.end(particles=points, log_weights=logs, past=())


def polynomials(x: Array, degree: int) -> Array:
    """Polynomials up to a degree, orthonormal on points (..., N, k), but for the constant."""
    u = (x - x.mean(axis=-2, keepdims=True)) / x.std(axis=-2, keepdims=True)
    powers = [p for p in np.ndindex(*[degree + 1] * x.shape[-1]) if sum(p) <= degree]
    columns = [
        np.prod([u[..., k] ** e for k, e in enumerate(p)], axis=0) for p in powers
    ]
    return np.linalg.qr(np.stack(columns, axis=-1))[0][..., 1:]


@dataclass(frozen=True, eq=False, repr=False)
class GridState(filters.SensorState):
    """Logarithms of the chances of cells."""

    logs: Array
    belief_field = "logs", (..., "A", "cells")


@dataclass(frozen=True, eq=False)
class GridFilter(filters.Filter):
    """Beliefs on the cells of a square, which is exact but for the cells' size; for `ranges`.

    Readings have errors that are independent of each other. An agreement is one of vectors: of the
    agents' log-beliefs, whose average is the geometric mean, or with `likelihoods` of what their
    readings say, which is then multiplied by A.
    """

    _: KW_ONLY
    cells: int = 40
    half: float = 9.0
    likelihoods: bool = False

    state_class = GridState
    belief_kind = "vectors"
    unsupported = {"lag": "a grid keeps no past"}

    @property
    def centres(self) -> Array:
        """Where the cells are, (n, 2)."""
        return centres_of(self.cells, self.half)

    def initial_state(
        self, prior: Any, runs: tuple[int, ...], rng: Any
    ) -> dict[str, Any]:
        """The prior's logarithm at the cells."""
        mean, cov = prior
        gap = self.centres - mean
        logs = -0.5 * (gap * np.linalg.solve(cov, gap.T).T).sum(axis=-1)
        return {"logs": np.broadcast_to(logs, (*runs, self.n_agents, logs.size))}

    def next_state(self, step: Any) -> Any:
        """Spread the chances, weigh them by what was heard, agree."""
        old = step.state.logs
        chances = np.exp(old - old.max(axis=-1, keepdims=True))
        moved = (
            spread_of(self.cells, self.half, self.model, step.dt)
            @ chances.reshape(-1, old.shape[-1]).T
        )
        with np.errstate(divide="ignore"):
            logs = np.maximum(np.log(moved.T.reshape(old.shape)), -700.0)
        said = np.zeros_like(logs)
        for _, heard in step.received():
            a = heard.agents
            seen = heard.predict(
                np.broadcast_to(self.centres, (*said[..., a, :].shape, 2))
            )
            gap = np.nan_to_num(heard.target[..., None, :] - seen) ** 2
            # (M,), or (G, M) of agents whose readings have errors of their own.
            variance = np.diagonal(heard.noise, axis1=-2, axis2=-1)
            if np.count_nonzero(heard.noise) > np.count_nonzero(variance):
                raise ValueError(
                    "sensors must be independent errors for a grid, got correlated"
                )
            said[..., a, :] = -0.5 * (gap / variance[..., None, :]).sum(axis=-1)
        if self.likelihoods:
            (said,) = step.fuse(said)
            return step.end(logs=logs + self.n_agents * said)
        logs = logs + said
        logs = logs - logs.max(axis=-1, keepdims=True)
        (logs,) = step.fuse(np.maximum(logs, -700.0))
        return step.end(logs=logs)

    def summarize(self, state: Any) -> Any:
        """Means and covariances of the cells' chances."""
        w = np.exp(state.logs - state.logs.max(axis=-1, keepdims=True))
        w = w / w.sum(axis=-1, keepdims=True)
        x = self.centres
        mean = w @ x
        second = np.stack(
            [w @ (x[:, i] * x[:, j]) for i in (0, 1) for j in (0, 1)], axis=-1
        )
        cov = second.reshape(*mean.shape, 2) - mean[..., :, None] * mean[..., None, :]
        # A belief is no narrower than a cell.
        least = (2 * self.half / self.cells) ** 2 / 12
        i = np.arange(2)
        cov[..., i, i] = np.maximum(cov[..., i, i], least)
        return filters.Summary(mean, np.diagonal(cov, axis1=-2, axis2=-1), cov)


class FloodedGrid(PassedOn, GridFilter):
    """Grids with everybody's readings."""


@cache
def spread_of(cells: int, half: float, model: Any, dt: float) -> Any:
    """The sparse matrix that moves the chances of cells by one step of a linear model."""
    from scipy.sparse import csr_array
    from scipy.spatial import KDTree

    x = centres_of(cells, half)
    std = float(np.sqrt(model.Q(0.0, dt)[0, 0]))
    near = KDTree(x).sparse_distance_matrix(
        KDTree(x @ model.F(dt).T), 5 * std, output_type="coo_matrix"
    )
    kernel = csr_array(
        (np.exp(-0.5 * (near.data / std) ** 2), (near.row, near.col)), near.shape
    )
    total = np.asarray(kernel.sum(axis=0))
    return csr_array(kernel / np.where(total > 0, total, 1.0))


def centres_of(cells: int, half: float) -> Array:
    """Where the cells of a square are, (n, 2)."""
    line = (np.arange(cells) + 0.5) * (2 * half / cells) - half
    return np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)


# ------------------------------------------------------------------------------------------ cells


@dataclass(frozen=True)
class Cell:
    """A filter with a rule of talking; `make(problem, value)` builds it with its tuned number."""

    family: str
    talk: str
    make: Callable[[Problem, float], Any]
    option: str = ""
    grid: tuple[float, ...] = ()
    own: bool = False
    empty: tuple[tuple[str, str], ...] = ()

    def why_empty(self, name: str) -> str:
        """The reason why there is no such filter for a problem, or ''."""
        return dict(self.empty).get(name, "")


CI = partial(covariance_intersection, rule="min_determinant")
TRACE = partial(covariance_intersection, rule="trace")
# Below one is for those that claim too little, such as intersection.
WIDER = ("inflation", (0.9, 1.0, 1.05, 1.15, 1.3))
JITTER = ("jitter", (0.0, 0.05, 0.1, 0.2, 0.4))
SEPARABLE = partial(
    transport_map_update, fit=partial(separable.fit, order=1, regularisation=0.05)
)


def gaussian(
    kind: Any = GaussianFilter, *, rule: str = "extended", **options: Any
) -> Any:
    """A maker of Kalman filters."""

    def make(p: Problem, value: float) -> Any:
        return kind(
            p.model,
            p.sensors,
            p.graph,
            linearization=rule,
            inflation=value,
            on_error="keep",
            **options,
        )

    return make


def ensemble(update: Any, kind: Any = EnsembleFilter, **options: Any) -> Any:
    """A maker of ensemble filters."""

    def make(p: Problem, value: float, members: int = STUDY["members"]) -> Any:
        wider = with_inflation(update, factor=value)
        return kind(
            p.model,
            p.sensors,
            p.graph,
            update=wider,
            members=members,
            on_error="keep",
            **options,
        )

    return make


def exact(p: Problem, value: float, members: int = STUDY["members"]) -> Any:
    """Exact draws and the intersection of least determinant."""
    update = with_inflation(enkf_exact, factor=value)
    return EnsembleFilter.exact(
        p.model, p.sensors, p.graph, update=update, members=members, on_error="keep"
    )


def pulled(p: Problem, value: float, members: int = STUDY["members"]) -> Any:
    """Means that pull each other."""
    rule = partial(network.mean_pull, gain=value, include_self=False)
    return EnsembleFilter(
        p.model, p.sensors, p.graph, fusion=rule, members=members, on_error="keep"
    )


def particles(kind: Any = ParticleFilter, **options: Any) -> Any:
    """A maker of particle filters."""

    def make(p: Problem, value: float, members: int = STUDY["particles"]) -> Any:
        return kind(
            p.model,
            p.sensors,
            p.graph,
            jitter=value,
            members=members,
            on_error="keep",
            **options,
        )

    return make


def intersected(ensembles: Array, channel: Any) -> Array:
    """Intersection of clouds, which resampling may have left without any width."""
    least = 0.01 * np.random.default_rng(0).standard_normal(ensembles.shape[-2:])
    return network.intersect_ensembles(ensembles + least, channel)


def agreed_particles(
    p: Problem, value: float, members: int = STUDY["particles"]
) -> Any:
    """Particles in common and likelihoods agreed on."""
    degree = 4 if "curved" in p.traits else 2
    seen = tuple(range(2 if len(p.scored) == 4 else len(p.scored)))
    return LikelihoodConsensus(
        p.model,
        p.sensors,
        p.graph,
        jitter=value,
        members=members,
        degree=degree,
        places=seen,
    )


def moved(**options: Any) -> Any:
    """A maker of transport filters."""

    def make(p: Problem, value: float, members: int = STUDY["transported"]) -> Any:
        own = options | ({"rejuvenation": value} if value else {})
        return OnePlan(
            p.model, p.sensors, p.graph, members=members, on_error="keep", **own
        )

    return make


def mixture(rule: str) -> Any:
    """A maker of mixtures with a rule for the fused weights."""

    def make(p: Problem, value: float) -> Any:
        own = p.own or p
        return Mixtures(
            own.model,
            own.sensors,
            p.graph,
            size=len(p.scored),
            rule=rule,
            mixands=STUDY["mixands"],
            stretch=STUDY["stretch"],
            inflation=value,
        )

    return make


def of_target(news: bool) -> Any:
    """A maker of filters of [target; own place]."""

    def make(p: Problem, value: float) -> Any:
        return OwnState(
            p.own.model,
            p.own.sensors,
            p.graph,
            news=news,
            inflation=value,
            on_error="keep",
        )

    return make


def gridded(kind: Any = GridFilter, **options: Any) -> Any:
    """A maker of grids."""
    return lambda p, value: kind(p.model, p.sensors, p.graph, **options)


WIDE = "16 components: "
JOINT = (
    ("places", WIDE + "polynomials of degree 2 have 152 terms, and a cloud collapses"),
)
CLOUD = (("places", WIDE + "the weights of a cloud collapse"),)
AFFINE = "the best map is affine: an ensemble with perturbed readings"
MANY = WIDE + "a map has more coefficients than members"
MAPS = (("linear", AFFINE), ("star", AFFINE), ("places", MANY))
SAME = "the gain of a reading is the reading: readings, one hop"
NO_PLACE = tuple(
    (name, "no agent doubts its place")
    for name in ("linear", "range", "lorenz", *THREE)
)
AS_READING = tuple((name, SAME) for name in ("linear", "range", "lorenz", *THREE))
CELLS_OF = "{} components need 40 to the power of {} cells"
SIZES = {"linear": 4, "lorenz": 3, "places": 16, "star": 3, "angles": 4}
PLANE = tuple((name, CELLS_OF.format(d, d)) for name, d in SIZES.items())
CELLS = {
    "ekf_alone": Cell("Kalman, extended", "nothing", gaussian(share_observations=False), *WIDER),
    "ekf_near": Cell("Kalman, extended", "readings, one hop", gaussian(), *WIDER),
    "ekf_naive": Cell(
        "Kalman, extended",
        "beliefs, multiplied",
        gaussian(share_observations=False, fusion=network.naive_fusion),
        *WIDER,
    ),
    "ekf_trace": Cell(
        "Kalman, extended", "readings, CI by trace", gaussian(fusion=TRACE), *WIDER
    ),
    "ekf_ci": Cell(
        "Kalman, extended",
        "readings, CI by determinant",
        gaussian(fusion=CI),
        *WIDER,
    ),
    "ekf_info": Cell(
        "Kalman, extended",
        "beliefs, four rounds of equal CI",
        gaussian(share_observations=False, fusion=partial(covariance_intersection, rounds=4)),
        *WIDER,
    ),
    "ekf_two": Cell(
        "Kalman, extended",
        "information, two rounds",
        gaussian(
            MeasurementConsensus, agree=partial(network.average_consensus, rounds=2)
        ),
        *WIDER,
    ),
    "ekf_meas": Cell(
        "Kalman, extended",
        "information, exact average",
        gaussian(MeasurementConsensus),
        *WIDER,
    ),
    "ekf_flood": Cell(
        "Kalman, extended",
        "readings, passed on",
        gaussian(FloodedGaussian, share_observations=False),
        *WIDER,
    ),
    "ukf_ci": Cell(
        "Kalman, unscented",
        "readings, CI by determinant",
        gaussian(rule="unscented", fusion=CI),
        *WIDER,
    ),
    "ukf_flood": Cell(
        "Kalman, unscented",
        "readings, passed on",
        gaussian(FloodedGaussian, rule="unscented", share_observations=False),
        *WIDER,
    ),
    "news": Cell(
        "news",
        "gain in information, one hop",
        of_target(news=True),
        *WIDER,
        own=True,
        empty=AS_READING,
    ),
    "own_ci": Cell(
        "Kalman of target and own place",
        "beliefs of the target, equal CI",
        of_target(news=False),
        *WIDER,
        own=True,
        empty=NO_PLACE,
    ),
    "enkf_near": Cell(
        "ensemble, perturbed",
        "readings, one hop",
        ensemble(enkf_sampled_covariance),
        *WIDER,
    ),
    "known_near": Cell(
        "ensemble, known noise", "readings, one hop", ensemble(enkf), *WIDER
    ),
    "known_pull": Cell(
        "ensemble, known noise",
        "readings, mean pull",
        pulled,
        "gain",
        (0.025, 0.05, 0.1, 0.2, 0.4),
    ),
    "known_flood": Cell(
        "ensemble, known noise",
        "readings, passed on",
        ensemble(enkf, FloodedEnsemble, share_observations=False),
        *WIDER,
    ),
    "exact_ci": Cell(
        "ensemble, exact draws", "readings, CI by determinant", exact, *WIDER
    ),
    "root_ci": Cell(
        "ensemble, square root",
        "readings, CI by determinant",
        ensemble(etkf, fusion=network.intersect_ensembles),
        *WIDER,
    ),
    "root_flood": Cell(
        "ensemble, square root",
        "readings, passed on",
        ensemble(etkf, FloodedEnsemble, share_observations=False),
        *WIDER,
    ),
    "maps_near": Cell(
        "ensemble, separable maps",
        "readings, one hop",
        ensemble(SEPARABLE),
        *WIDER,
        empty=MAPS,
    ),
    "maps_flood": Cell(
        "ensemble, separable maps",
        "readings, passed on",
        ensemble(SEPARABLE, FloodedEnsemble, share_observations=False),
        *WIDER,
        empty=MAPS,
    ),
    "pf_alone": Cell(
        "particles", "nothing", particles(share_observations=False), *JITTER, empty=CLOUD
    ),
    "pf_near": Cell(
        "particles", "readings, one hop", particles(), *JITTER, empty=CLOUD
    ),
    "pf_ci": Cell(
        "particles",
        "readings, CI by determinant",
        particles(fusion=intersected),
        *JITTER,
        empty=CLOUD,
    ),
    "pf_agreed": Cell(
        "particles", "likelihood consensus", agreed_particles, *JITTER, empty=JOINT
    ),
    "pf_flood": Cell(
        "particles",
        "readings, passed on",
        particles(FloodedParticles, share_observations=False),
        *JITTER,
        empty=CLOUD,
    ),
    "ot_plain": Cell(
        "transport, plain", "log-likelihoods, exact average", moved(), empty=CLOUD
    ),
    "ot_right": Cell(
        "transport, corrected",
        "log-likelihoods, exact average",
        moved(correct=True),
        empty=CLOUD,
    ),
    "ot_young": Cell(
        "transport, rejuvenated",
        "log-likelihoods, exact average",
        moved(),
        "rejuvenation",
        (0.05, 0.1, 0.2, 0.4, 0.8),
        empty=CLOUD,
    ),
    "gm_c1": Cell(
        "mixture, C1", "beliefs, partial fusion", mixture("C1"), *WIDER, own=True
    ),
    "gm_c2": Cell(
        "mixture, C2", "beliefs, partial fusion", mixture("C2"), *WIDER, own=True
    ),
    "gm_c3": Cell(
        "mixture, C3", "beliefs, partial fusion", mixture("C3"), *WIDER, own=True
    ),
    "grid_near": Cell("density on a grid", "readings, one hop", gridded(), empty=PLANE),
    "grid_mean": Cell(
        "density on a grid",
        "beliefs, geometric mean",
        gridded(share_observations=False, fusion=network.average_consensus),
        empty=PLANE,
    ),
    "grid_flood": Cell(
        "density on a grid",
        "readings, passed on",
        gridded(FloodedGrid, share_observations=False),
        empty=PLANE,
    ),
}


# --------------------------------------------------------------------------------------- the loop


def stream(seed: np.random.SeedSequence, name: str) -> np.random.Generator:
    """A generator that belongs to a name, whatever else the seed serves."""
    key = (*seed.spawn_key, zlib.crc32(name.encode()))
    return np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=key))


def scored(
    p: Problem,
    f: Any,
    data: Any,
    rng: Any,
    *,
    alone: bool = False,
    own: bool = False,
    scores: tuple[str, ...] = ("squared_error", "nees"),
) -> dict[str, Any]:
    """The one loop: a filter runs on the data; each run's scores, and what an agent sent a step.

    ``error`` is the mean squared error of the components that count, ``nees`` that per component,
    ``crps`` as it says; means over agents and over the times after the burn.
    """
    truth, seen = data
    runs = truth.shape[1]
    prior = p.own.prior if own and p.own else p.prior
    known = p.known(truth)
    late = {"time": slice(p.burn, None)}
    out: dict[str, list[Array]] = {name: [] for name in ("error", "nees", "crps")}
    batches: Iterable[Any] = range(runs) if alone else [slice(None)]
    for part in batches:
        state = f.start(
            prior, rng=rng if f.requires_rng else None, runs=() if alone else (runs,)
        )
        run = f.run(
            state,
            p.times,
            [y[:, part] for y in seen],
            truth={k: v[:, part] for k, v in known.items()},
            scores=scores,
        )
        # A run that failed once, at one agent, has no mean.
        here = run.isel(late).mean(("time", "agent"), skipna=False)
        some = here.sel(component=list(p.scored))
        if "squared_error" in here:
            out["error"].append(some["squared_error"].sum("component").values)
        if "nees" in here:
            out["nees"].append(here["nees"].values / len(p.scored))
        if "crps" in here:
            out["crps"].append(some["crps"].sum("component").values)
    found = {name: np.ravel(values) for name, values in out.items() if values}
    sent = run["scalars_total"].values[-1].sum() / p.agents / len(p.times)
    return found | {"floats": float(sent)}


def log_scores(p: Problem, f: Any, data: Any, rng: Any, *, own: bool = False) -> Array:
    """Minus the log-density of the truth, by each run's means and covariances; for tuning.

    Means over agents and over the times after the burn, of the components that count; infinite
    where a filter fails or a cloud has no width.
    """
    truth, seen = data
    state = f.start(
        p.own.prior if own and p.own else p.prior,
        runs=truth.shape[1:2],
        rng=rng if f.requires_rng else None,
    )
    at = [list(f.model.names).index(name) for name in p.scored]
    known = np.stack(list(p.known(truth).values()), axis=-1)
    out = []
    for k, now in enumerate(f.steps(state, p.times, seen)):
        if k < p.burn:
            continue
        said = f.summarize(now)
        cov = said.covariance
        if cov is None:
            cov = sample_covariance(said.members)
        mean = said.mean[..., at]
        cov = cov[..., at, :][..., at]
        there = np.broadcast_to(known[k][:, None], mean.shape)
        good = np.isfinite(mean).all(axis=-1) & np.isfinite(cov).all(axis=(-2, -1))
        std = np.sqrt(
            np.where(good[..., None], np.diagonal(cov, axis1=-2, axis2=-1), 1.0)
        )
        good &= (std > 0).all(axis=-1)
        shape = cov[good] / (std[good][:, :, None] * std[good][:, None, :])
        good[good] = np.linalg.eigvalsh(shape)[:, 0] > 1e-12
        found = np.full(good.shape, np.inf)
        found[good] = metrics.log_score(mean[good], cov[good], there[good])
        out.append(found.mean(axis=-1))
    return np.mean(out, axis=0)


@cache
def tuned(name: str, cell: str) -> float:
    """A cell's tuned number for a problem; for one held out the upper median of the four's."""
    found = {row["name"]: row["value"] for row in TUNED.tables.get("tuned", ())}
    if name in THREE:
        known = [
            tuned(other, cell) for other in FOUR if not CELLS[cell].why_empty(other)
        ]
        return sorted(known)[len(known) // 2] if known else 0.0
    return float(
        found.get(f"{name}_{cell}", 1.0 if CELLS[cell].option == "inflation" else 0.0)
    )


def measured(
    p: Problem, cell: str, f: Any, data: Any, seed: Any, prefix: str = ""
) -> dict:
    """A filter's errors and NEES run by run, and its floats, as columns; NaN where it fails."""
    name = prefix + cell
    own = cell in CELLS and CELLS[cell].own
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = scored(p, f, data, stream(seed, name), own=own)
        except (ValueError, ArithmeticError, RuntimeError) as error:
            print(f"{p.name}, {name}: {error}", file=sys.stderr)
            lost = np.full(data[0].shape[1], np.nan)
            found = {"error": lost, "nees": lost, "floats": np.nan}
    out = {f"{name}_floats": found["floats"]}
    for k in ("error", "nees"):
        out |= {f"{name}_{k}_{r}": v for r, v in enumerate(found[k])}
    # Six digits are enough to store.
    return {k: float(f"{v:.6g}") for k, v in out.items()}


def columns_of(names: Iterable[str], runs: int = BATCH) -> list[str]:
    """The columns of some cells."""
    each = [f"{k}_{r}" for k in ("error", "nees") for r in range(runs)]
    return [f"{name}_{k}" for name in names for k in ("floats", *each)]


def cells_of(name: str) -> list[str]:
    """The cells that a problem has."""
    return [c for c, cell in CELLS.items() if not cell.why_empty(name)]


def references(p: Problem) -> dict[str, Any]:
    """Filters of all readings in one place; ``reference`` is the best of them."""
    all_of = (p.model, [p.together])
    if not {"curved", "chaotic"} & set(p.traits):
        return {"reference": GaussianFilter(*all_of)}
    if p.model.dim == 2:
        return {
            "reference": GridFilter(*all_of, cells=STUDY["reference_cells"]),
            "half": GridFilter(*all_of),
        }
    many = STUDY["reference"]
    return {
        "reference": ParticleFilter(*all_of, members=many),
        "half": ParticleFilter(*all_of, members=many // 2),
    }


def drawn(p: Problem, seed: np.random.SeedSequence, runs: int = BATCH) -> Any:
    """A trial's data."""
    return p.data(runs, stream(seed, "data"))


def referred(
    p: Problem, seed: np.random.SeedSequence, data: Any, *, half: bool = True
) -> dict:
    """The references' columns, if wanted with those of one of half the effort."""
    one = replace(p, sensors=[p.together], graph=None, own=None)
    joint = data[0], [np.concatenate(data[1], axis=-1)]
    out: dict[str, float] = {}
    some = {name: f for name, f in references(p).items() if half or name == "reference"}
    for name, f in some.items():
        out |= measured(one, name, f, joint, seed)
    if "half" in some and p.model.dim == 2:
        # All agents with all readings and one grid are that grid with all readings.
        out |= {
            k.replace("half", "grid_flood"): v for k, v in out.items() if "half" in k
        }
        out["grid_flood_floats"] = np.nan
    return out


def compared(name: str, seed: np.random.SeedSequence, cells: Iterable[str]) -> dict:
    """The columns of some cells of a problem, each with its tuned number, on one trial's data."""
    p = problem(name)
    data = drawn(p, seed)
    out = {}
    for cell in (c for c in cells if c != "grid_flood"):
        out |= measured(p, cell, CELLS[cell].make(p, tuned(name, cell)), data, seed)
    if "ekf_flood_floats" in out and p.model.dim == 2:
        out["grid_flood_floats"] = out["ekf_flood_floats"]
    return out


def trial_of(name: str) -> Callable[[np.random.SeedSequence], dict]:
    """The trial of a problem: references and all cells."""

    def trial(seed: np.random.SeedSequence) -> dict:
        p = problem(name)
        return referred(p, seed, drawn(p, seed)) | compared(name, seed, cells_of(name))

    return trial


def seeds_of(runs: int = STUDY["runs"]) -> list[np.random.SeedSequence]:
    """The seeds of so many runs."""
    return np.random.SeedSequence(STUDY["seed"]).spawn(runs // BATCH)


def loose(names: Iterable[str]) -> list[str]:
    """Columns in which a last bit may decide, as which particle is drawn."""
    apart = ("pf_", "ot_", "maps_", "ekf_", "reference", "half", "gm_")
    return [c for c in columns_of(names) if c.startswith(apart)]


@cache
def program() -> str:
    """A digest of all that stands here and beside, but for comments and docstrings.

    The studies store it: a filter, a cell's options or a problem that is another one is noticed.
    """
    text = ""
    for module in (sys.modules[__name__], _together_mixtures):
        tree = ast.parse(inspect.getsource(module))
        for node in ast.walk(tree):
            parts = vars(node).get("body", [])
            if isinstance(parts, list):
                node.body = [part for part in parts if not is_text(part)]
        text += ast.unparse(tree)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def is_text(node: ast.AST) -> bool:
    """Whether this is a string that stands alone."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
