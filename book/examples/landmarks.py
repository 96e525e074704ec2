"""Robots that see each other and landmarks: from logs to a table of errors."""

import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from scipy.linalg import block_diag

from bookkit import datasets
from distfilt.filters import GaussianFilter, GaussianState
from distfilt.models import planar_odometry

DT = 0.1  # the grid of times, in s
BEGIN = 10  # the first step at which the filter may start
START_STD = (0.05, 0.05, 0.05)  # of the first poses, in m and rad
# Tuned in chapter 14: odometry in m/s, m/s, rad/s; sightings in m, rad; the
# lag of stamps in s
SETTING = {"odometry": (0.08, 0.0, 0.08), "sight": (0.078, 0.0325), "lag": 0.1}


def locate(
    data: datasets.Dataset, setting: dict[str, Any], nearest: float = 1.0
) -> Iterator[tuple[int, GaussianState]]:
    """Yield each step with sightings, and the state of poses and landmarks."""
    n = 2 * len(data.landmarks)
    times, rates = data.body_rates(DT)
    noise = setting["odometry"]
    model = planar_odometry(times, rates, std=noise, n_constants=n)
    f = GaussianFilter(
        model,
        [None],
        gate_probability=0.999,
        record_evidence=True,
    )
    rng = np.random.default_rng(0)
    start = DT * max(BEGIN, np.ceil(data.begin / DT))
    mean, cov = data.start_poses(start, std=START_STD, rng=rng)
    # Landmarks are unknown until they are seen.
    prior = np.append(mean, np.zeros(n)), block_diag(cov, 100 * np.eye(n))
    state = f.start(prior, t=start)
    log = data.shifted("range_bearing", -setting["lag"])
    yield from datasets.follow_sightings(
        f, state, log, std=setting["sight"], dt=DT, nearest=nearest
    )


if __name__ == "__main__":
    errors = {}
    for folder in sys.argv[1:]:
        data = datasets.read_utias(folder, unknown="drop")
        steps, states = zip(*locate(data, SETTING), strict=True)
        means = np.stack([state.means[0] for state in states])
        covs = np.stack([state.covariances[0] for state in states])
        poses = datasets.score_poses(data, DT * np.array(steps), means, covs)
        landmarks = datasets.score_landmarks(data, means[-1], covs[-1])
        errors[folder] = pd.concat([poses.mean(), landmarks.mean()])
    table = pd.DataFrame(errors).T
    table[["position", "heading", "place"]] **= 0.5
    print(table.round(3).to_string())
