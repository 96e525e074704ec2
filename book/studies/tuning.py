"""The paper's filter with every gain, with and without the own mean, with and without PCA.

Run on seeds of its own, so that the comparison of `table_2.py` and `table_3.py` is
fair: there the paper's filter runs with the best values of this study. All gains run at
once, as an axis of runs.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _satellites as satellites

from distfilt.network import mean_pull

NAME = "tuning"
PAPER = "grange"
BATCH = 1
# Below the largest stable gain of both graphs
GAINS = (0.0, 0.02, 0.05, 0.1, 0.15)
SETUPS = {"II": satellites.setup("table-2"), "III": satellites.setup("table-3")}
SETUP = SETUPS["II"]
VERSIONS = {
    f"{'pca' if pca else 'bare'}_{'self' if own else 'others'}": (pca, own)
    for pca in (False, True)
    for own in (True, False)
}
columns = [
    f"{t}_{v}_g{k}_{quantity}"
    for t in SETUPS
    for v in VERSIONS
    for k in range(len(GAINS))
    for quantity in ("mse", "nees")
]
parameters = {"gains": list(GAINS), "seed": 7, "runs": 8}
seeds = np.random.SeedSequence(7).spawn(8)
scenarios = tuple(s.scenario for s in SETUPS.values())
rtol = 1e-4


def every_gain(
    ensembles: np.ndarray, channel: Any, *, include_self: bool
) -> np.ndarray:
    """Pull (G, A, N, d) ensembles, each of the G with its own gain: (16) is linear in γ."""
    # (16) moves an ensemble in proportion to the gain.
    unit = 0.05
    moved = (
        mean_pull(ensembles, channel, gain=unit, include_self=include_self) - ensembles
    )
    gains = np.array(GAINS)[:, None, None, None]
    return np.asarray(ensembles + gains / unit * moved)


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """One run of each table, all versions on the same data."""
    metrics: dict[str, float] = {}
    for (table, s), part in zip(SETUPS.items(), seed.spawn(2), strict=True):
        # Both tables have data and draws of their own.
        for_data, for_filters = part.spawn(2)
        truth, seen = satellites.draw_data(s, np.random.default_rng(for_data), ())
        shape = (truth.shape[0], len(GAINS), truth.shape[-1])
        # One run of the data, as often as there are gains
        truth = np.broadcast_to(truth[:, None], shape)
        for name, (pca, include_self) in VERSIONS.items():
            f = satellites.paper_filter(s, pca=pca)
            # One gain for each of the runs, in place of the scenario's.
            rule = partial(every_gain, include_self=include_self)
            f = f.replace(fusion=rule)
            late = satellites.run_filter(s, f, for_filters, truth, seen).isel(
                time=s.settled
            )
            # Settled means over the agents, NEES per component; NaN where a run failed
            means = late.mean(("time", "agent"), skipna=False)
            error = means["total_squared_error"].values
            nees = means["nees"].values / s.model.dim
            for k in range(len(GAINS)):
                metrics[f"{table}_{name}_g{k}_mse"] = float(error[k])
                metrics[f"{table}_{name}_g{k}_nees"] = float(nees[k])
    return metrics


code = (every_gain, satellites.paper_filter, satellites.align_each)
