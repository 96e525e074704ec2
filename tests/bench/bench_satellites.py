"""A step of the filter of Table III of Grange et al.

The network has five agents, 13 components and 200 members; known noise and covariance intersection,
or exact draws and moments. A step is held against the same by numpy, with nothing checked and no
message charged: the model's motion, the draws, the gains, and the fusion of moments by weights that
are given. Exact draws are projected there too; the search for the weights of least determinant,
which the second filter makes besides, is not in its floor. Nor are the sensors, for which a
component stands, nor the transport that moves members least: Cholesky factors move them there.
Misses above the limits.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from _bench import Row, interleaved, main, table

from bookkit import studies

LIMITS = {("known_fused", 1): 3.0, ("known_fused", 50): 2.0, ("exact", 1): 4.5, ("exact", 50): 2.5}


def centred(x: np.ndarray) -> np.ndarray:
    return x - x.mean(axis=-2, keepdims=True)


def exact(z: np.ndarray, avoid: np.ndarray) -> np.ndarray:
    """Normal draws (..., N, k) made uncorrelated with anomalies and of unit sample covariance."""
    z = centred(z)
    z = z - avoid @ np.linalg.solve(avoid.mT @ avoid, avoid.mT @ z)
    own = np.linalg.cholesky(z.mT @ z / (z.shape[-2] - 1))
    return z @ np.linalg.inv(own).mT


def floor_of(setup: Any, states: np.ndarray, rng: np.random.Generator, kind: str) -> Any:
    """One step for states (runs, A, N, d)."""
    n, dt = states.shape[-2] - 1, float(setup.times[1] - setup.times[0])
    values, vectors = np.linalg.eigh(setup.model.noise(0.0, dt))
    kept = values > 1e-14 * values.max()
    root = vectors[:, kept] * np.sqrt(values[kept])
    hears = np.eye(len(setup.sensors)) + (setup.graph.laplacian.toarray() < 0)
    read = [sum(s.dim for s, told in zip(setup.sensors, row, strict=True) if told) for row in hears]

    def drawn(avoid: np.ndarray, k: int) -> np.ndarray:
        z = rng.standard_normal((*avoid.shape[:-1], k))
        return exact(z, avoid) if kind == "exact" else z

    def call() -> np.ndarray:
        x = setup.model.step(states, 0.0, dt)
        x = x + drawn(centred(x), root.shape[1]) @ root.T
        for k, m in enumerate(read):
            h = x[:, k, :, :1] + rng.standard_normal((len(x), n + 1, m))
            a, b = centred(x[:, k]), centred(h)
            gain = np.linalg.solve(b.mT @ b / n + np.eye(m), b.mT @ a / n)
            x[:, k] -= (h + drawn(np.concatenate([a, b], axis=-1), m)) @ gain
        a = centred(x)
        covs = a.mT @ a / n
        precise = np.linalg.inv(covs)
        weights = hears / np.trace(covs, axis1=-2, axis2=-1)[:, None]
        weights /= weights.sum(axis=-1, keepdims=True)
        fused = np.linalg.inv(np.einsum("rkj,rjde->rkde", weights, precise))
        told = (precise @ x.mean(axis=-2)[..., None])[..., 0]
        mean = (fused @ (weights @ told)[..., None])[..., 0]
        turn = np.linalg.cholesky(fused) @ np.linalg.inv(np.linalg.cholesky(covs))
        return mean[..., None, :] + a @ turn.mT

    return call


@table("satellites", "numpy", "scipy", "xarray")
def rows() -> Iterator[Row]:
    satellites = studies.script("_satellites")
    setup = satellites.setup("table-3")
    t = float(setup.times[0])
    for (kind, runs), limit in LIMITS.items():
        f, rng = satellites.repaired(setup, kind), np.random.default_rng(1)
        _, seen = satellites.data(setup, rng, (runs,))
        state = f.start(setup.prior, rng=rng, runs=(runs,))
        calls = {
            "ours": partial(f.step, state, t, [y[0] for y in seen]),
            "floor": floor_of(setup, state.ensembles, rng, kind),
        }
        times, ratios = interleaved(calls, 9, 0.05)
        ratio = 1 / ratios["floor"]
        yield {
            "part": f"a step of Table III, {kind}", "runs": runs,
            "ms": f"{1e3 * times['ours']:.2f}", "floor_ms": f"{1e3 * times['floor']:.2f}",
            "ratio": f"{ratio:.2f}", "limit": limit, "missed": ratio > limit,
        }


if __name__ == "__main__":
    main()
