"""Batched Kalman filters against filterpy, and against what a user of numpy would write.

The linear case is that of chapter 1: 200 runs, 100 steps of the Clohessy-Wiltshire satellite, seen
by sensors that read (x, y), (y, z) and the velocity, without gaps and with gaps that differ; one of
the runs by the unscented filters too, of which ours needs no points where nothing is curved. In a
turn they see a distance and an angle, in a hundred runs and in one. Filterpy's gets all of its
points in one call. It is spared the density of each reading, for which scipy would take most of its
time; our Kalman filter finds it beside. Misses where results differ or a floor is not reached.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(1, str(Path(__file__).resolve().parents[2]))

import numpy as np
from _bench import Row, interleaved, main, table
from filterpy import kalman as filterpy

from distfilt.filters import GaussianFilter
from distfilt.kalman import filterpy_kf, filterpy_ukf, kalman_filter
from distfilt.models import clohessy_wiltshire, simulate
from distfilt.sensors import component, range_bearing, stack
from tests.support import turning

RUNS = 200
STEPS = 100
DT = 0.1
CURVED_RUNS = 100
CURVED_STEPS = 15
FLOORS = {
    ("common pattern", "filterpy"): 50.0,
    ("gaps that differ by run", "filterpy"): 12.0,
    ("gaps that differ by run", "plain numpy"): 1.0,
    ("unscented turn", "filterpy"): 10.0,
    ("unscented satellite, one run", "filterpy"): 3.0,
}


def linear_case(
    rng: np.random.Generator,
) -> tuple[tuple[np.ndarray, ...], dict[str, Any], Any]:
    """Prior mean and covariance and observations; the matrices; model, sensors and times."""
    model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    x0 = np.array([100.0, 0.0, 0.0, 10.0, 0.1, 0.0])
    sensor = stack(
        [
            component([0, 1], std=0.2),
            component([1, 2], std=0.2),
            component([3, 4, 5], std=0.1),
        ]
    )
    times = DT * np.arange(1, STEPS + 1)
    truth = simulate(model, np.tile(x0, (RUNS, 1)), times, rng=rng)
    matrices = {
        "F": model.F(DT),
        "H": sensor.H(6),
        "Q": model.Q(0.0, DT),
        "R": sensor.noise_cov,
    }
    parts = {"model": model, "sensors": (sensor,), "times": times}
    return (x0 + 3.0, 25.0 * np.eye(6), sensor.observe(truth, rng=rng)), matrices, parts


def plain_numpy(mean: Any, cov: Any, y: Any, *, F: Any, H: Any, Q: Any, R: Any) -> Any:
    """A covariance for each run, in Joseph's form, and the log density, as ours.

    A missing reading sees nothing, with variance one.
    """
    runs = y.shape[1]
    d = len(mean)
    x = np.tile(mean, (runs, 1))
    p = np.tile(cov, (runs, 1, 1))
    means = np.empty((len(y), runs, d))
    covs = np.empty((len(y), runs, d, d))
    density = np.empty((len(y), runs))
    for k, seen in enumerate(y):
        here = ~np.isnan(seen)
        h = H * here[..., None]
        both = here[..., :, None] & here[..., None, :]
        r = np.where(both, R, np.eye(len(R)))
        x = x @ F.T
        p = F @ p @ F.T + Q
        cross = h @ p
        inner = cross @ np.swapaxes(h, 1, 2) + r
        gain = np.swapaxes(np.linalg.solve(inner, cross), 1, 2)
        gap = np.where(here, seen - x @ H.T, 0.0)
        squares = (gap * np.linalg.solve(inner, gap[..., None])[..., 0]).sum(axis=-1)
        size = here.sum(axis=-1) * np.log(2 * np.pi)
        density[k] = -0.5 * (size + np.linalg.slogdet(inner)[1] + squares)
        x = x + (gain @ gap[..., None])[..., 0]
        rest = np.eye(d) - gain @ h
        p = rest @ p @ np.swapaxes(rest, 1, 2) + gain @ r @ np.swapaxes(gain, 1, 2)
        means[k] = x
        covs[k] = p
    return means, covs


def curved_case(
    rng: np.random.Generator,
) -> tuple[tuple[np.ndarray, ...], dict[str, Any]]:
    model = turning(sigma=0.1, turn_sigma=0.02)
    sensors = (range_bearing([0, 1], std=(0.3, 0.02), origin=[-9.0, -7.0]),)
    x0 = np.array([0.0, 0.0, 1.0, 0.5, 0.1])
    times = 0.5 * np.arange(1, CURVED_STEPS + 1)
    truth = simulate(model, np.tile(x0, (CURVED_RUNS, 1)), times, rng=rng)
    seen = sensors[0].observe(truth, rng=rng)
    given = x0, 0.05 * np.eye(model.dim), seen
    return given, {"model": model, "sensors": sensors, "times": times}


def unscented(
    mean: Any, cov: Any, y: Any, *, model: Any, sensors: Any, times: Any
) -> Any:
    f = GaussianFilter(model, sensors, linearization="unscented")
    states = list(f.steps(f.start((mean, cov), runs=y.shape[1:-1]), times, [y]))
    means = np.array([s.means[:, 0] for s in states])
    return means, np.array([s.covariances[:, 0] for s in states])


def moments(found: Any) -> tuple[np.ndarray, np.ndarray]:
    """Means and covariances of a filter's result, ours or a pair."""
    return found[:2] if isinstance(found, tuple) else (found.means, found.covariances)


