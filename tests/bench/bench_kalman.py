"""The batched Kalman filter against a loop over filterpy: 500 runs, 200 steps, the same data.

    python tests/bench/bench_kalman.py

The case is the linear check of chapter 1: the Clohessy-Wiltshire satellite seen by three sensors
that read (x, y), (y, z) and the velocity. Ends with an error if the two filters disagree or a
required ratio is missed.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from _bench import timed, write

from distfilt.kalman import filterpy_kf, kalman_filter
from distfilt.models import clohessy_wiltshire, simulate
from distfilt.sensors import direct, stack

RUNS, STEPS, DT = 500, 200, 0.1
REQUIRED = {"common pattern": 50.0, "gaps that differ by run": 8.0}


def case(rng: np.random.Generator) -> tuple[tuple[np.ndarray, ...], dict[str, np.ndarray]]:
    """The filter's arguments: prior mean and covariance and observations, and the matrices."""
    model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    x0 = np.array([100.0, 0.0, 0.0, 10.0, 0.1, 0.0])
    sensor = stack(
        [direct([0, 1], std=0.2), direct([1, 2], std=0.2), direct([3, 4, 5], std=0.1)]
    )
    truth = simulate(model, np.tile(x0, (RUNS, 1)), DT * np.arange(1, STEPS + 1), rng=rng)
    matrices = {
        "F": model.transition(DT),
        "H": sensor.matrix(6),
        "Q": model.noise(0.0, DT),
        "R": sensor.cov,
    }
    return (x0 + 3.0, 25.0 * np.eye(6), sensor.observe(truth, rng=rng)), matrices


def main() -> int:
    rng = np.random.default_rng(20260)
    (mean, cov, whole), matrices = case(rng)
    gaps = np.where(rng.random(whole.shape) < 0.1, np.nan, whole)
    rows, missed = [], []
    for name, y in (("common pattern", whole), ("gaps that differ by run", gaps)):
        # Many repeats: a second BLAS thread spins on for a while after its last use.
        ours = timed(lambda y=y: kalman_filter(mean, cov, y, **matrices), 25)
        # Without the likelihood: filterpy is timed for what it cannot leave out.
        theirs = timed(lambda y=y: filterpy_kf(mean, cov, y, **matrices, likelihood=False), 3)
        scale = np.abs(theirs.result.means).max()
        gap = max(
            np.abs(ours.result.means - theirs.result.means).max() / scale,
            np.abs(ours.result.covariances - theirs.result.covariances).max(),
        )
        ratio = theirs.cpu / ours.cpu
        agrees = gap < 1e-12
        if not agrees or ratio < REQUIRED[name]:
            missed.append(name)
        rows.append(
            {
                "case": name,
                "runs": RUNS,
                "steps": STEPS,
                "batched_s": f"{ours.cpu:.4f}",
                "filterpy_s": f"{theirs.cpu:.3f}",
                "ratio": f"{ratio:.1f}",
                "required": f"{REQUIRED[name]:g}",
                "agrees_1e-12": "yes" if agrees else "no",
                "repeats": f"{ours.repeats} and {theirs.repeats}",
                "peak_mb": f"{theirs.peak_mb:.0f}",
            }
        )
    write("kalman", rows, ("numpy", "scipy", "filterpy"))
    for name in missed:
        print(f"missed: {name}", file=sys.stderr)
    return len(missed)


if __name__ == "__main__":
    sys.exit(main())
