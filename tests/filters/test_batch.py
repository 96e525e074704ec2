"""Random networks, readings and options, against one joint Gaussian of all times."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag

from distfilt.filters import (
    EnsembleFilter,
    GaussianFilter,
    InformationIncrementFilter,
    MixtureFilter,
    Observation,
)
from distfilt.gaussians.single import match_moments
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
FAMILIES: dict[str, Any] = {
    "gaussian": GaussianFilter,
    "unscented": partial(GaussianFilter, linearization="unscented", kappa=0.5),
    "ensemble": partial(EnsembleFilter.exact, members=120, fusion=None),
    "mixture": partial(MixtureFilter, target_dim=2),
    "news": partial(InformationIncrementFilter, target_dim=2),
}


def batch(known: list[Any], times: Any, q: Any, run: Any) -> tuple[Any, Any]:
    """Means (K, 2) and covariances (K, 2, 2) at all times, given the observations of one run."""
    lift = np.eye(2 * len(times))
    steps = np.diff(times)
    for k, dt in enumerate(steps, 1):
        lift[2 * k : 2 * k + 2] += model().F(dt) @ lift[2 * k - 2 : 2 * k]
    mean = lift[:, :2] @ PRIOR[0]
    noises = [dt * (1 + t) * q for t, dt in zip(times, steps, strict=False)]
    cov = lift @ block_diag(PRIOR[1], *noises) @ lift.T
    h = np.zeros((0, len(mean)))
    r = np.zeros((0, 0))
    y = np.zeros(0)
    for sensor, observation in known:
        value = (
            observation.value[run] if observation.value.ndim > 1 else observation.value
        )
        arrived = ~np.isnan(value)
        place = np.eye(len(times))[times.tolist().index(observation.t)]
        h = np.concatenate([h, np.kron(place, sensor.H(2))[arrived]])
        r = block_diag(r, sensor.noise_cov[np.ix_(arrived, arrived)])
        y = np.concatenate([y, value[arrived]])
    gain = np.linalg.solve(h @ cov @ h.T + r, h @ cov).T
    mean = mean + gain @ (y - h @ mean)
    cov = cov - gain @ h @ cov
    return mean.reshape(-1, 2), np.array(
        [cov[k : k + 2, k : k + 2] for k in range(0, len(cov), 2)]
    )


def price(told: list[Any], now: float) -> Any:
    """Numbers that are there, and of each reading when it was, of which sensor, and about it."""
    receivers = [
        ~np.isnan(observation.value.reshape(-1, sensor.dim)).all(axis=0)
        for sensor, observation in told
    ]
    numbers = sum(map(np.sum, receivers))
    (sensor, observation), *more = told
    if (
        not more
        and observation.t == now
        and not observation.metadata
        and observation.sensor in (0, sensor)
    ):
        return numbers
    return numbers + sum(2 + len(observation.metadata) for _, observation in told)


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
            value = rng.normal(size=(*runs[: rng.integers(2)], sensor.dim))
            value[rng.random(value.shape) < 0.2] = np.nan
            k = j + several * rng.integers(2) * rng.integers(lag + 1)
            # A sensor of the observation's own travels with its metadata.
            is_private = rng.random() < 0.2
            which = sensor if is_private else s
            metadata = tuple(rng.random(is_private * rng.integers(3)))
            if 0 < k <= steps and not np.isnan(value).all():
                observation = Observation(times[j], a, value, which, metadata=metadata)
                events.append((k + rng.integers(2) / 2, sensor, observation))
    return events


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
            cov = view.covariance
            result = np.cov(view.members[index].T) if cov is None else cov[index]
            assert np.allclose(view.mean[index], means[place], atol=1e-9)
            assert np.allclose(result, covs[place], atol=1e-9)


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
    team = [
        [KINDS[k] for k in rng.integers(3, size=rng.integers(3))] for _ in range(agents)
    ]
    times = np.cumsum(rng.uniform(0.05, 0.5, steps + 1)) - 0.3
    links = rng.random((steps + 1, agents, agents)) < rng.choice([0.3, 0.7])
    if family == "news":  # who hears one hears all
        links[:] = rng.random((steps + 1, 1, 1)) < 0.5
    links &= ~np.eye(agents, dtype=bool)
    every = rng.choice([0.0, 0.3])
    contact = links.any(axis=(1, 2))
    if every:
        contact[1:] &= np.diff(np.floor(times / every)) > 0
    lag = int(rng.integers(steps + 1) if contact[1:].all() and not every else steps)
    share = family != "mixture" and (family == "news" or rng.random() < 0.8)
    q = Q if gaussian or family == "mixture" else 0 * Q
    walk = LinearModel.from_transition(
        2, model().transition_matrix, lambda t, dt: dt * (1 + t) * q
    )
    nets = {
        t: Graph.from_adjacency(a, directed=True)
        for t, a in zip(times, links, strict=True)
    }
    options: Any = {"lag": lag, "share_observations": share} if several else {}
    f = FAMILIES[family](
        walk, team, nets.get, exchange_interval=every or None, **options
    )
    prior: Any = PRIOR  # or members of these moments, which exact updates keep
    if family == "ensemble":
        prior = match_moments(rng.standard_normal((120, 2)), *PRIOR)
    events = draw_events(rng, team, times, runs, lag, several)
    available = [[] for _ in team]
    waiting = [[] for _ in team]
    owed = np.zeros(agents)
    state = f.start(prior, rng=rng, runs=runs, t=times[0])
    for when in sorted({*range(1, steps + 1), *(event[0] for event in events)}):
        k = int(when)
        t = times[int(when)]
        now = [
            [event[1:] for event in events if event[0] == when and event[2].agent == a]
            for a in range(agents)
        ]
        late = [
            observation
            for private in now
            for _, observation in private
            if observation.t < t
        ]
        seen = [
            [observation for _, observation in private if observation.t == t]
            for private in now
        ]
        state = f.step(state, t, seen, **({"delayed": late} if several else {}))
        for a, private in enumerate(now):
            available[a] += private
            waiting[a] += private
            if share and contact[k] and waiting[a] and not (every and when > k):
                for b in np.flatnonzero(links[k, :, a]):
                    available[b] += waiting[a]
                    owed[a] += price(waiting[a], t)
                waiting[a] = []
        assert family == "news" or np.array_equal(state.ledger.scalars, owed)
        views = [
            (then.t, f.summarize(then))
            for then in (state, *getattr(state, "lagged_states", ()))
        ]
        assert len(views) == 1 + min(lag * several, k)
        check_beliefs(views, available, times[: k + 1], q, runs)
