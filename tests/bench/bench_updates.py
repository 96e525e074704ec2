"""The EnKF's analysis against DAPPER's and against six lines of numpy, for one ensemble.

A hundred members, a full noise covariance, half of the components observed. Shown beside the times:
how far the mean of the analysis is from the exact one, over many draws, in units of its standard
deviation, so that equal work is compared. Misses below the floors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from _bench import Row, interleaved, main, peer, table

from distfilt.updates import known_noise

MEMBERS, DIMS, DRAWS = 100, (6, 13, 40), 300
FLOORS = {"DAPPER, perturbed observations": 1.3, "six lines of numpy": 0.8}


def case(d: int) -> tuple[np.ndarray, ...]:
    """Members, predictions, observation, noise, and the exact posterior mean."""
    rng = np.random.default_rng(d)
    m = d // 2
    a, b = rng.standard_normal((d, d)) / np.sqrt(d), rng.standard_normal((m, m)) / np.sqrt(m)
    x = rng.standard_normal((MEMBERS, d)) @ (np.eye(d) + a)
    h, r = x[:, :m].copy(), b @ b.T + 0.5 * np.eye(m)
    y = rng.standard_normal(m)
    cov = np.cov(x.T)
    gain = np.linalg.solve(cov[:m, :m] + r, cov[:m])
    return x, h, y, r, x.mean(axis=0) + (y - h.mean(axis=0)) @ gain


def six_lines(x: np.ndarray, h: np.ndarray, y: np.ndarray, r: np.ndarray, rng: Any) -> np.ndarray:
    a, b = x - x.mean(axis=0), h - h.mean(axis=0)
    n = len(x) - 1
    cov = b.T @ b / n + r
    drawn = h + rng.standard_normal(h.shape) @ np.linalg.cholesky(r).T
    gain = np.linalg.solve(cov, b.T @ a / n)
    return x + (y - drawn) @ gain


def dapper(x: np.ndarray, h: np.ndarray, y: np.ndarray, r: np.ndarray) -> Callable[[], Any] | None:
    methods, randoms = peer("dapper.da_methods.ensemble"), peer("dapper.tools.randvars")
    if methods is None or randoms is None:
        return None
    noise = randoms.GaussRV(mu=np.zeros(len(r)), C=r)
    return lambda: methods.EnKF_analysis(x, h, noise, y, "PertObs")


def error(call: Callable[[], Any], exact: np.ndarray, spread: np.ndarray) -> float:
    means = np.array([np.asarray(call()).mean(axis=0) for _ in range(DRAWS)])
    return float(np.sqrt((((means - exact) / spread) ** 2).mean()))


@table("updates", "numpy", "scipy", "dapper")
def analyses() -> Iterator[Row]:
    for d in DIMS:
        x, h, y, r, exact = case(d)
        rng = np.random.default_rng(0)
        calls: dict[str, Any] = {
            "known_noise": partial(known_noise, x, h, y, r, rng=rng),
            "DAPPER, perturbed observations": dapper(x, h, y, r),
            "six lines of numpy": partial(six_lines, x, h, y, r, rng),
        }
        calls = {name: call for name, call in calls.items() if call is not None}
        times, ratios = interleaved(calls, 31)
        for name, call in calls.items():
            floor = FLOORS.get(name, 0)
            yield {
                "components": d, "readings": d // 2, "members": MEMBERS, "analysis": name,
                "us": f"{1e6 * times[name]:.1f}", "known_noise_is_faster": f"{ratios[name]:.2f}",
                "floor": floor or "", "mean_error": f"{error(call, exact, x.std(axis=0)):.3f}",
                "missed": ratios[name] < floor,
            }


if __name__ == "__main__":
    main()
