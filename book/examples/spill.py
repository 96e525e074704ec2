"""Four buoys on a ring follow a drifting spill: a model, a sensor and a graph of your own."""

from functools import partial

import numpy as np

from distfilt.filters import EnsembleFilter
from distfilt.models import Model, simulate
from distfilt.network import Graph, mean_pull
from distfilt.sensors import Sensor

rng = np.random.default_rng(0)


def drift(x: np.ndarray, t: float, dt: float) -> np.ndarray:
    """The current turns the spill about the origin."""
    return np.asarray(x + dt * np.stack([-x[..., 1], x[..., 0]], axis=-1))


def concentration(place: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The concentration at a buoy falls with the distance from the spill's centre."""
    return np.asarray(np.exp(-((x - place) ** 2).sum(-1, keepdims=True) / 8))


names = ("x", "y")
units = ("km", "km")
model = Model(2, drift, lambda t, dt: 0.01 * dt * np.eye(2), names=names, units=units)
buoys = np.array([[2.0, 0.0], [0.0, 2.0], [-2.0, 0.0], [0.0, -2.0]])
sensors = [Sensor(1, partial(concentration, place), [[0.02**2]]) for place in buoys]
ring = Graph.from_adjacency([[0, 1, 0, 1], [1, 0, 1, 0], [0, 1, 0, 1], [1, 0, 1, 0]])

times = np.arange(1, 61) * 0.05
truth = simulate(model, [1.0, 0.0], times, rng=rng)
observations = [sensor.observe(truth, rng=rng) for sensor in sensors]
spill = EnsembleFilter(
    model, sensors, ring, fusion=partial(mean_pull, gain=0.02), members=300
)
state = spill.start(([0.5, 0.5], np.eye(2)), rng=rng)
run = spill.run(state, times, observations, truth=truth)
error = run["total_squared_error"].sel(time=slice(2, 3)).mean("time")
print(f"mean squared errors {error.values.round(3)} km²")
