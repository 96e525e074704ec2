"""Consensus protocols compared, and under faults: losses, dropout, a wrong model.

A peaked start for the table of rules; agents that drop out; and filters whose f is out
of phase, with and without process noise. Errors over time of the first and the last,
for a figure.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _swarm as swarm

from bookkit.studies import spawn

NAME = "variants"
PAPER = "zheng"
CHOICES = swarm.CHOICES
RULES = (
    "central",
    "paper",
    "paper_half",
    "fast",
    "average",
    "flooding",
    "flooding_half",
    "neighbours",
)
# All rules, slow interpretation
TABLE = swarm.Case(start="peaked", end=15.0)
# The fast interpretation, with the right and with a wrong model
QUICK = swarm.Case(interpretation="gibbs", start="peaked", end=15.0)
WRONG = swarm.Case(
    interpretation="gibbs", start="peaked", end=15.0, phase=CHOICES["wrong_phase"]
)
# A fifth of the agents drops out.
DROP = swarm.Case(start="peaked", end=15.0, gone=swarm.SHARING["gone"])
DROPS = ("central", "paper", "flooding", "flooding_forgets")
BASES = ("central", "paper", "flooding")
OPEN = ("kde", "open", "open_flat")
# Times of the curves, in s
MARKS = tuple(range(1, 16))
CURVES = {
    "table": (*OPEN, *BASES),
    "wrong": (*OPEN, *(f"{s}_{q}" for s in BASES for q in ("exact", "process"))),
}
columns = [
    *(f"table_{s}_{k}" for s in RULES for k in ("error", "consensus", "nees", "crps")),
    *(f"table_{n}" for n in OPEN),
    *(f"gibbs_{s}" for s in (*OPEN, *BASES)),
    *(f"drop_{s}_{k}" for s in DROPS for k in ("error", "consensus", "counted")),
    *(f"drop_{n}" for n in OPEN),
    *(f"wrong_{s}_{q}" for s in BASES for q in ("exact", "process")),
    *(f"wrong_{n}" for n in OPEN),
    *(
        f"{case}_{line}_at_{t}"
        for case, lines in CURVES.items()
        for line in lines
        for t in MARKS
    ),
]
parameters = {"seed": CHOICES["seed"], "local": 3, "rules": RULES}
seeds = spawn(CHOICES["seed"] + 2, 2)
scenarios = swarm.scenarios
rtol = 1e-4


def final_scores(state: object, p: np.ndarray) -> dict[str, float]:
    """NEES and CRPS per cell at the end."""
    from distfilt.metrics import gaussian_crps

    # Of a Gaussian in each cell; a variance of zero up to rounding is a small one.
    gap = state.estimates - p
    variance = np.maximum(state.variances, 1e-12)
    return {
        "nees": (gap**2 / variance).mean(),
        "crps": gaussian_crps(0 * gap, np.sqrt(variance), gap).mean(),
    }


def curves(key: str, run: dict[str, np.ndarray]) -> dict[str, float]:
    """Return errors at the marks by rule, means over the local filters."""
    dt = swarm.SWARM["dt"]
    # References have one error a step, rules one for each local filter.
    lines = {
        n: run[n] if n in OPEN else run[f"{n}_error"].mean(axis=1) for n in CURVES[key]
    }
    return {
        f"{key}_{n}_at_{t}": e[round(t / dt) - 1]
        for n, e in lines.items()
        for t in MARKS
    }


def wrong_model(rng: np.random.Generator) -> dict[str, float]:
    """Local filters whose f is out of phase, with Q = 0 and with Q > 0."""
    # Process noise in proportion to the leading modes of the prior
    scale = swarm.densities.choice("process_scale", "gibbs")
    filters = {f"{s}_exact": swarm.make_filter(s, WRONG, 3) for s in BASES}
    filters |= {
        f"{s}_process": swarm.make_filter(
            s, WRONG, 3, process=scale, rank=CHOICES["low_rank"]
        )
        for s in BASES
    }
    # All on the same agents
    run, _ = swarm.compare_filters(WRONG, rng, filters)
    errors = {
        f"wrong_{s}": swarm.average(run[f"{s}_error"], WRONG, 10.0).mean()
        for s in filters
    }
    errors |= {f"wrong_{n}": swarm.average(run[n], WRONG, 10.0) for n in OPEN}
    return errors | curves("wrong", run)


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """One run of each case."""
    # Each case has agents of its own.
    table, quick, drop, wrong = (np.random.default_rng(s) for s in seed.spawn(4))
    # The true density at the end of a case
    last: list[np.ndarray] = [np.empty(0)]

    def keep(t: float, x: np.ndarray, p: np.ndarray, states: object) -> None:
        last[0] = p

    metrics: dict[str, float] = {}
    for case, rng, names, key in (
        (TABLE, table, RULES, "table"),
        (QUICK, quick, BASES, "gibbs"),
        (DROP, drop, DROPS, "drop"),
    ):
        filters = {s: swarm.make_filter(s, case, 3) for s in names}
        run, ends = swarm.compare_filters(case, rng, filters, keep)
        # Means from 10 s on
        late = {k: swarm.average(v, case, 10.0) for k, v in run.items()}
        metrics |= {f"{key}_{n}": late[n] for n in OPEN}
        if key == "table":
            metrics |= curves(key, run)
        for s in names:
            # Of the fast case only errors are stored.
            if key == "gibbs":
                metrics[f"gibbs_{s}"] = late[f"{s}_error"].mean()
                continue
            metrics[f"{key}_{s}_error"] = late[f"{s}_error"].mean()
            metrics[f"{key}_{s}_consensus"] = late[f"{s}_consensus"].mean()
            # Number of agents that each believes there are
            metrics[f"{key}_{s}_counted"] = float(np.median(ends[s].positions_sent[:3]))
            metrics |= {
                f"{key}_{s}_{k}": v for k, v in final_scores(ends[s], last[0]).items()
            }
    metrics |= wrong_model(wrong)
    return {name: float(metrics[name]) for name in columns}


code = (*swarm.code, final_scores, wrong_model, curves)
