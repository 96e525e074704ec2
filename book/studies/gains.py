"""Readings of what Zheng and Lin leave open about consensus, and what Fig. 1 looks like in each.

Gains per second or per step, a larger integral gain, where consensus starts, and R as printed with
a prior whose mass may change. Slow reading of (23), uniform start, 60 s.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _swarm as swarm
import locals as figure

from distfilt.metrics import mean_interval
from distfilt.studies import spawn

NAME, PAPER = "gains", "zheng"
CHOICES, CASE = swarm.CHOICES, figure.CASE
READINGS = ("paper", "paper_flat", "fast", "fast_flat", "steps_flat",
            "steps_printed")
KINDS = ("error", "ratio", "ratio_high", "falls_high", "below")
columns = ["kde", "central", "central_printed", "central_below", "central_printed_below",
           *(f"{r}_{k}" for r in READINGS for k in KINDS)]
parameters = {"seed": CHOICES["seed"], "end": CASE.end, "local": swarm.LOCAL}
seeds = spawn(CHOICES["seed"] + 1, 2)
scenarios = swarm.scenarios
rtol = 1e-4


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """One run: per reading the claims of the caption, each from eight local filters."""
    filters = {s: swarm.network(s, CASE) for s in ("central", "central_printed", *READINGS)}
    run, _ = swarm.compared(CASE, np.random.default_rng(seed), filters)
    half, k, level = CASE.end / 2, len(run["kde"]) // 12, float(run["kde"].mean())
    out = {"kde": swarm.average(run["kde"], CASE, half)}
    for s in ("central", "central_printed"):
        out[s] = swarm.average(run[f"{s}_error"], CASE, half)[0]
        out[f"{s}_below"] = figure.below(run[f"{s}_error"][:, 0], level)
    for r in READINGS:
        error = run[f"{r}_error"]
        own = "central_printed" if r.endswith("printed") else "central"
        ratio = mean_interval(swarm.average(error, CASE, half) / out[own])
        falls = mean_interval(error[-k:].mean(axis=0) / error[:k].mean(axis=0))
        out |= {
            f"{r}_error": swarm.average(error, CASE, half).mean(),
            f"{r}_ratio": ratio.estimate, f"{r}_ratio_high": ratio.high,
            f"{r}_falls_high": falls.high,
            f"{r}_below": figure.below(error.mean(axis=1), level),
        }
    return {name: float(out[name]) for name in columns}


code = (*swarm.code, figure.below)
