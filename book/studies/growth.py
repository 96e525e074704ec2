"""Density filters of swarms of 50 to 10 000 agents, and on coarser and finer grids.

The slow reading of (23), peaked start. Sixteen local filters; kernels narrow with the power that
is best, and the radio's range keeps the number of neighbours. Flooding only up to a thousand
agents, where a table is 3000 numbers.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _swarm as swarm

from distfilt.studies import spawn

NAME, PAPER = "growth", "zheng"
CHOICES = swarm.CHOICES
SIZES, GRIDS = (50, 100, 300, 1000, 3000, 10_000), (15, 30, 60)
END, FROM, SIXTEEN, TABLES = 6.0, 4.0, 16, 1000
RULES = ("central", "paper", "average", "flooding")
columns = [
    *(f"{kind}_{n}_{k}" for kind, sizes in (("agents", SIZES), ("cells", GRIDS)) for n in sizes
      for k in ("kde", "open", *RULES, "consensus", "connected", "numbers")),
]
parameters = {"seed": CHOICES["seed"], "end": END, "local": SIXTEEN}
seeds = spawn(CHOICES["seed"] + 3, 1)
scenarios = swarm.scenarios
rtol = 1e-4


def one(case: swarm.Case, rng: np.random.Generator) -> dict[str, float]:
    """Errors by rule, averaged over time, of one swarm."""
    names = [s for s in RULES if s != "flooding" or case.agents <= TABLES]
    if case.agents > TABLES:
        names.remove("average")
    filters = {s: swarm.network(s, case, min(SIXTEEN, case.agents)) for s in names}
    parts: list[bool] = []

    def watch(t: float, x: np.ndarray, p: np.ndarray, states: dict[str, object]) -> None:
        parts.append(states["paper"].parts == 1)

    run, ends = swarm.compared(case, rng, filters, watch, every=10)
    late = {k: swarm.average(v, case, FROM).mean() for k, v in run.items()}
    sent = ends["paper"].ledger.scalars.sum() / case.agents / (END / swarm.SWARM["dt"])
    out = {"kde": late["kde"], "open": late["open"], "consensus": late["paper_consensus"],
           "connected": float(np.mean(parts)), "numbers": float(sent)}
    return out | {s: late.get(f"{s}_error", np.nan) for s in RULES}


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Every size once, and every grid."""
    out: dict[str, float] = {}
    draws = iter(seed.spawn(len(SIZES) + 1))
    for n in SIZES:
        case = swarm.Case(start="peaked", end=END, agents=n)
        found = one(case, np.random.default_rng(next(draws)))
        out |= {f"agents_{n}_{k}": v for k, v in found.items()}
    same = next(draws)
    for n in GRIDS:
        case = swarm.Case(start="peaked", end=END, cells=(n, n))
        found = one(case, np.random.default_rng(same))
        out |= {f"cells_{n}_{k}": v for k, v in found.items()}
    return {name: float(out[name]) for name in columns}


code = (*swarm.code, one)
