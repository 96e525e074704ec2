"""Chapter 11's sweeps: 10 to 300 members on the curved problems, 4 to 64 agents on two of them.

Particles go on to the study's number and to twice as many.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _together as together

NAME = "sizes"
PAPER = "together"
MEMBERS = (10, 30, 100, 300)
# Members of ensembles, of particle filters and of transport
SIZED = ("known_flood", "root_flood", "exact_ci", "pf_flood", "pf_agreed", "ot_young")
PARTICLES = (together.STUDY["particles"], 2 * together.STUDY["particles"])
# With 300 members a transport plan has 90 000 unknowns.
LARGEST = {"ot_young": 100, "pf_flood": PARTICLES[1], "pf_agreed": PARTICLES[1]}
AGENTS = (4, 8, 16, 32, 64)
GROWN = {
    "linear": ("ekf_near", "ekf_hops", "ekf_ci", "ekf_tree", "ekf_flood"),
    "range": ("sum9_near", "sum9_flood", "ekf_ci", "exact_ci", "pf_agreed"),
}
# With 64 ranges the posterior is narrower than a cell of the reference.
RINGS = {"linear": AGENTS, "range": AGENTS[:-1]}
# Where all agents filter all observations, work grows with the square of their number.
MOST = {"sum9_flood": 16}
# Intersection of exact draws needs more members than numbers received.
FEWEST = {"exact_ci": 30}
BY_MEMBERS = [
    (p, c, n)
    for p in ("range", "lorenz")
    for c in SIZED
    for n in MEMBERS + PARTICLES
    if FEWEST.get(c, 0) <= n <= LARGEST.get(c, 300)
]
BY_AGENTS = [
    (p, c, a)
    for p, cells in GROWN.items()
    for c in cells
    for a in RINGS[p]
    if a <= MOST.get(c, 64)
]
# Every curve is compared with the reference on the same data.
COLUMNS = [
    *(f"{p}_members_{n}_{c}" for p, c, n in BY_MEMBERS),
    *(f"{p}_agents_{a}_{c}" for p, c, a in BY_AGENTS),
    *(f"{p}_agents_{a}_reference" for p in GROWN for a in RINGS[p]),
    *(f"{p}_members_reference" for p in ("range", "lorenz")),
]
columns = together.score_columns(COLUMNS)
parameters = {
    "batch": together.BATCH,
    "members": MEMBERS,
    "agents": AGENTS,
    "program": together.program_digest(),
}
# Seeds of their own: these runs are in no other study.
n_batches = together.STUDY["runs"] // together.BATCH
seeds = np.random.SeedSequence(together.STUDY["seed"] + 1).spawn(n_batches)
scenarios = (
    *(together.problem(p).scenario for p in ("linear", "range", "lorenz")),
    together.STUDY,
    together.TUNED,
)
rtol = 1e-4
ill_conditioned = columns


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Run both sweeps once."""
    metrics: dict[str, float] = {}
    # More and more members on two problems
    for name in ("range", "lorenz"):
        p = together.problem(name)
        data = together.draw_data(p, seed)
        metrics |= add_prefix(
            together.measure_references(p, seed, data, half=False), f"{name}_members_"
        )
        for _, cell, n in (row for row in BY_MEMBERS if row[0] == name):
            f = together.CELLS[cell].make(p, together.tuned_value(name, cell), n)
            metrics |= together.measure(p, cell, f, data, seed, f"{name}_members_{n}_")
    # More and more agents on a ring
    for name, cells in GROWN.items():
        for agents in RINGS[name]:
            p = together.problem(name).with_agents(agents)
            data = together.draw_data(p, seed)
            # The reference has the observations of as many agents.
            part = together.measure_references(p, seed, data, half=False)
            metrics |= add_prefix(part, f"{name}_agents_{agents}_")
            for cell in (c for c in cells if (name, c, agents) in BY_AGENTS):
                f = together.CELLS[cell].make(p, together.tuned_value(name, cell))
                metrics |= together.measure(
                    p, cell, f, data, seed, f"{name}_agents_{agents}_"
                )
    return metrics


def add_prefix(columns: dict[str, float], prefix: str) -> dict[str, float]:
    """Return columns with a prefix before their names."""
    return {f"{prefix}{k}": v for k, v in columns.items()}
