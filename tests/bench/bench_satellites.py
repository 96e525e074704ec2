"""Fig. 1 of Grange et al. at full size: 100 runs, both modes, in time and memory.

Runs the cells of the chapter that are tagged ``setup``, then times its `fig_1` with one process for
each mode, as two cores would. Writes data/bench/satellites.csv; fails above 30 s or 500 MB.
"""

from __future__ import annotations

import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from time import perf_counter
from typing import Any

import jupytext
from _bench import timed, write

CHAPTER = Path(__file__).parents[2] / "book" / "04-satellite-network.md"
SECONDS, MEGABYTES = 30, 500


def chapter() -> dict[str, Any]:
    """The names that the chapter's set-up defines."""
    names: dict[str, Any] = {}
    for cell in jupytext.read(CHAPTER).cells:
        if "setup" in cell.metadata.get("tags", []):
            exec(cell.source, names)
    return names


def mode(name: str) -> tuple[str, float, float]:
    """Processor time in s and peak memory in MB of one mode's 100 runs."""
    names = chapter()
    spent = timed(lambda: names["fig_1"](names["study"]["runs"], 2023, only=name) and None, 1)
    return name, spent.cpu, spent.peak_mb


def main() -> int:
    """Measure, write the table, and say whether a limit is passed."""
    start = perf_counter()
    with ProcessPoolExecutor(2) as pool:
        rows = [
            {"mode": name, "cpu_s": f"{cpu:.1f}", "peak_mb": f"{peak:.0f}", "limit": ""}
            for name, cpu, peak in pool.map(mode, ("with PCA", "without PCA"))
        ]
    wall = perf_counter() - start
    total = sum(float(row["peak_mb"]) for row in rows)
    rows.append({
        "mode": "both, two processes, wall", "cpu_s": f"{wall:.1f}", "peak_mb": f"{total:.0f}",
        "limit": f"{SECONDS} s, {MEGABYTES} MB",
    })
    write("satellites", rows, ("numpy", "scipy", "xarray"))
    return int(wall > SECONDS or total > MEGABYTES)


if __name__ == "__main__":
    sys.exit(main())
