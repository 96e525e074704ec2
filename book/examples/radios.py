"""Four robots with odometry and radios: from a file of ranges to a table of errors."""

import sys
from functools import partial
from typing import Any

import numpy as np

from bookkit import datasets
from distfilt.filters import GaussianFilter, Observation
from distfilt.models import Inputs, Model
from distfilt.network import covariance_intersection, graphs, naive_fusion
from distfilt.sensors import distance

STEP_STD = (0.045, 0.045, 0.022)  # forward and left in m, turn in rad, for a second
RANGE_STD = 0.15  # in m


def drive(x: np.ndarray, t: float, dt: float, inputs: Inputs) -> np.ndarray:
    """Move poses (..., 3 A) by the robots' odometry."""
    poses = x.reshape(*x.shape[:-1], -1, 3)
    for _, length, rates in inputs.pieces(t, dt):
        forward, left, turn = length * rates.reshape(-1, 3).T
        heading = poses[..., 2] + turn / 2
        east = forward * np.cos(heading) - left * np.sin(heading)
        north = forward * np.sin(heading) + left * np.cos(heading)
        poses = poses + np.stack([east, north, turn + 0 * heading], axis=-1)
    return poses.reshape(x.shape)


def make_model(data: datasets.Dataset) -> Model:
    """Return the model of all robots' poses, which their odometry drives."""
    n = 3 * len(data.robots)
    times, rates = data.displacement_rates()
    inputs = Inputs(times, rates, np.zeros((n, n)))
    noise_cov = np.diag(np.tile(np.square(STEP_STD), n // 3))
    periods = {k: 2 * np.pi for k in range(2, n, 3)}
    move = partial(drive, inputs=inputs)
    return Model(n, move, lambda t, dt: dt * noise_cov, periods=periods)


def list_ranges(data: datasets.Dataset) -> list[Observation]:
    """Return the ranges as observations, each with its sensor."""
    places = {robot: [3 * k, 3 * k + 1] for k, robot in enumerate(data.robots)}
    anchors = data.of_kind("survey").set_index("subject")[["x", "y"]]
    observations = []
    for row in data.of_kind("range").itertuples():
        end: dict[str, Any] = {"observer": places.get(row.subject)}
        if row.subject not in places:
            end = {"origin": anchors.loc[row.subject]}
        sensor = distance(places[row.robot], std=RANGE_STD, **end)
        agent = data.robots.index(row.robot)
        observations.append(Observation(row.time, agent, [row.range], sensor))
    return observations


RULES: dict[str, dict[str, Any]] = {
    "no communication": {"share_observations": False},
    "naive fusion": {"share_observations": False, "fusion": naive_fusion},
    "intersection": {"share_observations": False, "fusion": covariance_intersection},
    "all observations": {"share_observations": True},
}

if __name__ == "__main__":
    data = datasets.read_pyfg(sys.argv[1])
    n = len(data.robots)
    model, observations = make_model(data), list_ranges(data)
    for name, options in RULES.items():
        f = GaussianFilter(model, [None] * n, graphs.complete(n), **options)
        start = f.start(data.prior_poses())
        run = f.run(start, None, observations, truth=data.true_state)
        error = run["squared_error"].values.reshape(*run["nees"].shape, n, 3)
        rmse = np.sqrt(2 * error[..., :2].mean())
        nees = float(run["nees"].mean()) / (3 * n)
        print(f"{name:17s} {rmse:6.3f} m  NEES {nees:8.2f}")
