"""Better filters for Table III of Grange et al., on the data of Fig. 2, run by run.

The paper's filter as printed and as `tuning.py` has tuned it, each repair alone, the
best method, and a central multiplicative extended Kalman filter as the near-exact
reference.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _satellites as satellites

from distfilt.kalman import QuaternionChart, mekf

NAME = "table-3"
PAPER = "grange"
BATCH = 4
SETUP = satellites.setup("table-3")
# The best setting of tuning.py for this table
TUNED = {"pca": False, "include_self": False, "gain": 0.1}
REPAIRS = ("known_pulled", "known_fused", "exact")
TIMED = ("bare", "exact")
columns = [
    *(
        c
        for name in ("bare", "tuned", *REPAIRS)
        for c in satellites.score_columns(SETUP, name, BATCH)
    ),
    *(f"central_{quantity}_{r}" for quantity in ("mse", "nees") for r in range(BATCH)),
    *(c for name in (*TIMED, "central") for c in satellites.time_columns(SETUP, name)),
]
parameters = {"batch": BATCH, "seed": 2025, "tuned": TUNED}
seeds = np.random.SeedSequence(satellites.SEED + 1).spawn(SETUP.runs // BATCH)
scenarios = (SETUP.scenario,)
rtol = 1e-4


def run_central(truth: np.ndarray, seen: list[np.ndarray]) -> dict[str, float]:
    """The multiplicative filter of all sensors: twelve errors, three of them of the attitude."""
    chart = QuaternionChart(13, 9)
    (mean, cov) = SETUP.prior
    # The prior mean's quaternion is scaled to length one.
    # The filter needs an attitude, a quaternion of length one.
    unit = np.concatenate([mean[:9], mean[9:] / np.linalg.norm(mean[9:])])
    result = mekf(
        unit,
        chart.project(mean, cov),
        np.concatenate(seen, axis=-1),
        chart=chart,
        model=SETUP.model,
        sensors=SETUP.sensors,
        times=SETUP.times,
    )
    # Squared error of all 13 components, as for the ensembles
    error = ((result.means - truth) ** 2).sum(axis=-1)
    # NEES in the twelve error components of the chart
    local = chart.local(result.means, truth)
    score = (local * np.linalg.solve(result.covariances, local[..., None])[..., 0]).sum(
        axis=-1
    )
    score = score / chart.error_dim
    # Settled means, run by run
    late = SETUP.settled
    values = satellites.time_series("central", error, score)
    for r in range(error.shape[1]):
        values[f"central_mse_{r}"] = float(error[late, r].mean())
        values[f"central_nees_{r}"] = float(score[late, r].mean())
    return values


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """A batch of runs of every filter, on the data of the same batch of Fig. 2."""
    # All filters have the same data; each has draws of its own.
    for_data, for_filters = seed.spawn(2)
    truth, seen = satellites.draw_data(SETUP, np.random.default_rng(for_data), (BATCH,))
    filters = {
        "bare": satellites.paper_filter(SETUP, pca=False),
        "tuned": satellites.paper_filter(SETUP, **TUNED),
    }
    # Known noise, fusion by covariance intersection, and both with exact draws
    filters |= {name: satellites.better_filter(SETUP, name) for name in REPAIRS}
    values = run_central(truth, seen)
    for name, f in filters.items():
        result = satellites.run_filter(SETUP, f, for_filters, truth, seen)
        values |= satellites.score_runs(SETUP, name, result)
        if name in TIMED:
            # Means over the agents, at every fifth step
            error = result["total_squared_error"].mean("agent").values
            score = result["nees"].mean("agent").values / SETUP.model.dim
            values |= satellites.time_series(name, error, score)
    return values


def part(seed: np.random.SeedSequence) -> dict[str, float]:
    """Exact draws and the central filter, as in the trial, for chapter 4 to run again."""
    for_data, for_filters = seed.spawn(2)
    truth, seen = satellites.draw_data(SETUP, np.random.default_rng(for_data), (BATCH,))
    for_filters.spawn(4)  # of the four filters that run before it in the trial
    f = satellites.better_filter(SETUP, "exact")
    result = satellites.run_filter(SETUP, f, for_filters, truth, seen)
    return satellites.score_runs(SETUP, "exact", result) | run_central(truth, seen)


code = (
    run_central,
    satellites.draw_data,
    satellites.paper_filter,
    satellites.better_filter,
)
