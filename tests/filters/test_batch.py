"""Random networks, observations and options, against one joint Gaussian of all times."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.linalg import block_diag

from distfilt.ensembles import match_moments
from distfilt.filters import (
    EnsembleFilter,
    GaussianFilter,
    InformationIncrementFilter,
    MixtureFilter,
    Observation,
)
from distfilt.models import LinearModel
from distfilt.network import Graph
from distfilt.sensors import Sensor, component

from .families import NOISE, PRIOR, Q, model

SLANT = np.array([[1.0, 0.5], [0.0, 2.0]])
KINDS = [
    component([0], std=0.6),
    component([1], std=0.5),
    Sensor(2, lambda x: x @ SLANT.T, NOISE, linear=lambda d: SLANT),
]
SCORES = ("log_likelihood", "nis", "n_observed")
FAMILIES: dict[str, Any] = {
    "gaussian": GaussianFilter,
    "unscented": partial(GaussianFilter, linearization="unscented", kappa=0.5),
    "ensemble": partial(EnsembleFilter.exact, members=120, fusion=None),
    "mixture": partial(MixtureFilter, target_dim=2),
    "news": partial(InformationIncrementFilter, target_dim=2),
}


class Law(NamedTuple):
    """The joint Gaussian of the states at all times, and the rows of what was observed of them."""

    mean: np.ndarray
    cov: np.ndarray
    h: np.ndarray
    r: np.ndarray
    y: np.ndarray


def find_law(known: list[Any], times: Any, q: Any, run: Any) -> Law:
    """Stack all times, K of them, and the observations (sensor, observation) of one run."""
    # x = L [x₀, w₁, …, w_K]: the row of x_k is F times that of x_{k-1}, plus w_k.
    lift = np.eye(2 * len(times))
    steps = np.diff(times)
    for k, dt in enumerate(steps, 1):
        now = slice(2 * k, 2 * k + 2)
        before = slice(2 * k - 2, 2 * k)
        lift[now] += model().F(dt) @ lift[before]
    mean = lift[:, :2] @ PRIOR[0]
    # The walk's noise depends on the time at the start of a step.
    rates = 1 + np.asarray(times[:-1])
    noises = [scale * q for scale in steps * rates]
    # P = L diag(P₀, Q₁, …, Q_K) Lᵀ
    cov = lift @ block_diag(PRIOR[1], *noises) @ lift.T
    # One row for each number that arrived, whatever its time
    h = np.zeros((0, len(mean)))
    r = np.zeros((0, 0))
    y = np.zeros(0)
    for sensor, observation in known:
        value = observation.value
        # A value without an axis of runs belongs to all of them.
        if value.ndim > 1:
            value = value[run]
        arrived = ~np.isnan(value)
        # The Kronecker product puts H at the observation's time.
        index = times.tolist().index(observation.t)
        place = np.eye(len(times))[index]
        rows = np.kron(place, sensor.H(2))
        noise = sensor.noise_cov[np.ix_(arrived, arrived)]
        h = np.concatenate([h, rows[arrived]])
        r = block_diag(r, noise)
        y = np.concatenate([y, value[arrived]])
    return Law(mean, cov, h, r, y)


def batch(known: list[Any], times: Any, q: Any, run: Any) -> tuple[Any, Any]:
    """Means (K, 2) and covariances (K, 2, 2) at all times, given the observations of one run."""
    mean, cov, h, r, y = find_law(known, times, q, run)
    # K = P Hᵀ S⁻¹ with S = H P Hᵀ + R
    innovation_cov = h @ cov @ h.T + r
    gain = np.linalg.solve(innovation_cov, h @ cov).T
    mean = mean + gain @ (y - h @ mean)
    cov = cov - gain @ h @ cov
    # The 2 x 2 blocks of the diagonal are the covariances of single times.
    blocks = []
    for k in range(0, len(cov), 2):
        block = slice(k, k + 2)
        blocks.append(cov[block, block])
    return mean.reshape(-1, 2), np.array(blocks)


def score_jointly(known: list[Any], times: Any, q: Any, run: Any) -> np.ndarray:
    """Log p(y), rᵀ S⁻¹ r and the number of all numbers y at once, of one run."""
    mean, cov, h, r, y = find_law(known, times, q, run)
    innovation_cov = h @ cov @ h.T + r
    innovation = y - h @ mean
    nis = innovation @ np.linalg.solve(innovation_cov, innovation)
    _sign, log_volume = np.linalg.slogdet(innovation_cov)
    evidence = -0.5 * (nis + log_volume + y.size * np.log(2 * np.pi))
    return np.array([evidence, nis, y.size])


def price(payload: list[Any], now: float) -> Any:
    """Numbers of a payload: its values, and of each observation time, sensor and metadata."""
    numbers = 0
    for sensor, observation in payload:
        table = observation.value.reshape(-1, sensor.dim)
        # A component that is missing in all runs is not sent.
        is_missing = np.isnan(table).all(axis=0)
        numbers += np.sum(~is_missing)
    # One present value of the agent's only sensor needs no label.
    (sensor, observation), *more = payload
    is_usual = observation.t == now and observation.sensor in (0, sensor)
    if is_usual and not more and not observation.metadata:
        return numbers
    # A label has the time, the sensor's number and the metadata.
    labels = [2 + len(observation.metadata) for _, observation in payload]
    return numbers + sum(labels)


def draw_events(
    rng: Any,
    team: list[list[Sensor]],
    times: np.ndarray,
    runs: tuple[int, ...],
    lag: int,
    several: bool,
) -> list[tuple[float, Sensor, Observation]]:
    """Draw observations of all times, each with its sensor and the step in which it arrives.

    An arrival at k is in the first step to the time k, one at k + 1/2 in a second step to it.
    """
    steps = times.size - 1
    events = []
    for j, a in np.ndindex(steps + 1, len(team)):
        for s, sensor in enumerate(team[a]):
            # A value for all runs, or one for each of them; a fifth of the numbers is missing.
            leading = runs[: rng.integers(2)]
            value = rng.normal(size=(*leading, sensor.dim))
            lost = rng.random(value.shape) < 0.2
            value[lost] = np.nan
            # Half of the observations are late, by up to the lag.
            is_late = several * rng.integers(2)
            k = j + is_late * rng.integers(lag + 1)
            # A sensor of the observation's own travels with its metadata.
            is_private = rng.random() < 0.2
            which = sensor if is_private else s
            metadata = tuple(rng.random(is_private * rng.integers(3)))
            if 0 < k <= steps and not np.isnan(value).all():
                observation = Observation(times[j], a, value, which, metadata=metadata)
                arrival = k + rng.integers(2) / 2
                events.append((arrival, sensor, observation))
    return events


def draw_links(rng: Any, shape: tuple[int, int, int], all_or_none: bool) -> np.ndarray:
    """Draw links (T, A, A): agent i receives from agent j at time k if links[k, i, j]."""
    uniform = rng.random(shape)
    links = uniform < rng.choice([0.3, 0.7])
    if all_or_none:
        # Increments are exact only if all agents exchange them or none does.
        links[:] = rng.random((shape[0], 1, 1)) < 0.5
    return links & ~np.eye(shape[1], dtype=bool)


def find_contacts(times: np.ndarray, links: np.ndarray, every: float) -> np.ndarray:
    """Whether agents exchange observations, at each time (T,)."""
    contact = links.any(axis=(1, 2))
    if every:
        # Contacts are at the first time after each multiple of the interval.
        intervals = np.floor(times / every)
        contact[1:] &= np.diff(intervals) > 0
    return contact


def draw_team(rng: Any, agents: int) -> list[list[Sensor]]:
    """Draw up to two sensors for each agent, which may be of one kind."""
    team = []
    for _ in range(agents):
        kinds = rng.integers(3, size=rng.integers(3))
        team.append([KINDS[k] for k in kinds])
    return team


def check_beliefs(
    views: list[tuple[float, Any]],
    available: list[Any],
    times: np.ndarray,
    q: np.ndarray,
    runs: tuple[int, ...],
) -> None:
    """Compare every agent's beliefs about all times kept with one batch of its observations."""
    for a, *run in np.ndindex(len(available), *runs):
        means, covs = batch(available[a], times, q, tuple(run))
        for t, view in views:
            place = times.tolist().index(t)
            index = (*run, a)
            # An ensemble has members in place of a covariance.
            if view.covariance is None:
                result = np.cov(view.members[index].T)
            else:
                result = view.covariance[index]
            # A linear Gaussian filter that loses nothing has the posterior's exact moments.
            assert np.allclose(view.mean[index], means[place], atol=1e-9)
            assert np.allclose(result, covs[place], atol=1e-9)