def compared(
    case: str, functions: Any, rounds: int, *given: Any, **options: Any
) -> Iterator[Row]:
    """The table's rows: ours first, each other's time, our speed, and the largest difference."""
    calls = {name: partial(f, *given, **options) for name, f in functions.items()}
    results = {name: moments(call()) for name, call in calls.items()}
    times, ratios = interleaved(calls, rounds)
    first, mine = results["distfilt"]
    for name, (means, covs) in results.items():
        gap = np.abs(means - first).max() / np.abs(first).max()
        covs = covs.reshape(len(covs), -1, *covs.shape[-2:])
        own = mine.reshape(len(covs), -1, *covs.shape[-2:])
        gap = max(gap, np.abs(covs - own).max() / np.abs(own).max())
        floor = FLOORS.get((case, name), 0)
        yield {
            "case": case,
            "filter": name,
            "seconds": f"{times[name]:.4f}",
            "distfilt_is_faster": f"{ratios[name]:.2f}",
            "floor": floor or "",
            "gap": f"{gap:.0e}",
            "missed": gap > 1e-9 or ratios[name] < floor,
        }


@table("kalman", "numpy", "scipy", "filterpy")
def filters() -> Iterator[Row]:
    rng = np.random.default_rng(20260)
    (mean, cov, whole), matrices, parts = linear_case(rng)
    gaps = np.where(rng.random(whole.shape) < 0.1, np.nan, whole)
    filterpy.KalmanFilter.log_likelihood = (
        filterpy.UnscentedKalmanFilter.log_likelihood
    ) = 0.0
    calls = {
        "distfilt": kalman_filter,
        "filterpy": filterpy_kf,
        "plain numpy": plain_numpy,
    }
    for case, y in ("common pattern", whole), ("gaps that differ by run", gaps):
        yield from compared(case, calls, 5, mean, cov, y, **matrices)
    calls = {"distfilt": unscented, "filterpy": filterpy_ukf}
    one = slice(None, 1)
    yield from compared(
        "unscented satellite, one run", calls, 7, mean, cov, whole[:, one], **parts
    )
    (mean, cov, seen), options = curved_case(rng)
    yield from compared("unscented turn", calls, 3, mean, cov, seen, **options)
    yield from compared(
        "unscented turn, one run", calls, 7, mean, cov, seen[:, one], **options
    )


if __name__ == "__main__":
    main()
