"""What `studies.run` adds to a trial of 10 ms, on loky's pool.

    python tests/bench/bench_studies.py

A trial sleeps for 10 ms and returns how long it really took. The overhead per trial is what the
workers spent on anything else: workers * wall time / trials - mean time of a trial. It is measured
on a pool whose processes run already, the median of several studies; starting the processes is
timed apart. Beside it: `store`, which puts every trial on disk, loky itself with one call a trial,
the standard library's pool with chunks, and joblib. Ends with an error if `run` on two workers
takes more than 0.15 ms a trial.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import mkdtemp

sys.path.insert(0, str(Path(__file__).resolve().parent))

from _bench import peer, write
from loky import get_reusable_executor
from numpy.random import SeedSequence

from bookkit import studies

TRIALS, REPEATS, LENGTH, REQUIRED_MS = 400, 7, 0.010, 0.15


def trial(seed: SeedSequence) -> float:
    began = time.perf_counter()
    time.sleep(LENGTH)
    return time.perf_counter() - began


def by_run(workers: int) -> Callable[[], Sequence[float]]:
    seeds = studies.spawn(1, TRIALS)
    return lambda: studies.run(trial, seeds, workers=workers, progress=False).values


def by_store(workers: int) -> Callable[[], Sequence[float]]:
    """Each trial on disk before its worker gets the next one."""
    seeds, path = studies.spawn(1, TRIALS), Path(mkdtemp()) / "study.csv"

    def call() -> Sequence[float]:
        studies.store(path, trial, seeds, columns=["seconds"], parameters={}, workers=workers,
                      progress=False)  # fmt: skip
        return list(studies.load(path).metric("seconds"))

    return call


def by_loky(workers: int) -> Callable[[], Sequence[float]]:
    seeds = studies.spawn(1, TRIALS)
    return lambda: list(get_reusable_executor(workers).map(trial, seeds))


def by_pool(workers: int) -> Callable[[], Sequence[float]]:
    """What a user of the standard library writes, with a chunk size found by trying."""
    seeds, pool = studies.spawn(1, TRIALS), ProcessPoolExecutor(workers)
    return lambda: list(pool.map(trial, seeds, chunksize=20))


def by_joblib(workers: int) -> Callable[[], Sequence[float]] | None:
    joblib = peer("joblib")
    if joblib is None:
        return None
    seeds = studies.spawn(1, TRIALS)
    return lambda: joblib.Parallel(n_jobs=workers)(joblib.delayed(trial)(s) for s in seeds)


def overheads(call: Callable[[], Sequence[float]], workers: int) -> tuple[list[float], float]:
    """Overhead of each repeat, in ms a trial, and what the first call took longer, in s."""
    out, walls = [], []
    for _ in range(REPEATS + 1):
        began = time.perf_counter()
        inside = call()
        walls.append(time.perf_counter() - began)
        out.append(1e3 * (workers * walls[-1] / TRIALS - statistics.fmean(inside)))
    return out[1:], walls[0] - statistics.median(walls[1:])


def main() -> int:
    rows, missed = [], []
    for workers in (1, 2):
        cases = {"run": by_run(workers)}
        if workers > 1:
            cases |= {
                "store": by_store(workers),
                "loky, a call a trial": by_loky(workers),
                "ProcessPoolExecutor, chunks of 20": by_pool(workers),
                "joblib": by_joblib(workers),
            }
        for name, call in cases.items():
            if call is None:
                continue
            found, start = overheads(call, workers)
            median = statistics.median(found)
            required = REQUIRED_MS if name == "run" and workers > 1 else None
            if required is not None and median > required:
                missed.append(f"{name} on {workers} workers: {median:.2f} ms")
            rows.append(
                {
                    "case": name,
                    "workers": workers,
                    "trials": TRIALS,
                    "overhead_ms": f"{median:.3f}",
                    "least_ms": f"{min(found):.3f}",
                    "most_ms": f"{max(found):.3f}",
                    "required_ms": "" if required is None else f"{required:g}",
                    "start_s": f"{start:.2f}",
                    "repeats": REPEATS,
                }
            )
            get_reusable_executor(workers).shutdown(wait=True)
    write("studies", rows, ("numpy", "loky", "cloudpickle", "threadpoolctl"))
    for text in missed:
        print(f"missed: {text}, needs {REQUIRED_MS} ms", file=sys.stderr)
    return len(missed)


if __name__ == "__main__":
    sys.exit(main())
