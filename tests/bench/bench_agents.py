"""One step of the network's filter against the number of agents, on a row of agents.

Each agent hears two others whatever the number, so a step should grow in proportion. Writes
data/bench/agents.csv with the slope of log time over log agents; fails above slope 1.3.
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

import numpy as np
from _bench import timed, write

from distfilt.filters import EnsembleFilter
from distfilt.models import clohessy_wiltshire
from distfilt.network import graphs, intersection, pull
from distfilt.sensors import direct
from distfilt.updates import known_noise, transport

AGENTS, RUNS, MEMBERS, LIMIT = (4, 8, 16, 32, 64), 10, 200, 1.3
FILTERS: dict[str, tuple[Any, Any]] = {
    "affine map, pull": (transport, partial(pull, gain=0.05)),
    "known noise, intersection": (known_noise, partial(intersection, rule="equal")),
}


def step_ms(agents: int, update: Any, agreement: Any) -> float:
    """Milliseconds of one step of a batch of runs."""
    sensors = [direct([k % 6], std=0.2) for k in range(agents)]
    model = clohessy_wiltshire(rate=0.1, sigma=0.2)
    f = EnsembleFilter(
        model, sensors, graphs.path(agents), update=update, agreement=agreement, members=MEMBERS
    )
    state = f.start((np.zeros(6), 25 * np.eye(6)), rng=np.random.default_rng(1), runs=(RUNS,))
    seen = [np.zeros(1)] * agents
    return 1e3 * timed(lambda: f.step(state, 0.1, seen), 5).cpu


def main() -> int:
    """Measure, write the table, and count slopes above the limit."""
    rows, missed = [], 0
    for name, (update, agreement) in FILTERS.items():
        spent = [step_ms(a, update, agreement) for a in AGENTS]
        slope = np.polyfit(np.log(AGENTS), np.log(spent), 1)[0]
        missed += slope > LIMIT
        rows += [
            {"filter": name, "agents": a, "runs": RUNS, "step_ms": f"{ms:.1f}",
             "slope": f"{slope:.2f}", "limit": LIMIT}
            for a, ms in zip(AGENTS, spent, strict=True)
        ]
    write("agents", rows, ("numpy", "scipy"))
    return int(missed)


if __name__ == "__main__":
    sys.exit(main())
