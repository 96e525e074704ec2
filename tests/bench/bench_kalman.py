"""Batched Kalman filters against filterpy, and against plain numpy.

The linear case is that of chapter 1: 200 runs, 100 steps of the Clohessy-Wiltshire
satellite, seen by sensors that read (x, y), (y, z) and the velocity, without gaps and
with gaps that differ; one of the runs by the unscented filters too, of which ours needs
no points where nothing is curved. In a turn they see a distance and an angle, in a
hundred runs and in one. Filterpy's gets all of its points in one call. It is spared the
density of each observation, for which scipy would take most of its time; our Kalman
filter finds it beside. Misses where results differ or a floor is not reached.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(1, str(Path(__file__).resolve().parents[2]))

import numpy as np
from _bench import Row, compare_times, main, table
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
    # The prior is three off, within its standard deviation of five.
    mean = x0 + 3.0
    cov = 25.0 * np.eye(6)
    observed = sensor.observe(truth, rng=rng)
    return (mean, cov, observed), matrices, parts


def plain_numpy(mean: Any, cov: Any, y: Any, *, F: Any, H: Any, Q: Any, R: Any) -> Any:
    """A covariance for each run, in Joseph's form, and the log density, as ours.

    A missing observation sees nothing, with variance one.
    """
    runs = y.shape[1]
    d = len(mean)
    x = np.tile(mean, (runs, 1))
    p = np.tile(cov, (runs, 1, 1))
    means = np.empty((len(y), runs, d))
    covs = np.empty((len(y), runs, d, d))
    density = np.empty((len(y), runs))
    for k, seen in enumerate(y):
        present = ~np.isnan(seen)
        h = H * present[..., None]
        # R of the present components, and the identity for missing ones
        pairs = present[..., :, None] & present[..., None, :]
        r = np.where(pairs, R, np.eye(len(R)))
        x = x @ F.T
        p = F @ p @ F.T + Q
        # S = H P Hᵀ + R and K = P Hᵀ S⁻¹
        cross = h @ p
        S = cross @ np.swapaxes(h, 1, 2) + r
        gain = np.swapaxes(np.linalg.solve(S, cross), 1, 2)
        innovation = np.where(present, seen - x @ H.T, 0.0)
        whitened = np.linalg.solve(S, innovation[..., None])[..., 0]
        squares = (innovation * whitened).sum(axis=-1)
        # log N(y; H x, S) = -½ (m log 2π + log |S| + dᵀ S⁻¹ d)
        log_two_pi = present.sum(axis=-1) * np.log(2 * np.pi)
        density[k] = -0.5 * (log_two_pi + np.linalg.slogdet(S)[1] + squares)
        x = x + (gain @ innovation[..., None])[..., 0]
        factor = np.eye(d) - gain @ h
        # Joseph's form: (I - K H) P (I - K H)ᵀ + K R Kᵀ
        propagated = factor @ p @ np.swapaxes(factor, 1, 2)
        p = propagated + gain @ r @ np.swapaxes(gain, 1, 2)
        means[k] = x
        covs[k] = p
    return means, covs


def turning_case(
    rng: np.random.Generator,
) -> tuple[tuple[np.ndarray, ...], dict[str, Any]]:
    # A turn seen by a sensor some way off: range and bearing are both curved.
    model = turning(sigma=0.1, turn_sigma=0.02)
    sensors = (range_bearing([0, 1], std=(0.3, 0.02), origin=[-9.0, -7.0]),)
    x0 = np.array([0.0, 0.0, 1.0, 0.5, 0.1])
    times = 0.5 * np.arange(1, CURVED_STEPS + 1)
    truth = simulate(model, np.tile(x0, (CURVED_RUNS, 1)), times, rng=rng)
    seen = sensors[0].observe(truth, rng=rng)
    inputs = x0, 0.05 * np.eye(model.dim), seen
    return inputs, {"model": model, "sensors": sensors, "times": times}


def run_unscented(
    mean: Any, cov: Any, y: Any, *, model: Any, sensors: Any, times: Any
) -> Any:
    f = GaussianFilter(model, sensors, linearization="unscented")
    start = f.start((mean, cov), runs=y.shape[1:-1])
    states = list(f.steps(start, times, [y]))
    means = np.array([s.means[:, 0] for s in states])
    return means, np.array([s.covariances[:, 0] for s in states])


def moments(found: Any) -> tuple[np.ndarray, np.ndarray]:
    """Means and covariances of a filter's result, ours or a pair."""
    return found[:2] if isinstance(found, tuple) else (found.means, found.covariances)


def compare_filters(
    case: str, functions: Any, rounds: int, *inputs: Any, **options: Any
) -> Iterator[Row]:
    """The table's rows: ours first, each other's time, our speed, and the largest difference."""
    calls = {name: partial(f, *inputs, **options) for name, f in functions.items()}
    results = {name: moments(call()) for name, call in calls.items()}
    times, ratios = compare_times(calls, rounds)
    first_means, first_covs = results["distfilt"]
    for name, (means, covs) in results.items():
        difference = np.abs(means - first_means).max() / np.abs(first_means).max()
        # The library keeps one covariance for all runs where they are equal.
        covs = covs.reshape(len(covs), -1, *covs.shape[-2:])
        expected = first_covs.reshape(len(covs), -1, *covs.shape[-2:])
        difference = max(
            difference, np.abs(covs - expected).max() / np.abs(expected).max()
        )
        floor = FLOORS.get((case, name), 0)
        yield {
            "case": case,
            "filter": name,
            "seconds": f"{times[name]:.4f}",
            "distfilt_is_faster": f"{ratios[name]:.2f}",
            "floor": floor or "",
            "gap": f"{difference:.0e}",
            "missed": difference > 1e-9 or ratios[name] < floor,
        }


@table("kalman", "numpy", "scipy", "filterpy")
def filters() -> Iterator[Row]:
    rng = np.random.default_rng(20260)
    (mean, cov, observed), matrices, parts = linear_case(rng)
    # A tenth of all components is missing, in each run another one.
    with_gaps = np.where(rng.random(observed.shape) < 0.1, np.nan, observed)
    # Spare filterpy the density of each observation.
    filterpy.KalmanFilter.log_likelihood = (
        filterpy.UnscentedKalmanFilter.log_likelihood
    ) = 0.0
    calls = {
        "distfilt": kalman_filter,
        "filterpy": filterpy_kf,
        "plain numpy": plain_numpy,
    }
    for case, y in ("common pattern", observed), ("gaps that differ by run", with_gaps):
        yield from compare_filters(case, calls, 5, mean, cov, y, **matrices)
    calls = {"distfilt": run_unscented, "filterpy": filterpy_ukf}
    one = slice(None, 1)
    yield from compare_filters(
        "unscented satellite, one run", calls, 7, mean, cov, observed[:, one], **parts
    )
    (mean, cov, seen), options = turning_case(rng)
    yield from compare_filters("unscented turn", calls, 3, mean, cov, seen, **options)
    yield from compare_filters(
        "unscented turn, one run", calls, 7, mean, cov, seen[:, one], **options
    )


if __name__ == "__main__":
    main()
