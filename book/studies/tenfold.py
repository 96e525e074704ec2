"""Figs. 1 and 2 of Zheng and Lin with the printed gains, ten times a and ten times b, six runs.

Consensus starts where the filters start, at the flat Gaussian; slow interpretation of
(23), from a uniform and from a peaked density. Beside them the nulls: agents that do
not communicate (``silent``), filters of zero gain from the flat Gaussian (``zero``) and
from the first kernel estimate (``open``); and filters that start as the local ones and
observe all (``central_flat``). All filters of a case share one basis, so that all of
them cost little more than one; the agents of the uniform case are those of `locals`.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _swarm as swarm
import locals as figure

from distfilt import density
from distfilt.network import Channel, Graph, graphs, stable_substeps

NAME = "tenfold"
PAPER = "zheng"
CHOICES = swarm.CHOICES
CASES = {"uniform": figure.CASE, "peaked": replace(figure.CASE, start="peaked")}
TENFOLD = {
    "paper_flat": swarm.PAPERS,
    "stiff_flat": swarm.STIFF,
    "fast_flat": swarm.FAST,
}
GAINS = tuple(TENFOLD)
EIGHT = np.arange(swarm.LOCAL)
TWO = np.arange(2)
ROWS = {
    "central": TWO[:1],
    "central_flat": TWO,
    **dict.fromkeys(GAINS, EIGHT),
    "silent": TWO,
}
"""By name: the agents whose filters are in it."""
NULLS = ("zero", "open")
KINDS = ("error", "ratio", "falls", "last", "below")
columns = [
    *(f"{key}_kde" for key in CASES),
    *(f"{key}_{s}_{k}" for key in CASES for s in (*ROWS, *NULLS) for k in KINDS),
]
parameters = {
    "seed": CHOICES["seed"],
    "local": swarm.LOCAL,
    "rank": CHOICES["low_rank"],
}
seeds = figure.seeds
scenarios = swarm.scenarios
rtol = 1e-4


def consensus(
    nu: np.ndarray, eta: np.ndarray, z: np.ndarray, graph: Graph | None, scheme: str
) -> tuple[np.ndarray, np.ndarray]:
    """One step of (16) on cosine coefficients, (agents, modes), without a graph for the silent.

    The library's `pi_step` in plain numpy: its ledger would take most of the time here.
    """
    gains = TENFOLD.get(scheme, swarm.PAPERS)
    dt = swarm.SWARM["dt"]
    if graph is None:
        return nu + dt * gains["alpha"] * (z - nu), eta
    pull = graph.laplacian.toarray()
    # Substeps keep the explicit scheme stable for large gains.
    steps = stable_substeps(Channel(graph), dt, **gains)
    for _ in range(steps):
        difference = pull @ nu
        spring = pull @ eta
        # ν' = α (z - ν) - a L ν + b L η and η' = -b L ν
        nu = nu + dt / steps * (
            gains["alpha"] * (z - nu) - gains["a"] * difference + gains["b"] * spring
        )
        eta = eta - dt / steps * gains["b"] * difference
    return nu, eta


def errors(case: swarm.Case, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return L2 errors over time, (T, filters), and the kernel estimate's, (T,).

    A filter of zero gain is its prior mean, propagated.
    """
    cells = case.grid
    dt = swarm.SWARM["dt"]
    h = case.bandwidth
    law = swarm.densities.swarm(case.reading)
    model = density.FokkerPlanck(law, cells)
    basis = density.zero_mean_prior(
        cells,
        rank=int(CHOICES["low_rank"]),
        length=CHOICES["prior_length"],
        std=CHOICES["prior_std"],
    )
    x, p = swarm.draw_swarm(case, rng)
    waves = cells.cosines(swarm.MODES)
    gap = ((cells.centres - x[:, None]) ** 2).sum(axis=-1)
    # Each agent's flat Gaussian about its own position
    flat = cells.normalize(np.exp(-0.5 * gap / swarm.FLAT**2))  # cut off at the walls
    # Consensus works on cosine coefficients of the kernels.
    wide = flat @ waves * cells.volume
    z = density.kernels(x, cells, bandwidth=h) @ waves * cells.volume
    talk = {s: (wide, np.zeros_like(wide)) for s in (*GAINS, "silent")}
    first = density.kernel_density(x, cells, bandwidth=h)
    state = density.low_rank_start(
        basis,
        np.concatenate(
            [first[None] if s == "central" else flat[who] for s, who in ROWS.items()]
        ),
    )
    k = density.kernel_constant(cells, bandwidth=h, agents=case.agents)
    cuts = np.cumsum([len(who) for who in ROWS.values()])
    collected: dict[str, list[np.ndarray]] = {s: [] for s in (*ROWS, *NULLS, "kde")}
    for j in range(round(case.end / dt)):
        x = law.step(x, j * dt, dt, rng=rng, substeps=CHOICES["substeps"])
        graph = graphs.disk(x, case.radio_range)
        talk = {
            s: consensus(*talk[s], z, None if s == "silent" else graph, s) for s in talk
        }
        z = density.kernels(x, cells, bandwidth=h) @ waves * cells.volume
        y = density.kernel_density(x, cells, bandwidth=h)
        estimates = [
            talk[s][0][who] @ waves.T if s in talk else np.tile(y, (len(who), 1))
            for s, who in ROWS.items()
        ]
        # One Fokker-Planck step serves the truth and all filters.
        move = model.solver(j * dt, dt)
        p = move(p)
        state = density.low_rank_predict(state, move)
        # R = k max(p̂, floor)
        noise = k * np.maximum(state.estimates, CHOICES["floor"])
        state = density.low_rank_step(state, np.concatenate(estimates), noise, dt)
        # Errors of all filters, split by scheme
        gaps = np.split(cells.norm(state.estimates - p), cuts[:-1])
        for s, gap in zip(ROWS, gaps, strict=True):
            collected[s].append(gap)
        # The prior means alone: filters of zero gain
        collected["zero"].append(cells.norm(state.base[cuts[1] : cuts[2]] - p))
        collected["open"].append(cells.norm(state.base[:1] - p))
        collected["kde"].append(cells.norm(y - p))
    return {s: np.array(e) for s, e in collected.items()}


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """One run of each case: the quantities of the captions, means over the filters."""
    metrics: dict[str, float] = {}
    for key, case in CASES.items():
        case_errors = errors(case, np.random.default_rng(seed))
        kde = case_errors.pop("kde")
        k = round(5.0 / swarm.SWARM["dt"])
        half = {s: swarm.average(e, case, case.end / 2) for s, e in case_errors.items()}
        metrics[f"{key}_kde"] = swarm.average(kde, case, case.end / 2)
        for s, e in case_errors.items():
            first = e[:k].mean(axis=0)
            last = e[-k:].mean(axis=0)
            above = np.flatnonzero(e.mean(axis=1) > kde.mean())
            below = (above[-1] + 1) * swarm.SWARM["dt"] if above.size else 0.0
            values = half[s], half[s] / half["central"], last / first, last, below
            metrics |= {
                f"{key}_{s}_{kind}": np.mean(v)
                for kind, v in zip(KINDS, values, strict=True)
            }
    return {name: float(metrics[name]) for name in columns}


code = (*swarm.code, consensus, errors)
