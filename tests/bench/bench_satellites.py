"""A step of the filter of Table III of Grange et al.

The network has five agents, 13 components and 200 members; known noise and covariance
intersection, or exact draws and moments. A step is compared with the same mathematics
in plain numpy, without checks, a ledger or losses: the model's motion, the sensors'
predictions, the draws, projected where they are exact, the gains, the fusion of moments
and the map that moves members least to them. The search for the weights of least
determinant, which the second filter makes, is the library's own in both. Misses above
the limits.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from _bench import Row, compare_times, main, table

from bookkit import studies
from distfilt.gaussians import intersection_weights
from tests.support import without_checks

LIMITS = {
    ("known_fused", 1): 2.0,
    ("known_fused", 50): 2.0,
    ("exact", 1): 2.0,
    ("exact", 50): 2.0,
}


def anomalies(x: np.ndarray) -> np.ndarray:
    return x - x.mean(axis=-2, keepdims=True)


def exact(z: np.ndarray, avoid: np.ndarray) -> np.ndarray:
    """Normal draws (..., N, k) made uncorrelated with anomalies and of unit sample covariance."""
    # A linear sensor's predictions depend on the members, so that normal equations are
    # singular.
    frame = np.linalg.qr(avoid)[0]
    z = anomalies(z)
    # z - Q Qᵀ z has no part along the anomalies to avoid.
    z -= frame @ (frame.mT @ z)
    # Divide by the factor of the sample covariance, which makes it I.
    sample_cov = z.mT @ z / (z.shape[-2] - 1)
    root = np.linalg.cholesky(sample_cov)
    return z @ np.linalg.inv(root).mT


def plain_step(
    setup: Any, states: np.ndarray, rng: np.random.Generator, kind: str
) -> Any:
    """One step for states (runs, A, N, d)."""
    n = states.shape[-2] - 1
    dt = float(setup.times[1] - setup.times[0])
    values, vectors = np.linalg.eigh(setup.model.Q(0.0, dt))
    # Q is singular: no noise acts on the quaternion.
    positive = values > 1e-14 * values.max()
    root = vectors[:, positive] * np.sqrt(values[positive])
    # receives[k, j]: agent k knows its own belief and those of its neighbours.
    receives = np.eye(len(setup.sensors)) + (setup.graph.laplacian.toarray() < 0)
    received_sensors = []
    for row in receives:
        received_sensors.append([setup.sensors[j] for j in np.flatnonzero(row)])

    def predict(k: int, x: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Return the predictions of the sensors that agent k receives, without noise."""
        predictions = []
        for sensor in received_sensors[k]:
            arguments = (x, before) if sensor.uses_previous else (x,)
            predictions.append(sensor.h(*arguments))
        return np.concatenate(predictions, axis=-1)

    def draw(avoid: np.ndarray, k: int) -> np.ndarray:
        z = rng.standard_normal((*avoid.shape[:-1], k))
        return exact(z, avoid) if kind == "exact" else z

    def call() -> np.ndarray:
        x = setup.model.step(states, 0.0, dt)
        # Forecast with additive noise
        x = x + draw(anomalies(x), root.shape[1]) @ root.T
        for k in range(len(received_sensors)):
            h = predict(k, x[:, k], states[:, k])
            a = anomalies(x[:, k])
            b = anomalies(h)
            m = h.shape[-1]
            # K = (BᵀB / (N - 1) + I)⁻¹ BᵀA / (N - 1); predictions are in units of the
            # noise
            innovation_cov = b.mT @ b / n + np.eye(m)
            gain = np.linalg.solve(innovation_cov, b.mT @ a / n)
            noise = draw(np.concatenate([a, b], axis=-1), m)
            x[:, k] -= (h + noise) @ gain
        a = anomalies(x)
        covs = a.mT @ a / n
        precise = np.linalg.inv(covs)
        if kind == "exact":
            sources = np.broadcast_to(
                covs[:, None], (len(x), *receives.shape, *covs.shape[-2:])
            )
            rule = "min_determinant"
            weights = without_checks(intersection_weights)(
                sources, rule=rule, present=receives > 0
            )
        else:
            # The trace rule: w_j ∝ 1 / Tr P_j
            weights = receives / np.trace(covs, axis1=-2, axis2=-1)[:, None]
            weights /= weights.sum(axis=-1, keepdims=True)
        # Covariance intersection: P⁻¹ = Σ w P_j⁻¹
        fused = np.linalg.inv(np.einsum("rkj,rjde->rkde", weights, precise))
        sent = (precise @ x.mean(axis=-2)[..., None])[..., 0]
        mean = (fused @ (weights @ sent)[..., None])[..., 0]
        # The optimal transport map between the Gaussians before and after
        lower = np.linalg.cholesky(covs)
        values, vectors = np.linalg.eigh(lower.mT @ fused @ lower)
        symmetric_root = (vectors * np.sqrt(values)[..., None, :]) @ vectors.mT
        turn = np.linalg.solve(lower.mT, symmetric_root)
        transport = turn @ np.linalg.inv(lower)
        return mean[..., None, :] + a @ transport.mT

    return call


@table("satellites", "numpy", "scipy", "xarray")
def rows() -> Iterator[Row]:
    satellites = studies.script("_satellites")
    setup = satellites.setup("table-3")
    t = float(setup.times[0])
    for (kind, runs), limit in LIMITS.items():
        f = satellites.better_filter(setup, kind)
        rng = np.random.default_rng(1)
        _, seen = satellites.draw_data(setup, rng, (runs,))
        state = f.start(setup.prior, rng=rng, runs=(runs,))
        calls = {
            "ours": partial(f.step, state, t, [y[0] for y in seen]),
            "floor": plain_step(setup, state.ensembles, rng, kind),
        }
        times, ratios = compare_times(calls, 9, 0.05)
        ratio = 1 / ratios["floor"]
        yield {
            "part": f"a step of Table III, {kind}",
            "runs": runs,
            "ms": f"{1e3 * times['ours']:.2f}",
            "floor_ms": f"{1e3 * times['floor']:.2f}",
            "ratio": f"{ratio:.2f}",
            "limit": limit,
            "missed": ratio > limit,
        }


if __name__ == "__main__":
    main()
