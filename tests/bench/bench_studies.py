"""What `studies.run` adds to a trial of 10 ms, on loky's pool.

A trial sleeps for 10 ms and returns how long it really took. The overhead per trial is what the
workers spent on anything else: workers * wall time / trials - mean time of a trial. It is measured
on a pool whose processes run already, the median of several studies; starting the processes is
timed apart. Misses where two workers take more than 0.15 ms a trial.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator

from _bench import Row, main, table
from loky import get_reusable_executor
from numpy.random import SeedSequence

from bookkit import studies

TRIALS, REPEATS, LENGTH, REQUIRED_MS = 400, 7, 0.010, 0.15


def trial(seed: SeedSequence) -> float:
    began = time.perf_counter()
    time.sleep(LENGTH)
    return time.perf_counter() - began


SEEDS = studies.spawn(1, TRIALS)


def overheads(workers: int) -> tuple[list[float], float]:
    """Overhead of each repeat, in ms a trial, and what the first call took longer, in s."""
    out, walls = [], []
    for _ in range(REPEATS + 1):
        began = time.perf_counter()
        inside = studies.run(trial, SEEDS, workers=workers, progress=False).values
        walls.append(time.perf_counter() - began)
        out.append(1e3 * (workers * walls[-1] / TRIALS - statistics.fmean(inside)))
    return out[1:], walls[0] - statistics.median(walls[1:])


@table("studies", "numpy", "loky", "cloudpickle", "threadpoolctl")
def rows() -> Iterator[Row]:
    for workers in (1, 2):
        found, start = overheads(workers)
        median = statistics.median(found)
        required = REQUIRED_MS if workers > 1 else ""
        yield {
            "workers": workers, "trials": TRIALS, "overhead_ms": f"{median:.3f}",
            "required_ms": required, "start_s": f"{start:.2f}", "repeats": REPEATS,
            "missed": required and median > required,
        }
        get_reusable_executor(workers).shutdown(wait=True)


if __name__ == "__main__":
    main()
