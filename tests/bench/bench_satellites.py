"""A step of the filter of Table III of Grange et al.

The network has five agents, 13 components and 200 members; known noise and covariance intersection,
or exact draws and moments. A step is held against what it cannot do without: the normal numbers
that it draws, the model's motion of the members, and the products for means, covariances and gains,
by numpy. Misses above 3.7 times that floor for one run and 2.2 times for a batch of fifty.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from _bench import Row, interleaved, main, table

from bookkit import studies

LIMITS = {1: 3.7, 50: 2.2}


def floor_of(setup: Any, states: np.ndarray, rng: np.random.Generator) -> Any:
    """The draws, the motion and the products of one step, states (runs, A, N, d)."""
    n, d = states.shape[-2:]
    dt = float(setup.times[1] - setup.times[0])
    root = np.linalg.cholesky(setup.model.noise(0.0, dt) + 1e-12 * np.eye(d))
    senders, receivers = setup.graph.senders, setup.graph.receivers
    heard = [
        sum(setup.sensors[j].dim for j in (k, *senders[receivers == k]))
        for k in range(len(setup.sensors))
    ]

    def call() -> np.ndarray:
        x = setup.model.step(states, 0.0, dt)
        x = x + rng.standard_normal(states.shape) @ root.T
        for k, m in enumerate(heard):
            h = x[:, k, :, :1] + rng.standard_normal((len(x), n, m))
            b, a = h - h.mean(axis=1, keepdims=True), x[:, k] - x[:, k].mean(axis=1, keepdims=True)
            inner = np.swapaxes(b, 1, 2) @ b / n + np.eye(m)
            gain = np.linalg.solve(inner, np.swapaxes(b, 1, 2) @ a / n)
            x[:, k] += h @ gain
        a = x - x.mean(axis=2, keepdims=True)
        cov = np.swapaxes(a, 2, 3) @ a / n + np.eye(d)
        turn = np.linalg.cholesky(cov)
        return a @ np.swapaxes(turn, 2, 3)

    return call


@table("satellites", "numpy", "scipy", "xarray")
def rows() -> Iterator[Row]:
    satellites = studies.script("_satellites")
    setup = satellites.setup("table-3")
    t = float(setup.times[0])
    for kind in ("known_fused", "exact"):
        for runs, limit in LIMITS.items():
            f = satellites.repaired(setup, kind)
            rng = np.random.default_rng(1)
            _, seen = satellites.data(setup, rng, (runs,))
            state = f.start(setup.prior, rng=rng, runs=(runs,))
            calls = {
                "ours": partial(f.step, state, t, [y[0] for y in seen]),
                "floor": floor_of(setup, state.ensembles, rng),
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
