"""All hundred local filters of Zheng and Lin's swarm over the long run, not eight of them.

Slow interpretation of (23), uniform start, 60 s: the paper's gains, and flooding.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _swarm as swarm
import locals as figure

from bookkit.studies import spawn

NAME = "everyone"
PAPER = "zheng"
CHOICES = swarm.CHOICES
CASE = figure.CASE
RULES = ("paper", "flooding")
columns = ["kde", "central", *(f"{s}_{i}" for s in RULES for i in range(CASE.agents))]
parameters = {"seed": CHOICES["seed"], "end": CASE.end}
seeds = spawn(CHOICES["seed"] + 1, 1)
scenarios = swarm.scenarios
rtol = 1e-4


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """One run: every agent's error, averaged over time."""
    # A filter for each of the hundred agents, and the observer's
    filters = {s: swarm.make_filter(s, CASE, CASE.agents) for s in ("central", *RULES)}
    # Errors at every fifth step are enough for means over forty seconds.
    run, _ = swarm.compare_filters(CASE, np.random.default_rng(seed), filters, every=5)
    late = {k: swarm.average(v, CASE, CHOICES["average_from"]) for k, v in run.items()}
    # One column for each agent and rule
    errors = {"kde": late["kde"], "central": late["central_error"][0]}
    for s in RULES:
        errors |= {f"{s}_{i}": v for i, v in enumerate(late[f"{s}_error"])}
    return {name: float(errors[name]) for name in columns}


code = swarm.code
