"""A bound for Table II of Grange et al.: a Rao-Blackwellised particle filter of all sensors.

The Clohessy-Wiltshire equations do not couple the motion along the orbit's normal to the rest. A
Kalman filter holds the plane (x, y, vx, vy), which the positions and velocities determine;
particles hold (z, vz), and the angle weighs them with y integrated out over the plane's Gaussian.
What the angle tells about y is left out; beyond the first second that is next to nothing. The data
are those of the study in `satellites.py`, trial by trial.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np

from distfilt.ensembles import draw
from distfilt.kalman import predict, systematic, update
from distfilt.linalg import factor

sys.path.insert(0, str(Path(__file__).parent))
import satellites

cloudpickle.register_pickle_by_value(satellites)

NAME, PAPER = "bound", "grange"
PLANE, NORMAL = [0, 1, 3, 4], [2, 5]
columns = ["mse", "nees", "crps_z", "least_share"]
parameters = {**satellites.parameters, "particles": 20_000, "nodes": 7}
seeds = satellites.seeds
rtol = 1e-4


def weighed(
    angle: float, z: np.ndarray, y: float, variance: float, noise: float
) -> np.ndarray:
    """Log likelihood of an angle for each z, with y ~ N(y, variance) integrated out."""
    nodes, shares = np.polynomial.hermite_e.hermegauss(parameters["nodes"])
    places = y + np.sqrt(variance) * nodes
    gap = angle - np.arctan2(z[:, None], places)
    gap = (gap + np.pi / 2) % np.pi - np.pi / 2
    likelihood = np.exp(-0.5 * gap**2 / noise) @ (shares / shares.sum())
    return np.asarray(np.log(np.maximum(likelihood, 1e-300)))


def resampled(
    points: np.ndarray, log_weights: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Moments before, and equally weighted points after resampling; the effective share."""
    w = np.exp(log_weights - log_weights.max())
    w /= w.sum()
    mean = w @ points
    spread = (points - mean).T @ ((points - mean) * w[:, None])
    share = 1 / (w**2).sum() / w.size
    return mean, spread, share, points[systematic(w, rng=rng)]


def score_z(points: np.ndarray, truth: float) -> float:
    """CRPS of the particles' z."""
    from distfilt.metrics import crps

    return float(crps(points[:, :1], np.array([truth]))[0])


def trial(seed: np.random.SeedSequence) -> list[float]:
    """One run: settled squared error, NEES, CRPS of z, and the least effective share."""
    part = seed.spawn(2)[0]
    for_data, _ = part.spawn(2)
    times, truth, (position, angle, velocity) = satellites.data(
        "II", np.random.default_rng(for_data)
    )
    setting, model = satellites.TABLES["II"], satellites.model("II")
    rng = np.random.default_rng(part.spawn(1)[0])
    x0 = np.array(setting["initial_state"]) + setting["prior_offset"]
    eye = setting["prior_variance"] * np.eye(6)
    mean, cov = x0[PLANE], eye[:4, :4]
    points = draw(x0[NORMAL], eye[:2, :2], parameters["particles"], rng=rng)
    dt = float(times[0])
    phi, q = model.transition(dt), model.noise(0.0, dt)
    root = factor(q[np.ix_(NORMAL, NORMAL)])
    plane = np.vstack([position.T, velocity[:, :2].T]).T
    in_metres, in_rad, in_metres_a_second = (a.noise for a in setting.agents)
    noise = np.diag([in_metres] * 2 + [in_metres_a_second] * 2) ** 2
    rows: list[list[float]] = []
    for k, t in enumerate(times):
        mean, cov = predict(
            mean, cov, F=phi[np.ix_(PLANE, PLANE)], Q=q[np.ix_(PLANE, PLANE)]
        )
        mean, cov, _ = update(mean, cov, plane[k], H=np.eye(4), R=noise)
        points = points @ phi[np.ix_(NORMAL, NORMAL)].T
        points = points + rng.standard_normal(points.shape) @ root.T
        log_weights = -0.5 * ((velocity[k, 2] - points[:, 1]) / in_metres_a_second) ** 2
        log_weights += weighed(angle[k, 0], points[:, 0], mean[1], cov[1, 1], in_rad**2)
        normal, spread, share, points = resampled(points, log_weights, rng)
        gap = truth[k] - np.array([*mean[:2], normal[0], *mean[2:], normal[1]])
        nees = gap[PLANE] @ np.linalg.solve(cov, gap[PLANE])
        nees += gap[NORMAL] @ np.linalg.solve(spread, gap[NORMAL])
        if t > setting["average_from"]:
            rows.append([gap @ gap, nees, score_z(points, truth[k, 2]), share])
    settled = np.array(rows)
    return [*settled[:, :3].mean(axis=0), float(settled[:, 3].min())]


code: tuple[Any, ...] = (weighed, resampled, score_z)
