"""Parts of all benchmarks: repeated timing, and tables that record where they were measured.

A script yields the rows of its tables; ``missed`` in a row counts its missed floors and
limits. `main` prints the tables and writes each, unless other processes kept the
machine busy; ``--force`` writes them anyway. The exit code is the number of missed
floors and limits.
"""

from __future__ import annotations

import importlib
import os
import platform
import re
import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NoReturn

import pandas
import psutil
from threadpoolctl import threadpool_limits

Row = dict[str, Any]
Rows = Callable[[], Iterable[Row]]

FOLDER = Path(__file__).resolve().parents[2] / "data" / "bench"


@dataclass(frozen=True)
class Timing:
    """Median over the repeats, in s, the peak memory of the process so far, in MB, the result."""

    cpu: float
    peak_mb: float
    result: Any


def measure_time(function: Callable[[], Any], repeats: int = 3) -> Timing:
    """Call `function` `repeats` times and take the median of processor time.

    Another program on the machine disturbs it less than wall time.
    """
    cpu = []
    result = None
    # Waiting BLAS threads count as processor time and would hide the cost of small
    # matrices.
    with threadpool_limits(limits=1):
        for _ in range(repeats):
            start = time.process_time()
            result = function()
            cpu.append(time.process_time() - start)
    return Timing(statistics.median(cpu), peak_mb(), result)


def compare_times(
    functions: Mapping[str, Callable[[], Any]], rounds: int = 15, seconds: float = 0.02
) -> tuple[dict[str, float], dict[str, float]]:
    """Processor time in s of a call of each, and the first one's speed as a multiple of each.

    After a warm-up the functions take turns, so that a disturbance meets all of them:
    medians over the rounds, of the times and of the ratios within a round. A turn is as
    many calls as take `seconds`.
    """
    times: dict[str, list[float]] = {name: [] for name in functions}
    with threadpool_limits(limits=1):
        calls = {}
        for name, function in functions.items():
            # The first call fills caches; the second one gives the length of a turn.
            function()
            began = time.perf_counter()
            function()
            spent = max(time.perf_counter() - began, 1e-7)
            calls[name] = max(1, int(seconds / spent))
        # One turn of each function in every round
        for _ in range(rounds):
            for name, function in functions.items():
                began = time.process_time()
                for _ in range(calls[name]):
                    function()
                times[name].append((time.process_time() - began) / calls[name])
    first = next(iter(times.values()))
    # Within a round both meet the same disturbance, which cancels in their ratio.
    ratios = {}
    medians = {}
    for name, spent in times.items():
        quotients = [b / a for a, b in zip(first, spent, strict=True)]
        ratios[name] = statistics.median(quotients)
        medians[name] = statistics.median(spent)
    return medians, ratios


def peer(name: str) -> Any:
    """Import a module of another package (the extra ``peers``); None if it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        print(f"{name}: left out ({error})", file=sys.stderr)
        return None


def peak_mb() -> float:
    """Largest resident memory of this process so far, in MB."""
    # macOS counts bytes, Linux kibibytes.
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def busy_cores(seconds: float = 1.0) -> float:
    """Return how many cores other processes keep busy, while this one waits."""
    return (os.cpu_count() or 1) * psutil.cpu_percent(seconds) / 100


_BUSY_AT_START = busy_cores()
"""Measured when the script begins; `write` measures again."""
BUSY = 1.0
"""Times measured under a higher load are printed and not written."""


def machine(busy: float) -> str:
    """Return processor, core count and load; `measure_time` limits BLAS to one thread."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        models = re.findall(r"model name\s*: (.*)", cpuinfo.read_text(encoding="utf-8"))
        name = models[0] if models else name
    return f"{name}; {os.cpu_count()} cores; one BLAS thread; load {busy:.1f}"


def versions(packages: Sequence[str]) -> str:
    """Python and the named packages with their versions, in one line."""
    texts = [f"python {platform.python_version()}"]
    for name in packages:
        try:
            texts.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            texts.append(f"{name} missing")
    return "; ".join(texts)


def write(name: str, rows: Sequence[Row], packages: Sequence[str]) -> None:
    """Print rows, and write them to data/bench/`name`.csv with versions, machine and its load."""
    frame = pandas.DataFrame(rows)
    # The load may have begun or ended during the measurement.
    busy = max(_BUSY_AT_START, busy_cores())
    print(frame.to_string(index=False))
    path = FOLDER / f"{name}.csv"
    if busy > BUSY and "--force" not in sys.argv:
        print(f"{name}.csv: not written under a load of {busy:.1f}; --force writes it")
        return
    FOLDER.mkdir(parents=True, exist_ok=True)
    where = {"versions": versions(packages), "machine": machine(busy)}
    frame.assign(**where).to_csv(path, index=False, lineterminator="\n")


_TABLES: dict[str, tuple[Rows, Sequence[str]]] = {}


def table(name: str, *packages: str) -> Callable[[Rows], Rows]:
    """Have `main` show and write the rows that a function yields, with the packages' versions."""

    def register(rows: Rows) -> Rows:
        _TABLES[name] = rows, packages or ("numpy", "scipy")
        return rows

    return register


def main() -> NoReturn:
    """Every table of the script in turn; ends with how many floors and limits were missed."""
    missed = 0
    for name, (rows, packages) in _TABLES.items():
        results = [dict(row) for row in rows()]
        missed += sum(int(row.pop("missed", 0)) for row in results)
        if results:
            write(name, results, packages)
    sys.exit(missed)
