"""Run a trial for many seeds."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Iterable
from concurrent.futures import BrokenExecutor, Executor
from contextlib import nullcontext
from typing import Any

import numpy as np
from numpy.random import SeedSequence

from distfilt.checks import callable_, choice, count, instance, number
from distfilt.progress import track

from . import _worker
from ._pool import Flight, Pool, PoolError, quiet
from ._worker import Item, Job, Outcome
from .seeds import Recipe, recipes
from .sources import fingerprints
from .study import Failure, Study, StudyError, StudyInterrupted

__all__ = ["run"]

_MOST_WORKERS = 10_000


def run(
    trial: Callable[[SeedSequence], Any], seeds: Iterable[SeedSequence | int], *,
    executor: Executor | None = None, workers: int | None = None, chunk: int | None = None,
    errors: str = "raise", timeout: float | None = None, progress: bool = True,
    blas_threads: int | None = 1,
) -> Study:
    """Call ``trial(seed)`` for every seed, on as many processes as there are.

    The result depends on the trial and the seeds only: not on the number of workers, nor on how
    the trials are grouped, nor on their order, as long as a trial draws from its seed
    (``np.random.default_rng(seed)``) and leaves nothing behind for the next one.

    Parameters
    ----------
    trial : callable
        ``trial(seed) -> value``. It may be defined in a notebook's cell; it and its values are
        sent with cloudpickle. Return metrics, not arrays that nobody looks at.
    seeds : iterable of SeedSequence or int
        One for each trial, all different; `spawn` makes them. An integer s stands for
        ``SeedSequence(s)``. They are not changed: a trial gets its own copy.
    executor : concurrent.futures.Executor, optional
        Where to run: ``dask.distributed.Client(...).get_executor()``, mpi4py's
        ``MPIPoolExecutor``, a pool of the standard library. Its workers need this library. By
        default loky's pool of processes on this machine; its idle workers end after 10 s.
    workers : int, optional
        How many processes, by default one for each core this process may use; with an `executor`,
        how many it has, for the number of chunks kept ready. 1 runs in this process, which is
        easy to debug but is not protected from a trial that ends its process.
    chunk : int, optional
        Trials that travel together; by default as many as take about 0.4 s.
    errors : {"raise", "collect"}
        ``"raise"`` stops at the first failure that comes back. ``"collect"`` runs all trials and
        leaves failures to the caller.
    timeout : float, optional
        Seconds for one trial, without a limit by default. A trial that takes longer is a failure
        of kind ``"timeout"``, with its seed like any other. It is interrupted where its process
        runs it in the main thread, as the default pool, ``workers=1`` and pools of processes do;
        one of the default pool that hangs in compiled code loses its process some two seconds
        later. In a pool of threads it ends by itself before it is counted.
    progress : bool
        Show a progress bar, where a person may be watching (`distfilt.progress.track`).
    blas_threads : int or None
        Threads of the linear algebra in each process; None leaves them as they are.

    Raises
    ------
    StudyError
        If a trial failed and `errors` is ``"raise"``, or if the pool failed: a caller's pool that
        broke or was shut down, a worker with another version of Python, numpy or this library.
        Its ``study`` holds what was done. When a worker of the default pool dies, the pool is
        rebuilt and what was in flight runs again one by one; the trial that takes its worker down
        alone is a failure of kind ``"died"``.
    StudyInterrupted
        On Ctrl-C, a KeyboardInterrupt whose ``study`` holds what was done.

    Examples
    --------
    >>> from bookkit import studies
    >>> def trial(seed):
    ...     return np.random.default_rng(seed).normal(size=10).mean()
    >>> study = studies.run(trial, studies.spawn(2023, 100), workers=1)
    >>> study
    Study(100 trials: 100 done, 0 failed, 0 not run)
    >>> bool(abs(study.array().mean()) < 3 / np.sqrt(1000))
    True
    """
    call = callable_(trial, "trial")
    made = recipes(seeds)
    if executor is not None and not isinstance(executor, Executor):
        raise ValueError(
            f"executor: needs a concurrent.futures.Executor, got {type(executor).__name__}"
        )
    n_workers = None if workers is None else count(workers, "workers")
    if n_workers is not None and n_workers > _MOST_WORKERS:
        raise ValueError(f"workers: needs at most {_MOST_WORKERS}, got {n_workers}")
    size = None if chunk is None else count(chunk, "chunk")
    stops = choice(errors, "errors", ("raise", "collect")) == "raise"
    threads = None if blas_threads is None else count(blas_threads, "blas_threads")
    limit = None if timeout is None else number(timeout, "timeout", above=0)
    instance(progress, "progress", bool)
    pool = Pool(executor, n_workers)
    job = Job(_pickled(call), limit, threads, _worker.home(), pool.own, _worker.versions())
    record = _Record(call, made)
    flight = Flight(pool, job, [Item(i, r) for i, r in enumerate(made)], size)
    with _worker.limited(threads), quiet() if flight.pool.own else nullcontext():
        _fly(flight, record, stops, progress)
    return record.study()


def _pickled(trial: Callable[..., Any]) -> bytes:
    import cloudpickle

    try:
        return bytes(cloudpickle.dumps(trial))
    except Exception as error:
        raise ValueError(
            f"trial: needs a function that can be pickled, got one that cannot: {error}"
        ) from error


class _Record:
    """What is known so far of each trial."""

    def __init__(self, trial: Callable[..., Any], made: tuple[Recipe, ...]) -> None:
        self.began = time.perf_counter()
        self.made = made
        self.values: list[Any] = [None] * len(made)
        self.done = np.zeros(len(made), dtype=bool)
        self.failures: dict[int, Failure] = {}
        self.code = fingerprints([trial], strict=False)

    def add(self, outcome: Outcome) -> bool:
        """Keep an outcome, once or again; say whether it is a value."""
        i, kind, text = outcome.which, outcome.kind, outcome.traceback
        if outcome.value is not None:
            try:
                self.values[i] = pickle.loads(outcome.value)
                self.done[i] = True
                return True
            except Exception as error:
                kind = type(error).__name__
                text = f"the trial's value cannot be read back\n{kind}: {error}"
        self.failures[i] = Failure(i, self.made[i], kind, text)
        return False

    def study(self) -> Study:
        """The study as far as it is known."""
        failures = tuple(self.failures[i] for i in sorted(self.failures))
        seconds = time.perf_counter() - self.began
        return Study(tuple(self.values), self.done, failures, seconds, self.made, self.code)


def _fly(flight: Flight, record: _Record, stops: bool, progress: bool) -> None:
    """Take every outcome; whatever ends this early leaves with what was done."""
    try:
        for outcome in track(flight.outcomes(), show=progress, total=len(record.made)):
            if not record.add(outcome) and stops:
                break
        else:
            return
        study = _partial(flight, record)
        first = study.failures[0]
        raise StudyError(f"{first}\n{study!r}\n\n{first.traceback}".rstrip(), study)
    except KeyboardInterrupt:
        study = _partial(flight, record)
        raise StudyInterrupted(f"interrupted: {study!r}", study) from None
    except (PoolError, BrokenExecutor) as error:
        study = _partial(flight, record)
        raise StudyError(f"the pool failed ({error}): {study!r}", study) from error
    finally:
        flight.abandon()


def _partial(flight: Flight, record: _Record) -> Study:
    for outcome in flight.arrived():
        record.add(outcome)
    return record.study()