def check_scores(
    totals: np.ndarray,
    available: list[Any],
    times: np.ndarray,
    q: np.ndarray,
    runs: tuple[int, ...],
) -> None:
    """Compare the sums of every agent's scores with those of all its observations at once.

    By the chain rule p(y₁, y₂) = p(y₁) p(y₂ | y₁), in whatever order they come, and so for the
    exponents of the densities.
    """
    for a, *run in np.ndindex(len(available), *runs):
        expected = score_jointly(available[a], times, q, tuple(run))
        result = totals[(slice(None), *run, a)]
        assert np.allclose(result, expected, rtol=1e-9, atol=1e-8)


def make_walk(q: np.ndarray) -> LinearModel:
    """Return the model with noise of the covariance dt (1 + t) q."""
    return LinearModel.from_transition(
        2, model().transition_matrix, lambda t, dt: dt * (1 + t) * q
    )


def make_graphs(times: np.ndarray, links: np.ndarray) -> dict[float, Graph]:
    """Return the directed graph of each time."""
    result = {}
    for t, adjacency in zip(times, links, strict=True):
        result[t] = Graph.from_adjacency(adjacency, directed=True)
    return result


def draw_prior(rng: Any, family: str) -> Any:
    """Return the prior, for ensembles as members."""
    if family != "ensemble":
        return PRIOR
    # Members with exactly these moments, which exact updates keep
    draws = rng.standard_normal((120, 2))
    return match_moments(draws, *PRIOR)


