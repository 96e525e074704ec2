"""The truncation of the shared basis, against the dense filter on the paper's own grid.

The slow interpretation of (23), in whose covariance the most waves survive: all filters
have the same kernel estimates and the same noise, and differ in the number of columns.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import densities

from bookkit.studies import spawn
from distfilt import density

NAME = "truncation"
PAPER = "zheng"
CHOICES = densities.CHOICES
DT = densities.SWARM["dt"]
# Columns of the shared basis, and times of the comparison in s
RANKS = (20, 40, 60, 100, 200)
TIMES = (1, 3, 10, 30)
columns = [f"rank_{r}_{t}" for r in RANKS for t in TIMES] + [
    f"error_{t}" for t in TIMES
]
parameters = {"seed": CHOICES["seed"], "ranks": RANKS, "times": TIMES}
seeds = spawn(CHOICES["seed"] + 4, 1)
scenarios = (densities.SWARM, CHOICES)
rtol = 1e-3


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """One run: relative distances from the dense filter, and its own relative error."""
    cells = densities.grid()
    rng = np.random.default_rng(seed)
    swarm = densities.swarm("slowgibbs")
    h = CHOICES["bandwidth"]
    flow = density.FokkerPlanck(swarm, cells)
    agents = int(densities.SWARM["agents"])
    # All waves but the constant one
    full = density.zero_mean_prior(
        cells,
        rank=cells.size - 1,
        length=CHOICES["prior_length"],
        std=CHOICES["prior_std"],
    )
    # Agents start evenly.
    x = rng.random((agents, 2))
    p = np.ones(cells.size)
    y = density.kernel_density(x, cells, bandwidth=h)
    # The dense filter has the whole covariance, the others its leading columns.
    dense = density.Dense(y, full @ full.T)
    cut = {r: density.low_rank_start(full[:, :r], y[None]) for r in RANKS}
    k = density.kernel_constant(cells, bandwidth=h, agents=agents)
    metrics: dict[str, float] = {}
    for j in range(round(TIMES[-1] / DT)):
        move = flow.solver(j * DT, DT)
        x = swarm.step(x, j * DT, DT, rng=rng, substeps=CHOICES["substeps"])
        p = move(p)
        y = density.kernel_density(x, cells, bandwidth=h)
        # All filters get the noise of the dense forecast.
        noise = k * np.maximum(move(dense.mean), CHOICES["floor"])
        dense = density.dense_step(dense, move, y, noise, DT)
        cut = {
            r: density.low_rank_step(density.low_rank_predict(s, move), y, noise, DT)
            for r, s in cut.items()
        }
        t = round((j + 1) * DT, 6)
        if t in TIMES:
            # Distances relative to the dense estimate's size
            size = np.linalg.norm(dense.mean)
            metrics |= {
                f"rank_{r}_{t:.0f}": np.linalg.norm(s.estimates[0] - dense.mean) / size
                for r, s in cut.items()
            }
            metrics[f"error_{t:.0f}"] = np.linalg.norm(dense.mean - p) / size
    return {name: float(metrics[name]) for name in columns}


code: tuple[object, ...] = ()
