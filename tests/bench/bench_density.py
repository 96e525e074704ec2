"""Density filters: one shared basis against a dense covariance, and growth with agents and grid.

    python tests/bench/bench_density.py

All local filters of a hundred agents on 30 by 30 cells, one filter on 100 by 100, and one step each
of the Fokker-Planck equation, the kernel estimate and the consensus, for several sizes. Memory is
the largest that one call allocates. Ends with an error if a required time or ratio is missed.
"""

from __future__ import annotations

import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np
from _bench import timed, write

from distfilt.density import (
    Dense,
    FokkerPlanck,
    Grid,
    dense_step,
    kernel_density,
    kernel_information,
    low_rank_moved,
    low_rank_start,
    low_rank_step,
    zero_mean_prior,
)
from distfilt.models import rotating_swarm
from distfilt.network import Channel, graphs, pi_start, pi_step

H, AGENTS, RANK, DT = 0.08, 100, 50, 0.1
LIMITS = {"100 local filters, 30 x 30": 30.0, "one filter, 100 x 100": 100.0}
RATIO = 300.0


def peak_mb(function: Callable[[], Any]) -> float:
    """Largest memory that one call allocates, in MB."""
    tracemalloc.start()
    function()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 2**20


def row(what: str, size: int, function: Callable[[], Any], repeats: int) -> dict[str, Any]:
    """One line of the table."""
    took = timed(function, repeats)
    return {
        "what": what,
        "size": size,
        "cpu_ms": round(1e3 * took.cpu, 3),
        "peak_mb": round(peak_mb(function), 2),
    }


def filters(n: int, number: int) -> Callable[[], Any]:
    """A whole step of `number` filters on n by n cells: move, forecast, weigh, take in."""
    grid = Grid((n, n))
    flow, rng = FokkerPlanck(rotating_swarm("slowgibbs"), grid), np.random.default_rng(1)
    y = kernel_density(rng.random((AGENTS, 2)), grid, bandwidth=H)
    k = kernel_information(grid, bandwidth=H, agents=AGENTS)
    state = low_rank_start(zero_mean_prior(grid, rank=RANK), np.tile(y, (number, 1)))

    def step() -> Any:
        moved = low_rank_moved(state, flow.solver(0.0, DT))
        return low_rank_step(moved, y, k * np.maximum(moved.estimates, 0.1), DT)

    return step


def dense(n: int) -> Callable[[], Any]:
    """The same step of one filter with its whole covariance."""
    grid = Grid((n, n))
    flow, rng = FokkerPlanck(rotating_swarm("slowgibbs"), grid), np.random.default_rng(1)
    y = kernel_density(rng.random((AGENTS, 2)), grid, bandwidth=H)
    k = kernel_information(grid, bandwidth=H, agents=AGENTS)
    s = zero_mean_prior(grid, rank=RANK)
    state = Dense(y, s @ s.T)
    return lambda: dense_step(state, flow.solver(0.0, DT), y, k * np.maximum(y, 0.1), DT)


def growth() -> list[dict[str, Any]]:
    """One step of each part, for several sizes."""
    rows, rng = [], np.random.default_rng(2)
    for n in (30, 60, 120, 240):
        grid = Grid((n, n))
        flow = FokkerPlanck(rotating_swarm("slowgibbs"), grid)
        p = np.ones(grid.size)
        rows.append(row("Fokker-Planck step, cells", n * n,
                        lambda flow=flow, p=p: flow.step(p, 0.0, DT), 7))
    grid = Grid((30, 30))
    for agents in (100, 1000, 10_000):
        x = rng.random((agents, 2))
        rows.append(row("kernel estimate, agents", agents,
                        lambda x=x: kernel_density(x, grid, bandwidth=H), 7))
    x = rng.random((AGENTS, 2))
    for n in (30, 60, 120):
        fine = Grid((n, n))
        rows.append(row("kernel estimate of 100 agents, cells", n * n,
                        lambda fine=fine: kernel_density(x, fine, bandwidth=H), 7))
    near, values = graphs.disk(x, 0.25), {n: rng.random((AGENTS, n * n)) for n in (15, 30, 60)}
    for n, u in values.items():
        rows.append(row(
            "consensus step of 100 agents, cells", n * n,
            lambda u=u: pi_step(pi_start(u), u, Channel(near), dt=DT, alpha=0.2, a=0.4, b=0.04), 5))
    for agents in (100, 1000, 10_000):
        # The range shrinks, so that everybody keeps as many neighbours.
        reach = 0.25 * np.sqrt(100 / agents)
        x = rng.random((agents, 2))
        u = rng.random((agents, 64))

        def talk(x: Any = x, u: Any = u, reach: float = reach) -> Any:
            door = Channel(graphs.disk(x, reach))
            return pi_step(pi_start(u), u, door, dt=DT, alpha=0.2, a=0.4, b=0.04)

        rows.append(row("consensus step on 64 numbers, agents", agents, talk, 5))
    return rows


def slopes(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The exponent of growth of each part, between its two largest sizes."""
    out = []
    for what in dict.fromkeys(r["what"] for r in rows):
        a, b = [r for r in rows if r["what"] == what][-2:]
        slope = np.log(b["cpu_ms"] / a["cpu_ms"]) / np.log(b["size"] / a["size"])
        out.append({"what": f"slope of: {what}", "size": b["size"],
                    "cpu_ms": round(float(slope), 2), "peak_mb": ""})
    return out


def main() -> int:
    rows = [row("100 local filters, 30 x 30", 900, filters(30, AGENTS), 9),
            row("one filter, 100 x 100", 10_000, filters(100, 1), 5),
            row("dense filter, 30 x 30", 900, dense(30), 3)]
    ratio = AGENTS * rows[2]["cpu_ms"] / rows[0]["cpu_ms"]
    rows.append({"what": "ratio: dense for each of 100 agents", "size": 900,
                 "cpu_ms": round(ratio, 1), "peak_mb": ""})
    missed = [f"{r['what']}: {r['cpu_ms']} ms, at most {LIMITS[r['what']]}" for r in rows
              if r["cpu_ms"] > LIMITS.get(r["what"], np.inf)]
    if ratio < RATIO:
        missed.append(f"ratio {ratio:.0f}, at least {RATIO:.0f}")
    parts = growth()
    write("density", [*rows, *parts, *slopes(parts)])
    for text in missed:
        print(f"missed: {text}", file=sys.stderr)
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
