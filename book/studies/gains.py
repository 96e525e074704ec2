"""Interpretations of the consensus of Zheng and Lin, and Fig. 1 under each of them.

Gains per second or per step, where consensus starts, R as printed with a prior whose
mass may change, and the widths that the paper does not give: of the flat Gaussian and
of the kernel. Slow interpretation of (23), uniform start, 60 s.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _swarm as swarm
import locals as figure

from bookkit.studies import spawn
from distfilt.filters import DensityFilter
from distfilt.metrics import mean_interval

NAME = "gains"
PAPER = "zheng"
CHOICES = swarm.CHOICES
CASE = figure.CASE
# Widths of the flat Gaussian and of the kernel beside the scenario's .3 and .08
WIDE = 1.0
KERNELS = {"narrow": 0.05, "broad": 0.12}
INTERPRETATIONS = (
    # Gains per second: from the own kernel, and from the flat Gaussian
    "paper",
    "paper_flat",
    # Gains per step of 0.1 s
    "steps_flat",
    "steps_printed",
    # Other widths
    "paper_wide",
    "paper_narrow",
    "paper_broad",
)
CENTRALS = ("central", "central_printed", *(f"central_{k}" for k in KERNELS))
KINDS = ("error", "ratio", "ratio_high", "falls_high", "below")
columns = [
    "kde",
    *CENTRALS,
    *(f"{s}_below" for s in CENTRALS),
    *(f"{r}_{k}" for r in INTERPRETATIONS for k in KINDS),
]
parameters = {
    "seed": CHOICES["seed"],
    "end": CASE.end,
    "local": swarm.LOCAL,
    "wide": WIDE,
    "kernels": KERNELS,
}
seeds = spawn(CHOICES["seed"] + 1, 2)
scenarios = swarm.scenarios
rtol = 1e-4


def own_central(interpretation: str) -> str:
    """Return the centralised filter of the same R and kernel, for comparison."""
    name = f"central_{interpretation.split('_')[-1]}"
    return name if name in CENTRALS else "central"


def network(scheme: str) -> DensityFilter:
    """Return a scheme's filter; its name may choose another kernel or a wider flat Gaussian."""
    base, _, last = scheme.rpartition("_")
    if last in KERNELS:
        f = swarm.make_filter("paper_flat" if base == "paper" else base, CASE)
        return replace(f, bandwidth=KERNELS[last])
    if last == "wide":
        # The filter and the consensus start from the same Gaussian.
        f = swarm.make_filter("paper_flat", CASE)
        return replace(f, initial_std=WIDE, fusion=replace(f.fusion, initial_std=WIDE))
    return swarm.make_filter(scheme, CASE)


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """One run: per interpretation the statements of the caption, each from eight local filters."""
    filters = {s: network(s) for s in (*CENTRALS, *INTERPRETATIONS)}
    run, _ = swarm.compare_filters(CASE, np.random.default_rng(seed), filters)
    # The second half of the minute
    half = CASE.end / 2
    # A twelfth of the run: five seconds
    k = len(run["kde"]) // 12
    # The kernel estimate's mean error, below which a filter has to stay
    level = float(run["kde"].mean())
    values = {"kde": swarm.average(run["kde"], CASE, half)}
    for s in CENTRALS:
        values[s] = swarm.average(run[f"{s}_error"], CASE, half)[0]
        values[f"{s}_below"] = figure.below(run[f"{s}_error"][:, 0], level)
    for r in INTERPRETATIONS:
        error = run[f"{r}_error"]
        # Over the centralised filter with the same R and kernel
        ratio = mean_interval(swarm.average(error, CASE, half) / values[own_central(r)])
        falls = mean_interval(error[-k:].mean(axis=0) / error[:k].mean(axis=0))
        values |= {
            f"{r}_error": swarm.average(error, CASE, half).mean(),
            f"{r}_ratio": ratio.estimate,
            f"{r}_ratio_high": ratio.high,
            f"{r}_falls_high": falls.high,
            f"{r}_below": figure.below(error.mean(axis=1), level),
        }
    return {name: float(values[name]) for name in columns}


code = (*swarm.code, figure.below, network, own_central)
