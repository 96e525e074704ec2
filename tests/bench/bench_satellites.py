"""Figs. 1 and 2 of Grange et al. at full size: 100 runs of each, in time and memory.

Runs the cells of the chapter that are tagged ``setup``, then times its `fig_1` with one process for
each mode, as two cores would, and after it Fig. 2's hundred runs in two halves. Writes
data/bench/satellites.csv; fails above the limits.
"""

from __future__ import annotations

import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from time import perf_counter
from typing import Any

import jupytext
import numpy as np
from _bench import timed, write

BOOK = Path(__file__).parents[2] / "book"
LIMITS = {"Fig. 1, both modes": (30, 500), "Figs. 1 and 2": (60, 1000)}
"""Seconds and MB on two cores."""


def chapter() -> dict[str, Any]:
    """The names that the chapter's set-up defines."""
    names: dict[str, Any] = {}
    for cell in jupytext.read(BOOK / "04-satellite-network.md").cells:
        if "setup" in cell.metadata.get("tags", []):
            exec(cell.source, names)
    return names


def fig_1(mode: str) -> None:
    """One mode's 100 runs."""
    names = chapter()
    names["fig_1"](names["study"]["runs"], 2023, only=mode)


def fig_2(half: str) -> None:
    """Fifty of the 100 runs with principal components, as one batch."""
    sys.path.insert(0, str(BOOK / "studies"))
    import satellites

    rng = np.random.default_rng(int(half))
    runs = (satellites.parameters["runs"] // 2,)
    network = satellites.network("III", "pca")
    times, truth, seen = satellites.data("III", rng, runs)
    start = network.start(satellites.prior("III"), rng=rng, runs=runs)
    network.run(start, times, seen, truth=truth)


def spent(job: tuple[str, str]) -> tuple[str, float, float]:
    """Processor time in s and peak memory in MB of one job, in a process of its own."""
    figure, part = job
    result = timed(lambda: {"Fig. 1": fig_1, "Fig. 2": fig_2}[figure](part), 1)
    return f"{figure}, {part}", result.cpu, result.peak_mb


def measured(jobs: list[tuple[str, str]]) -> tuple[list[dict[str, Any]], float, float]:
    """Rows of two jobs side by side, their wall time in s and their memory together in MB."""
    start = perf_counter()
    with ProcessPoolExecutor(2) as pool:
        results = list(pool.map(spent, jobs))
    wall = perf_counter() - start
    rows = [
        {"part": part, "seconds": f"{cpu:.1f}", "peak_mb": f"{peak:.0f}", "limit": ""}
        for part, cpu, peak in results
    ]
    return rows, wall, sum(peak for _, _, peak in results)


def main() -> int:
    """Measure, write the table, and count the limits that are passed."""
    first, wall_1, peak_1 = measured([("Fig. 1", m) for m in ("with PCA", "without PCA")])
    second, wall_2, peak_2 = measured([("Fig. 2", half) for half in ("1", "2")])
    totals = {
        "Fig. 1, both modes": (wall_1, peak_1),
        "Figs. 1 and 2": (wall_1 + wall_2, max(peak_1, peak_2)),
    }
    rows, missed = [*first, *second], 0
    for name, (wall, peak) in totals.items():
        seconds, megabytes = LIMITS[name]
        missed += wall > seconds or peak > megabytes
        rows.append({
            "part": f"{name}, two processes, wall", "seconds": f"{wall:.1f}",
            "peak_mb": f"{peak:.0f}", "limit": f"{seconds} s, {megabytes} MB",
        })
    write("satellites", rows, ("numpy", "scipy", "xarray"))
    return missed


if __name__ == "__main__":
    sys.exit(main())
