"""Every family of filters and every fusion rule, for the tests that all of them have to pass.

A new family adds a line to FAMILIES, and the tests of the contract run for it too.
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
from distfilt.models import LinearModel, Model, simulate
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
        network.inverse_covariance_intersection,
        network.ellipsoidal_intersection,
        network.covariance_union,
        network.information_consensus,
        network.diffuse_means,
    ],
    "common": [network.average_consensus, partial(network.average_consensus, gain=0.2)],
}


def rules(family: str) -> list[Callable[..., Any]]:
    """Fusion rules that fit the family: of Gaussians, of log-likelihoods or of ensembles."""
    # "ensemble, common" has two of the words; the first one in this order counts.
    words = [word for word in ("gaussian", "common", "ensemble") if word in family]
    # Particles are fused as ensembles.
    kind = words[0] if words else "ensemble"
    return RULES[kind]


# Full matrices: a test with diagonal ones would miss a transpose or a lost correlation.
Q = np.array([[0.3, 0.1], [0.1, 0.2]])
PRIOR_MEAN = np.array([1.0, -0.5])
PRIOR_COV = np.array([[1.0, 0.3], [0.3, 0.8]])
PRIOR = (PRIOR_MEAN, PRIOR_COV)
NOISE = np.array([[0.5, 0.2], [0.2, 0.4]])


def still_model(dim: int, rate: float = 0.0) -> Model:
    """A state that only diffuses, with a variance of `rate` a second; at rate 0 it rests."""

    def noise_cov(t: float, dt: float) -> np.ndarray:
        return rate * dt * np.eye(dim)

    return Model(dim, lambda x, t, dt: x, noise_cov)


def model() -> LinearModel:
    """A damped oscillator with a full process noise."""

    def transition(dt: float) -> np.ndarray:
        # exp(A dt) for A = [[-0.1, 1], [-1, -0.1]]: a rotation that shrinks
        cos = np.cos(dt)
        sin = np.sin(dt)
        rotation = np.array([[cos, sin], [-sin, cos]])
        return np.exp(-0.1 * dt) * rotation

    return LinearModel.from_transition(
        2, transition, lambda t, dt: dt * Q, names=("x", "v"), units=("m", "m/s")
    )


def team(agents: int = 5) -> list[Sensor | None]:
    """Sensors of one number, two (correlated) numbers and none, in turn."""
    position = component([0], std=0.6)
    position_and_velocity = Sensor(2, lambda x: x, NOISE, linear=np.eye)
    kinds = [position, position_and_velocity, None]
    return [kinds[k % 3] for k in range(agents)]


# Uneven steps: a filter that took one step for another would differ.
TIMES = np.cumsum([0.1, 0.3, 0.2, 0.4, 0.1, 0.2, 0.3, 0.2])


def data(
    sensors: list[Sensor | None], runs: tuple[int, ...] = (), seed: int = 0
) -> tuple[np.ndarray, list[np.ndarray | None]]:
    """A truth (T, *runs, 2) and the sensors' observations."""
    rng = default_rng(seed)
    # x = m + L z with P = L Lᵀ has the prior's moments.
    root = np.linalg.cholesky(PRIOR_COV)
    start = PRIOR_MEAN + rng.standard_normal((*runs, 2)) @ root.T
    truth = simulate(model(), start, TIMES, rng=rng)
    seen: list[np.ndarray | None] = []
    for sensor in sensors:
        seen.append(None if sensor is None else sensor.observe(truth, rng=rng))
    return truth, seen


def kalman(seen: Any, sensors: Any) -> tuple[Any, dict[str, Any]]:
    """The Kalman filter of all agents' observations, with the matrices of its model."""
    steps = np.diff(TIMES, prepend=0.0)
    oscillator = model()
    moves = {
        "F": np.array([oscillator.F(dt) for dt in steps]),
        "Q": np.array([dt * Q for dt in steps]),
    }
    # One sensor with all components stands for the network.
    every = stack(sensors)
    h = every.H(2)
    y = np.concatenate(seen, axis=-1)
    return kalman_filter(*PRIOR, y, H=h, R=every.noise_cov, **moves), moves


def make_filter(family: str, agents: int = 5, **options: Any) -> tuple[Any, Any]:
    """A filter of a family on a path of agents, and its state at the start."""
    if family.endswith("common") and options.get("fusion", 0) is None:
        # This family needs a rule: one round of averaging reaches as far as observations.
        del options["fusion"]
    sensors = options.pop("sensors", team(agents))
    graph = options.pop("graph", network.graphs.path(len(sensors)))
    runs = options.pop("runs", ())
    motion = options.pop("model", model())
    f = FAMILIES[family](motion, sensors, graph, **options)
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
