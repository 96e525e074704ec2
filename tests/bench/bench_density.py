"""Density filters: one shared basis against a dense covariance, and growth with agents and grid.

All local filters of a hundred agents on 30 by 30 cells, one filter on 100 by 100, and one step each
of the Fokker-Planck equation, the kernel estimate and the consensus, for several sizes. Memory is
the largest that one call allocates. Misses where a time or a ratio is not met.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from _bench import Row, main, table, timed

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
SWARM = rotating_swarm("slowgibbs")


def peak_mb(function: Callable[[], Any]) -> float:
    """Largest memory that one call allocates, in MB."""
    tracemalloc.start()
    function()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 2**20


def row(what: str, size: int, function: Callable[[], Any], repeats: int) -> Row:
    """One line of the table."""
    took = timed(function, repeats)
    ms, limit = round(1e3 * took.cpu, 3), LIMITS.get(what, np.inf)
    return {"what": what, "size": size, "cpu_ms": ms, "peak_mb": round(peak_mb(function), 2),
            "missed": ms > limit}  # fmt: skip


def case(n: int) -> tuple[Grid, FokkerPlanck, np.ndarray, Any]:
    """A grid of n by n cells, the motion on it, an observed density and its information."""
    grid, x = Grid((n, n)), np.random.default_rng(1).random((AGENTS, 2))
    flow, y = FokkerPlanck(SWARM, grid), kernel_density(x, grid, bandwidth=H)
    return grid, flow, y, kernel_information(grid, bandwidth=H, agents=AGENTS)


def filters(n: int, number: int) -> Callable[[], Any]:
    """A whole step of `number` filters on n by n cells: move, forecast, weigh, take in."""
    grid, flow, y, k = case(n)
    state = low_rank_start(zero_mean_prior(grid, rank=RANK), np.tile(y, (number, 1)))

    def step() -> Any:
        moved = low_rank_moved(state, flow.solver(0.0, DT))
        return low_rank_step(moved, y, k * np.maximum(moved.estimates, 0.1), DT)

    return step


def dense(n: int) -> Callable[[], Any]:
    """The same step of one filter with its whole covariance."""
    grid, flow, y, k = case(n)
    s = zero_mean_prior(grid, rank=RANK)
    state = Dense(y, s @ s.T)
    return lambda: dense_step(state, flow.solver(0.0, DT), y, k * np.maximum(y, 0.1), DT)


def consensus(x: np.ndarray, u: np.ndarray, reach: float) -> Any:
    door = Channel(graphs.disk(x, reach))
    return pi_step(pi_start(u), u, door, dt=DT, alpha=0.2, a=0.4, b=0.04)


def growth() -> Iterator[Row]:
    """One step of each part, for several sizes."""
    rng = np.random.default_rng(2)
    for n in (30, 60, 120, 240):
        flow = FokkerPlanck(SWARM, Grid((n, n)))
        step = partial(flow.step, np.ones(n * n), 0.0, DT)
        yield row("Fokker-Planck step, cells", n * n, step, 7)
    for agents in (100, 1000, 10_000):
        seen = partial(kernel_density, rng.random((agents, 2)), Grid((30, 30)), bandwidth=H)
        yield row("kernel estimate, agents", agents, seen, 7)
    for agents, cells in (100, 225), (100, 900), (100, 3600), (1000, 64), (10_000, 64):
        # The range shrinks, so that everybody keeps as many neighbours.
        x, u = rng.random((agents, 2)), rng.random((agents, cells))
        talk = partial(consensus, x, u, 0.25 * np.sqrt(100 / agents))
        yield row(f"consensus step of {agents} agents, cells", cells, talk, 5)


@table("density")
def rows() -> Iterator[Row]:
    """The filters, and what each part grows like."""
    ours = row("100 local filters, 30 x 30", 900, filters(30, AGENTS), 9)
    dear = row("dense filter, 30 x 30", 900, dense(30), 3)
    yield from (ours, row("one filter, 100 x 100", 10_000, filters(100, 1), 5), dear)
    ratio = AGENTS * dear["cpu_ms"] / ours["cpu_ms"]
    yield {"what": "ratio: dense for each of 100 agents", "size": 900, "cpu_ms": round(ratio, 1),
           "peak_mb": "", "missed": ratio < RATIO}  # fmt: skip
    yield from growth()


if __name__ == "__main__":
    main()
