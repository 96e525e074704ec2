"""A swarm's local density filters: the paper's, its variants, and flooding, on the same agents.

Chapter 10 runs it live: every scheme sees the same positions, with eight local filters.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np

from distfilt import density
from distfilt.filters import DensityFilter
from distfilt.network import Faults

sys.path.insert(0, str(Path(__file__).parent))
import densities

SWARM, CHOICES = densities.SWARM, densities.CHOICES
LOCAL, END = 8, 20.0
GAINS = {"alpha": SWARM["pi_alpha"], "a": SWARM["pi_proportional"]}
PAPERS = {**GAINS, "b": SWARM["pi_integral"]}
FAST = {**GAINS, "b": 10 * SWARM["pi_integral"]}
SCHEMES: dict[str, tuple[Any, dict[str, Any]]] = {
    "central": (density.Centralised(), {"first": "observed"}),
    "paper": (density.PIConsensus(modes=64, **PAPERS), {}),
    "fast": (density.PIConsensus(modes=64, **FAST), {}),
    "average": (density.DynamicAverage(), {}),
    "flooding": (density.Flooding(), {}),
    "flooding_half": (density.Flooding(), {"faults": Faults(loss=0.5, seed=3)}),
    "paper_half": (density.PIConsensus(modes=64, **PAPERS), {"faults": Faults(loss=0.5, seed=3)}),
    "neighbours": (density.Neighbours(), {}),
}


def network(scheme: str, reading: str, agents: int, local: int = LOCAL) -> DensityFilter:
    """A scheme's filter with the scenario's choices."""
    sharing, options = SCHEMES[scheme]
    model = density.FokkerPlanck(densities.swarm(reading), densities.grid())
    return DensityFilter(
        model, agents, SWARM["radio_range"], sharing, bandwidth=CHOICES["bandwidth"],
        local=(0,) if scheme == "central" else tuple(range(local)), rank=CHOICES["rank"],
        prior_length=CHOICES["prior_length"], prior_std=CHOICES["prior_std"],
        first_std=CHOICES["local_prior_std"], floor=CHOICES["floor"], **options,
    )


def compared(
    reading: str, start: str, rng: np.random.Generator, schemes: Any = tuple(SCHEMES),
    end: float = END, local: int = LOCAL, watch: Any = None,
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Errors over time, (T, filters) or (T,), and the last states, by scheme."""
    cells, dt, n = densities.grid(), SWARM["dt"], int(SWARM["agents"])
    swarm = densities.swarm(reading)
    x, p = densities.first_agents(start, n, rng), densities.first_density(start)
    filters = {s: network(s, reading, n, local) for s in schemes}
    states = {s: f.start(x) for s, f in filters.items()}
    model = density.FokkerPlanck(swarm, cells)
    opened = np.stack([density.kernel_density(x, cells, bandwidth=CHOICES["bandwidth"]),
                       density.kernels(x[:1], cells, bandwidth=CHOICES["local_prior_std"])[0]])
    out: dict[str, list[Any]] = {}

    def note(name: str, value: Any) -> None:
        out.setdefault(name, []).append(value)

    for j in range(round(end / dt)):
        x = swarm.step(x, j * dt, dt, rng=rng, substeps=CHOICES["substeps"])
        p, *opened = model.step(np.stack([p, *opened]), j * dt, dt)
        y = density.kernel_density(x, cells, bandwidth=CHOICES["bandwidth"])
        for s, f in filters.items():
            states[s] = f.step(states[s], (j + 1) * dt, x)
            note(f"{s}_error", cells.norm(states[s].estimates - p))
            note(f"{s}_consensus", cells.norm(states[s].observed - y))
        if watch is not None:
            watch((j + 1) * dt, x, p, states)
        note("kde", cells.norm(y - p))
        note("open", cells.norm(opened[0] - p))
        note("open_flat", cells.norm(opened[1] - p))
    return {name: np.array(values) for name, values in out.items()}, states
