"""Density filters of swarms of 50 to 10 000 agents, and on coarser and finer grids.

The slow interpretation of (23), peaked start, three runs. Sixteen local filters;
kernels narrow with the power that is best, and the radio's range keeps the number of
neighbours. Flooding up to 3000 agents, where the agents' tables take 200 MB; at 10 000
it would be eleven times that.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _swarm as swarm

from bookkit.studies import spawn

NAME = "growth"
PAPER = "zheng"
CHOICES = swarm.CHOICES
SIZES = (50, 100, 300, 1000, 3000, 10_000)
GRIDS = (15, 30, 60)
# Seconds, of which the last two are averaged
END = 6.0
FROM = 4.0
# Local filters, and the largest swarm that floods
N_LOCAL = 16
LARGEST_FLOODING = 3000
RULES = ("central", "paper", "average", "flooding")
# Of each rule of consensus: its error, and the numbers that an agent sends in a step
CONSENSUS_KINDS = ("consensus", "numbers")
KINDS = (
    "kde",
    "open",
    *RULES,
    *(f"{rule}_{kind}" for rule in RULES[1:] for kind in CONSENSUS_KINDS),
    "connected",
)
columns = [f"agents_{n}_{kind}" for n in SIZES for kind in KINDS]
columns += [f"cells_{n}_{kind}" for n in GRIDS for kind in KINDS]
parameters = {"seed": CHOICES["seed"], "end": END, "local": N_LOCAL}
seeds = spawn(CHOICES["seed"] + 3, 3)
scenarios = swarm.scenarios
rtol = 1e-4


def run_swarm(case: swarm.Case, rng: np.random.Generator) -> dict[str, float]:
    """Errors by rule, averaged over time, of one swarm; numbers sent by an agent in a step."""
    names = [s for s in RULES if s != "flooding" or case.agents <= LARGEST_FLOODING]
    filters = {s: swarm.make_filter(s, case, min(N_LOCAL, case.agents)) for s in names}
    connected: list[bool] = []

    def watch(
        t: float, x: np.ndarray, p: np.ndarray, states: dict[str, object]
    ) -> None:
        # The graph of this step is in one part.
        connected.append(states["paper"].parts == 1)

    run, ends = swarm.compare_filters(case, rng, filters, watch, every=10)
    # Means over the last two seconds
    late = {k: swarm.average(v, case, FROM).mean() for k, v in run.items()}
    values = {
        "kde": late["kde"],
        "open": late["open"],
        "connected": float(np.mean(connected)),
    }
    # NaN for flooding in the largest swarm
    values |= {s: late.get(f"{s}_error", np.nan) for s in RULES}
    # Numbers sent by one agent in one step
    steps = case.agents * END / swarm.SWARM["dt"]
    for s in RULES[1:]:
        sent = ends[s].ledger.scalars.sum() / steps if s in ends else np.nan
        values |= {
            f"{s}_consensus": late.get(f"{s}_consensus", np.nan),
            f"{s}_numbers": float(sent),
        }
    return values


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Every size once, and every grid."""
    values: dict[str, float] = {}
    draws = iter(seed.spawn(len(SIZES) + 1))
    # Every size has agents of its own.
    for n in SIZES:
        case = swarm.Case(start="peaked", end=END, agents=n)
        part = run_swarm(case, np.random.default_rng(next(draws)))
        values |= {f"agents_{n}_{k}": v for k, v in part.items()}
    # All grids have the same agents.
    same = next(draws)
    for n in GRIDS:
        case = swarm.Case(start="peaked", end=END, cells=(n, n))
        part = run_swarm(case, np.random.default_rng(same))
        values |= {f"cells_{n}_{k}": v for k, v in part.items()}
    return {name: float(values[name]) for name in columns}


code = (*swarm.code, run_swarm)
