"""Density filters: one shared basis against a dense covariance.

All local filters of a hundred agents on 30 by 30 cells, and one filter on 100 by 100. Memory is the
largest that one call allocates. Misses where a time or a ratio is not met.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Iterator
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


@table("density")
def rows() -> Iterator[Row]:
    ours = row("100 local filters, 30 x 30", 900, filters(30, AGENTS), 9)
    dear = row("dense filter, 30 x 30", 900, dense(30), 3)
    yield from (ours, row("one filter, 100 x 100", 10_000, filters(100, 1), 5), dear)
    ratio = AGENTS * dear["cpu_ms"] / ours["cpu_ms"]
    yield {"what": "ratio: dense for each of 100 agents", "size": 900, "cpu_ms": round(ratio, 1),
           "peak_mb": "", "missed": ratio < RATIO}  # fmt: skip


if __name__ == "__main__":
    main()
