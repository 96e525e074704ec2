"""A bound for Table II of Grange et al.: a Rao-Blackwellised particle filter of all sensors.

The Clohessy-Wiltshire equations do not couple the motion along the orbit's normal to the rest. A
Kalman filter holds the plane (x, y, vx, vy), which the positions and velocities determine;
particles hold (z, vz), and the angle weighs them with y integrated out over the plane's Gaussian.
What the angle tells about y is left out; beyond the first second that is next to nothing. The data
are those of Fig. 1, batch by batch.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _satellites as satellites

from distfilt.ensembles import draw
from distfilt.kalman import kalman_filter
from distfilt.linalg import factor
from distfilt.updates import resampled

NAME, PAPER, BATCH = "bound", "grange", 5
SETUP = satellites.setup("table-2")
PLANE, NORMAL = [0, 1, 3, 4], [2, 5]
APPLIES = [(a.kind, list(a.dims)) for a in SETUP.scenario.agents] == [
    ("direct", [0, 1]), ("angle", [1, 2]), ("direct", [3, 4, 5])
]  # fmt: skip
columns = [
    *(f"bound_{what}_{r}" for what in ("mse", "nees", "share") for r in range(BATCH)),
    *satellites.time_columns(SETUP, "bound"),
]
parameters = {"batch": BATCH, "seed": 2024, "particles": 10_000, "nodes": 7}
seeds = np.random.SeedSequence(satellites.SEED).spawn(SETUP.runs // BATCH)
scenarios = (SETUP.scenario,)
rtol = 1e-4


def weighed(
    angle: np.ndarray, z: np.ndarray, y: np.ndarray, variance: float, noise: float
) -> np.ndarray:
    """Log likelihood (R, n) of an angle for each z, with y ~ N(y, variance) integrated out."""
    nodes, shares = np.polynomial.hermite_e.hermegauss(parameters["nodes"])
    places = y[:, None, None] + np.sqrt(variance) * nodes
    gap = angle[:, None, None] - np.arctan2(z[..., None], places)
    gap = (gap + np.pi / 2) % np.pi - np.pi / 2
    likelihood = np.exp(-0.5 * gap**2 / noise) @ (shares / shares.sum())
    return np.asarray(np.log(np.maximum(likelihood, 1e-300)))


def plane(seen: list[np.ndarray], phi: np.ndarray, q: np.ndarray) -> Any:
    """The Kalman filter of what the positions and two velocities say of the plane."""
    block = np.ix_(PLANE, PLANE)
    stds = [s.cov[0, 0] for s in SETUP.sensors]
    return kalman_filter(
        SETUP.prior[0][PLANE], SETUP.prior[1][block],
        np.concatenate([seen[0], seen[2][..., :2]], axis=-1),
        F=phi[block], Q=q[block], H=np.eye(4), R=np.diag([stds[0]] * 2 + [stds[2]] * 2),
    )  # fmt: skip


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """A batch of runs: settled error, NEES/d and least effective share; error and NEES in time."""
    if not APPLIES:  # a reader's sensors: there is no such split of the state
        return dict.fromkeys(columns, float("nan"))
    for_data, _ = seed.spawn(2)
    truth, seen = satellites.data(SETUP, np.random.default_rng(for_data), (BATCH,))
    rng, n = np.random.default_rng(seed.spawn(1)[0]), parameters["particles"]
    dt = float(SETUP.times[0])
    phi, q = SETUP.model.transition(dt), SETUP.model.noise(0.0, dt)
    flat = plane(seen, phi, q)
    block = np.ix_(NORMAL, NORMAL)
    root, noise = factor(q[block]), [s.cov[0, 0] for s in SETUP.sensors]
    points = draw(SETUP.prior[0][NORMAL], SETUP.prior[1][block], n, rng=rng, leading=(BATCH,))
    errors, scores, shares = [], [], []
    for k in range(SETUP.times.size):
        points = points @ phi[block].T + rng.standard_normal(points.shape) @ root.T
        log = -0.5 * (seen[2][k, :, 2, None] - points[..., 1]) ** 2 / noise[2]
        cov = np.broadcast_to(flat.covariances[k], (BATCH, 4, 4))
        log += weighed(
            seen[1][k, :, 0], points[..., 0], flat.means[k, :, 1], cov[0, 1, 1], noise[1]
        )
        w = np.exp(log - log.max(axis=1, keepdims=True))
        w /= w.sum(axis=1, keepdims=True)
        mean = np.einsum("rn,rnj->rj", w, points)
        off = points - mean[:, None]
        spread = np.einsum("rn,rni,rnj->rij", w, off, off)
        in_plane, along = truth[k][:, PLANE] - flat.means[k], truth[k][:, NORMAL] - mean
        errors.append((in_plane**2).sum(axis=1) + (along**2).sum(axis=1))
        scores.append(squared(in_plane, cov) + squared(along, spread))
        shares.append(1 / (w**2).sum(axis=1) / n)
        points = np.take_along_axis(points, resampled(w, rng=rng)[..., None], axis=1)
    return stored(np.array(errors), np.array(scores) / 6, np.array(shares))


def squared(gap: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Normalised squared errors (R,)."""
    return np.einsum("ri,ri->r", gap, np.linalg.solve(cov, gap[..., None])[..., 0])


def stored(errors: np.ndarray, scores: np.ndarray, shares: np.ndarray) -> dict[str, float]:
    """What is stored of the series (T, R)."""
    late = SETUP.settled
    out = satellites.over_time("bound", errors, scores)
    for r in range(BATCH):
        out[f"bound_mse_{r}"] = float(errors[late, r].mean())
        out[f"bound_nees_{r}"] = float(scores[late, r].mean())
        out[f"bound_share_{r}"] = float(shares[late, r].min())
    return out


code = (weighed, plane, squared, stored, satellites.data)