def send_waiting(
    waiting: list[list[Any]],
    available: list[list[Any]],
    owed: np.ndarray,
    links: np.ndarray,
    t: float,
) -> None:
    """Send to each receiver b, where links[b, a], all that waits at agent a, and charge it."""
    for a, payload in enumerate(waiting):
        if payload:
            for b in np.flatnonzero(links[:, a]):
                available[b] += payload
                owed[a] += price(payload, t)
            waiting[a] = []


def list_arrivals(when: float, events: list[Any], agents: int) -> list[list[Any]]:
    """Return the sensors and observations that arrive at an index of time, by agent."""
    arrived: list[list[Any]] = [[] for _ in range(agents)]
    for arrival, sensor, observation in events:
        if arrival == when:
            arrived[observation.agent].append((sensor, observation))
    return arrived


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("family", FAMILIES)
def test_every_agent_knows_what_its_readings_say(family: str, seed: int) -> None:
    """Now and at the times kept, whatever came late, waited or is missing; and pays for it."""
    rng = np.random.default_rng(seed)
    several = family not in ("mixture", "news")
    gaussian = family in ("gaussian", "unscented")
    agents = rng.integers(1, 5)
    steps = rng.integers(2, 6)
    runs = (2,) if several and rng.random() < 0.5 else ()
    team = draw_team(rng, agents)
    times = np.cumsum(rng.uniform(0.05, 0.5, steps + 1)) - 0.3
    links = draw_links(rng, (steps + 1, agents, agents), family == "news")
    every = rng.choice([0.0, 0.3])
    contact = find_contacts(times, links, every)
    # Observations that wait for a contact need states to which they can return.
    waits = bool(every) or not contact[1:].all()
    lag = int(steps if waits else rng.integers(steps + 1))
    share = family != "mixture" and (family == "news" or rng.random() < 0.8)
    # Without process noise the other families are exact as well.
    q = Q if gaussian or family == "mixture" else 0 * Q
    walk = make_walk(q)
    nets = make_graphs(times, links)
    options: Any = {}
    if several:
        options = {"lag": lag, "share_observations": share, "record_evidence": True}
    f = FAMILIES[family](
        walk, team, nets.get, exchange_interval=every or None, **options
    )
    prior = draw_prior(rng, family)
    events = draw_events(rng, team, times, runs, lag, several)
    # Written out here: which observations each agent has, and which wait for a contact.
    available = [[] for _ in team]
    waiting = [[] for _ in team]
    owed = np.zeros(agents)
    totals = np.zeros((len(SCORES), *runs, agents))
    state = f.start(prior, rng=rng, runs=runs, t=times[0])
    arrivals = [event[0] for event in events]
    for when in sorted({*range(1, steps + 1), *arrivals}):
        k = int(when)
        t = times[k]
        now = list_arrivals(when, events, agents)
        # Observations of earlier times come as delayed ones, those of now by agent.
        seen = [[o for _, o in private if o.t == t] for private in now]
        late = [o for private in now for _, o in private if o.t < t]
        delayed = {"delayed": late} if several else {}
        state = f.step(state, t, seen, **delayed)
        # A second step to the same time is no contact if there is an interval.
        may_send = share and contact[k] and not (every and when > k)
        for a, private in enumerate(now):
            available[a] += private
            waiting[a] += private
        if may_send:
            send_waiting(waiting, available, owed, links[k], t)
        assert family == "news" or np.array_equal(state.ledger.scalars, owed)
        states = (state, *getattr(state, "lagged_states", ()))
        views = [(then.t, f.summarize(then)) for then in states]
        assert len(views) == 1 + min(lag * several, k)
        check_beliefs(views, available, times[: k + 1], q, runs)
        if several:
            totals = totals + [getattr(state, name) for name in SCORES]
            check_scores(totals, available, times[: k + 1], q, runs)
