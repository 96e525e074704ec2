"""A swarm's local density filters: the paper's, its variants, and flooding, on the same agents.

Chapter 10 runs it live, and the stored studies of local filters run it longer: every
scheme observes the same positions.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bookkit.published import scenario
from distfilt import density
from distfilt.filters import DensityFilter
from distfilt.network import Faults

sys.path.insert(0, str(Path(__file__).parent))
import densities

# The scenarios: the paper's swarm, our choices, and those for the local filters
SWARM = densities.SWARM
CHOICES = densities.CHOICES
SHARING = scenario("zheng", "locals")
LOCAL = int(SHARING["local"])
FLAT = CHOICES["local_prior_std"]
MODES = SHARING["modes"]
# Gains of (16) as printed, with six and ten times b, with ten times a, and per step
GAINS = {"alpha": SWARM["pi_alpha"], "a": SWARM["pi_proportional"]}
PAPERS = {**GAINS, "b": SWARM["pi_integral"]}
SIXFOLD = {**GAINS, "b": 6 * SWARM["pi_integral"]}
FAST = {**GAINS, "b": 10 * SWARM["pi_integral"]}
STIFF = {**PAPERS, "a": 10 * SWARM["pi_proportional"]}
STEPS = {k: v / SWARM["dt"] for k, v in PAPERS.items()}
# R from the observations, as printed, with a prior whose mass may change
PRINTED = {"noise": "observed", "mass_std": SHARING["mass_std"]}
# Half of all messages are lost
HALF = Faults(loss=0.5, seed=3)
SCHEMES: dict[str, tuple[Any, dict[str, Any]]] = {
    # Observers of all agents
    "central": (density.Centralised(), {"initial_density": "observed"}),
    "central_printed": (
        density.Centralised(),
        {"initial_density": "observed", **PRINTED},
    ),
    # The paper's rule, from the agent's own kernel or from the flat Gaussian
    "paper": (density.PIConsensus(modes=MODES, **PAPERS), {}),
    "paper_printed": (density.PIConsensus(modes=MODES, **PAPERS), PRINTED),
    "paper_flat": (density.PIConsensus(modes=MODES, initial_std=FLAT, **PAPERS), {}),
    "fast": (density.PIConsensus(modes=MODES, **FAST), {}),
    "fast_flat": (density.PIConsensus(modes=MODES, initial_std=FLAT, **FAST), {}),
    "stiff": (density.PIConsensus(modes=MODES, **STIFF), {}),
    "stiff_flat": (density.PIConsensus(modes=MODES, initial_std=FLAT, **STIFF), {}),
    "steps_flat": (density.PIConsensus(modes=MODES, initial_std=FLAT, **STEPS), {}),
    "steps_printed": (
        density.PIConsensus(modes=MODES, initial_std=FLAT, **STEPS),
        PRINTED,
    ),
    # Other rules: the first-order average, flooding, and no rule at all
    "average": (density.DynamicAverage(), {}),
    "flooding": (density.Flooding(), {}),
    "flooding_forgets": (density.Flooding(forget=SHARING["forget"]), {}),
    "flooding_half": (density.Flooding(), {"faults": HALF}),
    "paper_half": (density.PIConsensus(modes=MODES, **PAPERS), {"faults": HALF}),
    "neighbours": (density.Neighbours(), {}),
}
"""By name: the consensus protocol, and the filter's options that differ from the scenario's."""


@dataclass(frozen=True)
class Case:
    """A swarm to be filtered: an interpretation of (23), an initial density, and faults.

    `phase` turns the filters' f against the swarm's; of all agents the share `gone`
    drops out at `gone_at`; `agents` and `cells` scale the study, with as many
    neighbours for each agent.
    """

    interpretation: str = "slowgibbs"
    start: str = "uniform"
    end: float = 20.0
    phase: float = 0.0
    gone: float = 0.0
    gone_at: float = SHARING["gone_at"]
    agents: int = int(SWARM["agents"])
    cells: tuple[int, int] = tuple(int(n) for n in SWARM["cells"])

    @property
    def grid(self) -> density.Grid:
        return density.Grid(self.cells)

    @property
    def bandwidth(self) -> float:
        """The scenario's; with more agents narrower, by the power that is best."""
        # h ∝ N^(-1/6) minimises the integrated squared error in the plane.
        return float(CHOICES["bandwidth"] * (self.agents / SWARM["agents"]) ** (-1 / 6))

    @property
    def radio_range(self) -> float:
        """The scenario's; with more agents shorter, for as many neighbours each."""
        return float(SWARM["radio_range"] * np.sqrt(SWARM["agents"] / self.agents))


