"""Does an agent that floods estimate better than the observer who sees all agents?

Slow interpretation of (23), peaked start, 15 s, 36 swarms: the observer from the kernel
estimate and from the flat Gaussian, and local filters by flooding. Errors are L2,
averaged from 10 s on.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _swarm as swarm

from bookkit.studies import spawn

NAME = "flooding"
PAPER = "zheng"
CHOICES = swarm.CHOICES
# Errors are averaged from then on, in s.
FROM = 10.0
CASE = swarm.Case(start="peaked", end=15.0)
columns = ["central", "central_flat", "flooding"]
parameters = {"seed": CHOICES["seed"], "end": CASE.end, "local": swarm.LOCAL}
seeds = spawn(CHOICES["seed"] + 4, 36)
scenarios = swarm.scenarios
rtol = 1e-4


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """One swarm."""
    # The observer from both starts, and eight local filters
    filters = {
        "central": swarm.make_filter("central", CASE),
        "central_flat": swarm.make_filter("central", CASE, initial_density="flat"),
        "flooding": swarm.make_filter("flooding", CASE),
    }
    run, _ = swarm.compare_filters(CASE, np.random.default_rng(seed), filters)
    # Means over time and over the local filters
    return {
        s: float(swarm.average(run[f"{s}_error"], CASE, FROM).mean()) for s in columns
    }


code = swarm.code
