"""Density filters: one shared basis against a dense covariance.

A step of all local filters of a hundred agents on 30 by 30 cells. Misses where a dense filter for
each of them does not take 300 times as long.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from _bench import Row, interleaved, main, table

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
RATIO = 300.0
SWARM = rotating_swarm("slowgibbs")


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
    """All of the agents' filters in one step, and a dense one for each of them."""
    times, ratios = interleaved({"shared": filters(30, AGENTS), "dense": dense(30)}, 5)
    ratio = AGENTS * ratios["dense"]
    yield {
        "agents": AGENTS, "cells": 900, "ms": f"{1e3 * times['shared']:.2f}",
        "dense_ms": f"{1e3 * AGENTS * times['dense']:.0f}", "ratio": f"{ratio:.0f}",
        "needed": RATIO, "missed": ratio < RATIO,
    }


if __name__ == "__main__":
    main()