def make_filter(
    scheme: str, case: Case, local: int | Sequence[int] = LOCAL, **options: Any
) -> DensityFilter:
    """Return a scheme's filter with the scenario's choices."""
    # The filters' model has its f turned by the case's phase.
    protocol, scheme_options = SCHEMES[scheme]
    law = densities.swarm(case.interpretation, case.phase)
    model = density.FokkerPlanck(law, case.grid)
    # The first agents have a filter each, or those that are named.
    agents = tuple(range(local)) if isinstance(local, int) else tuple(local)
    return DensityFilter(
        model,
        case.agents,
        case.radio_range,
        fusion=protocol,
        bandwidth=case.bandwidth,
        local=agents[:1] if scheme.startswith("central") else agents,
        prior_length=CHOICES["prior_length"],
        prior_std=CHOICES["prior_std"],
        initial_std=FLAT,
        floor=CHOICES["floor"],
        **{"rank": CHOICES["rank"], **scheme_options, **options},
    )


def draw_swarm(case: Case, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw agents (N, 2); return them and their density on the case's grid."""
    x = densities.first_agents(case.start, case.agents, rng)
    # The density is given on the scenario's grid; the case's cells take the nearest value.
    first = densities.first_density(case.start)
    return x, case.grid.normalize(first[densities.grid().cell_index(case.grid.centres)])


def compare_filters(
    case: Case,
    rng: np.random.Generator,
    filters: dict[str, DensityFilter],
    callback: Callable[..., None] | None = None,
    every: int = 1,
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Run filters on one swarm; return errors over time, (T, filters) or (T,), and last states.

    Errors are computed at every `every`-th step; `callback` is called at each step.
    """
    cells = case.grid
    dt = SWARM["dt"]
    swarm = densities.swarm(case.interpretation)
    # All filters start from the same agents.
    x, p = draw_swarm(case, rng)
    states = {s: f.start(x) for s, f in filters.items()}
    model = density.FokkerPlanck(swarm, cells)
    wrong_model = density.FokkerPlanck(
        densities.swarm(case.interpretation, case.phase), cells
    )
    # Two open loops without observations: from the kernel estimate, and from a flat Gaussian
    unobserved = np.stack(
        [
            density.kernel_density(x, cells, bandwidth=case.bandwidth),
            density.kernels(x[:1], cells, bandwidth=FLAT)[0],
        ]
    )
    columns: dict[str, list[Any]] = {}
    # The last agents are those that drop out.
    leaving = np.arange(case.agents) >= round((1 - case.gone) * case.agents)
    for j in range(round(case.end / dt)):
        # The agents, the true density and the open loops move.
        x = swarm.step(x, j * dt, dt, rng=rng, substeps=CHOICES["substeps"])
        p = model.step(p, j * dt, dt)
        unobserved = wrong_model.step(unobserved, j * dt, dt)
        after = (j + 1) * dt > case.gone_at
        # Agents that have dropped out report no position.
        reported = np.where((leaving & after)[:, None], np.nan, x)
        for s, f in filters.items():
            states[s] = f.step(states[s], (j + 1) * dt, reported)
        if callback is not None:
            callback((j + 1) * dt, x, p, states)
        if (j + 1) % every:
            continue
        # The kernel estimate of an observer of all present agents
        y = density.kernel_density(
            x[~(leaving & after)], cells, bandwidth=case.bandwidth
        )
        # L2 distances from the true density, and of each observation from y
        noted = {
            "kde": cells.norm(y - p),
            "open": cells.norm(unobserved[0] - p),
            "open_flat": cells.norm(unobserved[1] - p),
        }
        for s, state in states.items():
            # One number for each local filter
            noted[f"{s}_error"] = cells.norm(state.estimates - p)
            noted[f"{s}_consensus"] = cells.norm(state.observed - y)
        for name, value in noted.items():
            columns.setdefault(name, []).append(value)
    return {name: np.array(values) for name, values in columns.items()}, states


def average(
    values: np.ndarray, case: Case, start: float, end: float | None = None
) -> np.ndarray:
    """Mean over the times from `start` to `end`."""
    # Values a second
    k = len(values) / case.end
    stop = None if end is None else round(end * k)
    return values[round(start * k) : stop].mean(axis=0)


code = (compare_filters, make_filter, draw_swarm, average)
scenarios = (SWARM, CHOICES, SHARING)
