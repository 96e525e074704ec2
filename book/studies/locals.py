"""Fig. 1 of Zheng and Lin, six runs: local filters with the paper's gains, and flooding.

The slow reading of (23), uniform start, 60 s. One trial is one run of all filters on the same
agents; errors are L2, averaged over time.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _swarm as swarm

from distfilt.studies import spawn

NAME, PAPER = "locals", "zheng"
CHOICES = swarm.CHOICES
CASE = swarm.Case(end=float(CHOICES["end_times"][CHOICES["readings"].index("slowgibbs")]))
NAMES = ("central", "paper", "flooding")
columns = [
    "kde", "open", "open_flat", "central", "central_20_40", "flooding_20_40",
    "paper_consensus", "flooding_consensus", "central_below", "paper_below", "falls_high",
    *(f"{s}_{i}" for s in NAMES[1:] for i in range(swarm.LOCAL)),
]
parameters = {"seed": CHOICES["seed"], "end": CASE.end, "local": swarm.LOCAL}
seeds = spawn(CHOICES["seed"] + 1, CHOICES["runs"])
scenarios = swarm.scenarios
rtol = 1e-4


def below(error: np.ndarray, level: float) -> float:
    """Time from which an error stays below a level; the end if it never does."""
    above = np.flatnonzero(error > level)
    return 0.0 if not above.size else float(above[-1] + 1) * CASE.end / len(error)


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """One run."""
    filters = {s: swarm.network(s, CASE) for s in NAMES}
    run, _ = swarm.compared(CASE, np.random.default_rng(seed), filters)
    late = {k: swarm.average(v, CASE, CHOICES["average_from"]) for k, v in run.items()}
    locals_, level = run["paper_error"], float(run["kde"].mean())
    k = len(locals_) // 12
    falls = locals_[-k:].mean(axis=0) / locals_[:k].mean(axis=0)
    out = {
        "kde": late["kde"], "open": late["open"], "open_flat": late["open_flat"],
        "central": late["central_error"][0],
        "paper_consensus": late["paper_consensus"].mean(),
        "flooding_consensus": late["flooding_consensus"].mean(),
        "central_below": below(run["central_error"][:, 0], level),
        "paper_below": below(locals_.mean(axis=1), level),
        "falls_high": falls.max(),
    }
    for s in ("central", "flooding"):
        out[f"{s}_20_40"] = swarm.average(run[f"{s}_error"], CASE, 20.0, 40.0).mean()
    for s in NAMES[1:]:
        out |= {f"{s}_{i}": v for i, v in enumerate(late[f"{s}_error"])}
    return {name: float(out[name]) for name in columns}


code = (*swarm.code, below)
