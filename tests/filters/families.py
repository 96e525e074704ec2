"""Every family of filters and every rule of agreement, for the tests that all of them have to pass.

A new family adds a line to FAMILIES and gets the contract's tests for nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.random import default_rng

from distfilt import network
from distfilt.filters import (
    EnsembleFilter,
    GaussianFilter,
    ParticleFilter,
    TransportFilter,
)
from distfilt.kalman import kalman_filter
from distfilt.models import LinearModel, simulate
from distfilt.sensors import Sensor, component, stack
from distfilt.updates import (
    enkf_exact,
    etkf,
    serially,
    transport_map_update,
    with_inflation,
)

FAMILIES: dict[str, Callable[..., Any]] = {
    "ensemble": partial(EnsembleFilter, members=40),
    "ensemble, exact": partial(EnsembleFilter.exact, members=40),
    "ensemble, exact draws": partial(EnsembleFilter, update=enkf_exact, members=40),
    "ensemble, transport": partial(
        EnsembleFilter, update=transport_map_update, members=60
    ),
    "ensemble, square root": partial(
        EnsembleFilter, update=with_inflation(etkf, factor=1.01), members=40
    ),
    "ensemble, serial": partial(
        EnsembleFilter, update=serially(enkf_exact), members=40
    ),
    "gaussian": GaussianFilter,
    "gaussian, unscented": partial(GaussianFilter, linearization="unscented"),
    "particle": partial(ParticleFilter, members=500),
    "particle, jitter": partial(ParticleFilter, members=500, jitter=0.2),
    "ensemble, common": partial(
        TransportFilter, members=40, fusion=network.average_consensus, rejuvenation=0.1
    ),
}

RULES = {
    "ensemble": [
        partial(network.mean_pull, gain=0.1),
        network.intersect_ensembles,
        partial(network.intersect_ensembles, rule="min_trace"),
    ],
    "gaussian": [
        network.covariance_intersection,
        network.naive_fusion,
        network.arithmetic_average,
        partial(network.consensus_pull, gain=0.1),
    ],
    "common": [network.average_consensus, partial(network.average_consensus, gain=0.2)],
}


def rules(family: str) -> list[Callable[..., Any]]:
    """Agreements that fit the family: of Gaussians, of log-likelihoods or of ensembles."""
    words = [word for word in ("gaussian", "common", "ensemble") if word in family]
    return RULES[words[0] if words else "ensemble"]


Q = np.array([[0.3, 0.1], [0.1, 0.2]])
PRIOR = (np.array([1.0, -0.5]), np.array([[1.0, 0.3], [0.3, 0.8]]))
NOISE = np.array([[0.5, 0.2], [0.2, 0.4]])


def model() -> LinearModel:
    """A damped oscillator with a full process noise."""

    def transition(dt: float) -> np.ndarray:
        return np.exp(-0.1 * dt) * np.array(
            [[np.cos(dt), np.sin(dt)], [-np.sin(dt), np.cos(dt)]]
        )

    return LinearModel.from_transition(
        2, transition, lambda t, dt: dt * Q, names=("x", "v"), units=("m", "m/s")
    )


def team(agents: int = 5) -> list[Sensor | None]:
    """Sensors of one, two (correlated) and no readings in turn."""
    position_and_velocity = Sensor(2, lambda x: x, NOISE, linear=lambda d: np.eye(d))
    return [
        [component([0], std=0.6), position_and_velocity, None][k % 3]
        for k in range(agents)
    ]


TIMES = np.cumsum([0.1, 0.3, 0.2, 0.4, 0.1, 0.2, 0.3, 0.2])


def data(
    sensors: list[Sensor | None], runs: tuple[int, ...] = (), seed: int = 0
) -> tuple[np.ndarray, list[np.ndarray | None]]:
    """A truth (T, *runs, 2) and the sensors' readings."""
    rng = default_rng(seed)
    start = PRIOR[0] + rng.standard_normal((*runs, 2)) @ np.linalg.cholesky(PRIOR[1]).T
    truth = simulate(model(), start, TIMES, rng=rng)
    return truth, [None if s is None else s.observe(truth, rng=rng) for s in sensors]


def kalman(seen: Any, sensors: Any) -> tuple[Any, dict[str, Any]]:
    """The Kalman filter of everybody's readings, with the matrices of its model."""
    steps = np.diff(TIMES, prepend=0.0)
    every = stack(sensors)
    moves = {
        "F": np.array([model().F(dt) for dt in steps]),
        "Q": np.array([dt * Q for dt in steps]),
    }
    y = np.concatenate(seen, axis=-1)
    return kalman_filter(*PRIOR, y, H=every.H(2), R=every.noise_cov, **moves), moves


def make_filter(family: str, agents: int = 5, **options: Any) -> tuple[Any, Any]:
    """A filter of a family on a path of agents, and its state at the start."""
    if family.endswith("common") and options.get("fusion", 0) is None:
        del options["fusion"]  # one round of averaging, which is as far as readings go
    sensors = options.pop("sensors", team(agents))
    graph = options.pop("graph", network.graphs.path(len(sensors)))
    runs = options.pop("runs", ())
    f = FAMILIES[family](options.pop("model", model()), sensors, graph, **options)
    return f, f.start(PRIOR, rng=default_rng(3), runs=runs)


def values(state: Any) -> dict[str, np.ndarray]:
    """Every array that a state holds, by name."""
    names = (
        "ensembles",
        "particles",
        "log_weights",
        "joint_means",
        "joint_covariances",
    )
    return {n: getattr(state, n) for n in names if hasattr(state, n)}
