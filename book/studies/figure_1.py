"""Fig. 1 of Grange et al.: the paper's filter with and without principal components, 100 runs.

With the 200 members of the figure, all agents at all steps; and with 13, for the claim
about small samples in Section V.B.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _satellites as satellites

NAME = "figure-1"
PAPER = "grange"
BATCH = 5
# The paper says "low-sample sizes" and prints none.
FEW = 13
SETUP = satellites.setup("table-2")
NAMES = {"bare": False, "pca": True}
columns = [
    c
    for name in NAMES
    for c in (
        *satellites.score_columns(SETUP, name, BATCH),
        *(f"{name}_few_mse_{r}" for r in range(BATCH)),
        *satellites.step_columns(SETUP, name),
        *satellites.time_columns(SETUP, name),
    )
]
parameters = {"batch": BATCH, "few": FEW, "seed": 2024}
seeds = np.random.SeedSequence(satellites.SEED).spawn(SETUP.runs // BATCH)
scenarios = (SETUP.scenario,)
rtol = 1e-4


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """A batch of runs of both versions, on the same data."""
    # Both versions have the same data; each has draws of its own.
    for_data, for_filters = seed.spawn(2)
    truth, seen = satellites.draw_data(SETUP, np.random.default_rng(for_data), (BATCH,))
    values: dict[str, float] = {}
    for name, pca in NAMES.items():
        f = satellites.paper_filter(SETUP, pca=pca)
        # The 200 members of the figure
        result = satellites.run_filter(SETUP, f, for_filters, truth, seen)
        values |= satellites.score_runs(SETUP, name, result)
        values |= satellites.step_series(SETUP, name, result)
        # Means over the agents, and NEES per component of the state
        error = result["total_squared_error"].mean("agent").values
        nees = result["nees"].mean("agent").values / SETUP.model.dim
        values |= satellites.time_series(name, error, nees)
        # The same data with few members
        small = satellites.paper_filter(replace(SETUP, members=FEW), pca=pca)
        result = satellites.run_filter(
            SETUP, small, for_filters, truth, seen, ("squared_error",)
        )
        values |= satellites.score_runs(SETUP, f"{name}_few", result, each_agent=False)
    return values


code = (
    satellites.draw_data,
    satellites.paper_filter,
    satellites.align_each,
    satellites.score_runs,
)
