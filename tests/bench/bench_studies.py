"""What `studies.run` adds to a trial of 10 ms, on loky's pool.

A trial sleeps for 10 ms and returns how long it really took. The overhead per trial is what the
workers spent on anything else: workers * wall time / trials - mean time of a trial. It is measured
on a pool whose processes run already, the median of several studies; starting the processes is
timed apart. Beside it: `store`, which puts every trial on disk. Misses where `run` on two workers
takes more than 0.15 ms a trial.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import mkdtemp

from _bench import Row, main, table
from loky import get_reusable_executor
from numpy.random import SeedSequence

from bookkit import studies

TRIALS, REPEATS, LENGTH, REQUIRED_MS = 400, 7, 0.010, 0.15


def trial(seed: SeedSequence) -> float:
    began = time.perf_counter()
    time.sleep(LENGTH)
    return time.perf_counter() - began


Call = Callable[[], Sequence[float]]
SEEDS = studies.spawn(1, TRIALS)


def by_run(workers: int) -> Call:
    return lambda: studies.run(trial, SEEDS, workers=workers, progress=False).values


def by_store(workers: int) -> Call:
    """Each trial on disk before its worker gets the next one."""
    path = Path(mkdtemp()) / "study.csv"

    def call() -> Sequence[float]:
        studies.store(path, trial, SEEDS, columns=["seconds"], parameters={}, workers=workers,
                      progress=False)  # fmt: skip
        return list(studies.load(path).metric("seconds"))

    return call


def overheads(call: Call, workers: int) -> tuple[list[float], float]:
    """Overhead of each repeat, in ms a trial, and what the first call took longer, in s."""
    out, walls = [], []
    for _ in range(REPEATS + 1):
        began = time.perf_counter()
        inside = call()
        walls.append(time.perf_counter() - began)
        out.append(1e3 * (workers * walls[-1] / TRIALS - statistics.fmean(inside)))
    return out[1:], walls[0] - statistics.median(walls[1:])


CASES = (1, "run", by_run), (2, "run", by_run), (2, "store", by_store)


@table("studies", "numpy", "loky", "cloudpickle", "threadpoolctl")
def rows() -> Iterator[Row]:
    for workers, name, made in CASES:
        found, start = overheads(made(workers), workers)
        median = statistics.median(found)
        required = name == "run" and workers > 1
        yield {
            "case": name, "workers": workers, "trials": TRIALS, "overhead_ms": f"{median:.3f}",
            "required_ms": f"{REQUIRED_MS:g}" if required else "", "start_s": f"{start:.2f}",
            "repeats": REPEATS, "missed": required and median > REQUIRED_MS,
        }
        get_reusable_executor(workers).shutdown(wait=True)


if __name__ == "__main__":
    main()
