"""Fig. 1 of Zheng and Lin, six runs: local filters with the paper's gains, and flooding.

The slow interpretation of (23), uniform start, 60 s. One trial is one run of all
filters on the same agents. Errors are averaged over time: L2 distances from the density
of infinitely many agents, and RMS errors of the number of agents in 36 blocks.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _swarm as swarm

from bookkit.studies import spawn
from distfilt.filters import DensityFilter, DensityState

NAME = "locals"
PAPER = "zheng"
CHOICES = swarm.CHOICES
CASE = swarm.Case(end=float(swarm.densities.choice("end_times", "slowgibbs")))
NAMES = ("central", "paper", "flooding")
# Times of the curves, in s
MARKS = tuple(range(2, round(CASE.end) + 1, 2))
LINES = (
    "kde",
    "open",
    "open_flat",
    "central",
    *(f"{s}_{i}" for s in NAMES[1:] for i in range(swarm.LOCAL)),
)
# Blocks along a side in which agents are counted: by filters, and by their observations
BLOCKS = 6
COUNTERS = ("truth", *NAMES, *(f"{s}_observed" for s in NAMES))
columns = [
    *LINES,
    "central_20_40",
    "flooding_20_40",
    "central_half",
    "paper_consensus",
    "flooding_consensus",
    "central_below",
    "paper_below",
    "paper_caught",
    *(f"{s}_count" for s in COUNTERS),
    *(f"paper_{k}_{i}" for k in ("half", "falls") for i in range(swarm.LOCAL)),
    *(f"{line}_at_{t}" for line in LINES for t in MARKS),
]
parameters = {"seed": CHOICES["seed"], "end": CASE.end, "local": swarm.LOCAL}
seeds = spawn(CHOICES["seed"] + 1, CHOICES["runs"])
scenarios = swarm.scenarios
rtol = 1e-4


def below(error: np.ndarray, level: float) -> float:
    """Time from which an error stays below a level; the end if it never does."""
    above = np.flatnonzero(error > level)
    step = CASE.end / len(error)
    # The first error is that after one step; the last one above is followed by one below.
    first_below = above[-1] + 1 if above.size else 0
    return float(min((first_below + 1) * step, CASE.end))


def start_error(filter_: DensityFilter, seed: np.random.SeedSequence) -> float:
    """Return the mean L2 error of a run's local filters before the first step."""
    x, p = swarm.draw_swarm(CASE, np.random.default_rng(seed))
    return float(CASE.grid.norm(filter_.start(x).estimates - p).mean())


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """One run."""
    filters = {s: swarm.make_filter(s, CASE) for s in NAMES}
    counts: dict[str, list[float]] = {s: [] for s in COUNTERS}

    def count(
        t: float, x: np.ndarray, p: np.ndarray, states: dict[str, DensityState]
    ) -> None:
        # From the late time on, means over the local filters
        if t <= CHOICES["average_from"]:
            return
        counters = {"truth": p}
        counters |= {s: states[s].estimates for s in NAMES}
        counters |= {f"{s}_observed": states[s].observed for s in NAMES}
        for s, values in counters.items():
            errors = swarm.densities.count_errors(CASE.grid, values, x, BLOCKS)
            counts[s].append(float(errors.mean()))

    run, _ = swarm.compare_filters(CASE, np.random.default_rng(seed), filters, count)
    # Error curves by name: open loops, the observer, and each local filter
    lines = {n: run[n] for n in LINES[:3]} | {"central": run["central_error"][:, 0]}
    lines |= {
        f"{s}_{i}": run[f"{s}_error"][:, i]
        for s in NAMES[1:]
        for i in range(swarm.LOCAL)
    }
    late = CHOICES["average_from"]
    half = CASE.end / 2
    values = {n: swarm.average(e, CASE, late) for n, e in lines.items()}
    values |= {
        f"{n}_at_{t}": e[round(t / swarm.SWARM["dt"]) - 1]
        for n, e in lines.items()
        for t in MARKS
    }
    # Means from 20 to 40 s of the observer and of flooding
    for s in NAMES[:1] + NAMES[2:]:
        values[f"{s}_20_40"] = swarm.average(run[f"{s}_error"], CASE, 20.0, 40.0).mean()
    for s in NAMES[1:]:
        values[f"{s}_consensus"] = swarm.average(
            run[f"{s}_consensus"], CASE, late
        ).mean()
    local = run["paper_error"]
    # The kernel estimate's mean error, below which a filter has to stay
    level = float(run["kde"].mean())
    k = round(5.0 / swarm.SWARM["dt"])
    # The last five seconds over the first five
    falls = local[-k:].mean(axis=0) / local[:k].mean(axis=0)
    values |= {
        "central_half": swarm.average(lines["central"], CASE, half),
        "central_below": below(lines["central"], level),
        "paper_below": below(local.mean(axis=1), level),
    }
    # Caught up: below the kernel estimate, and below half of its own start
    start = start_error(filters["paper"], seed)
    values["paper_caught"] = below(local.mean(axis=1), min(level, start / 2))
    values |= {f"{s}_count": np.mean(errors) for s, errors in counts.items()}
    values |= {f"paper_falls_{i}": v for i, v in enumerate(falls)}
    values |= {
        f"paper_half_{i}": v for i, v in enumerate(swarm.average(local, CASE, half))
    }
    return {name: float(values[name]) for name in columns}


code = (*swarm.code, swarm.densities.count_errors, below, start_error)
