"""Run a trial for many seeds, on any executor, with the same bits."""

from __future__ import annotations

import functools
import inspect
import os
import pickle
import platform
import signal
import sys
import threading
import time
import traceback
import uuid
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
import scipy.linalg  # noqa: F401  loads its BLAS before threads are limited
from loky import cpu_count, get_reusable_executor
from numpy.random import SeedSequence
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits
from tqdm.auto import tqdm

from distfilt import __version__

__all__ = ["Failure", "Study", "StudyError", "run", "spawn"]

Trial = Callable[[SeedSequence], Any]
Item = tuple[int, SeedSequence]

CHUNK_SECONDS = 0.4
"""Aimed duration of the trials of one chunk: long compared with the time to send them."""

DIED = "died"
"""The kind of failure of a trial whose worker process ended before the trial did."""


def spawn(root: int, n: int) -> list[SeedSequence]:
    """Return the seeds of n independent trials.

    Seed i is ``SeedSequence(root, spawn_key=(i,))`` for every n, so that a study can be extended.

    Examples
    --------
    >>> [seed.spawn_key for seed in spawn(2023, 3)]
    [(0,), (1,), (2,)]
    """
    return [SeedSequence(root, spawn_key=(i,)) for i in range(n)]


def plain(function: Any) -> Any:
    """Return the function below partials and decorators, whose source defines the callable."""
    while isinstance(function, functools.partial):
        function = function.func
    return inspect.unwrap(function)


def fresh(seed: SeedSequence | int) -> SeedSequence:
    """Return a copy of a seed from which nothing has been spawned."""
    if not isinstance(seed, SeedSequence):
        return SeedSequence(seed)
    # Spawning changes a seed's counter; a copy starts at zero again.
    return SeedSequence(seed.entropy, spawn_key=seed.spawn_key)


class Failure(NamedTuple):
    """A trial that returned no value: ``trial(failure.seed)`` fails again.

    `kind` is the class of its exception, or ``"died"`` if its worker process died.
    """

    which: int
    seed: SeedSequence
    kind: str
    traceback: str

    def __str__(self) -> str:
        seed = f"SeedSequence({self.seed.entropy}, spawn_key={self.seed.spawn_key})"
        return f"trial {self.which}, {seed}: {self.traceback.strip()}"


@dataclass(frozen=True, eq=False)
class Study:
    """The results of a study's trials, in the order of the seeds.

    Parameters
    ----------
    seeds : tuple of SeedSequence
        One seed a trial.
    values : tuple
        The value of each trial; None if it failed or was not run.
    failures : tuple of Failure
        Trials that raised or died.
    done : array of bool, (n,)
        Whether each trial returned a value.

    Examples
    --------
    >>> study = run(lambda seed: [seed.spawn_key[0] ** 2], spawn(1, 4), workers=1)
    >>> study.metrics(["square"])
    {'square': array([0., 1., 4., 9.])}
    """

    seeds: tuple[SeedSequence, ...]
    values: tuple[Any, ...]
    failures: tuple[Failure, ...]
    done: NDArray[np.bool_]

    def __repr__(self) -> str:
        failed = len(self.failures)
        return (
            f"Study({len(self.seeds)} trials: {self.done.sum()} done, {failed} failed)"
        )

    def metrics(self, columns: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """Return the named numbers of the trials that returned, each (n,)."""
        values = [v for v, done in zip(self.values, self.done, strict=True) if done]
        table = np.array([row(v, columns) for v in values]).reshape(
            len(values), len(columns)
        )
        return dict(zip(columns, table.T, strict=True))


def row(value: Any, columns: Sequence[str]) -> list[float]:
    """Return the metrics of a trial's value: a mapping, or numbers in the order of the columns."""
    if isinstance(value, Mapping):
        return [float(value[name]) for name in columns]
    numbers = [float(x) for x in np.atleast_1d(value)]
    if len(numbers) != len(columns):
        raise ValueError(
            f"columns must have {len(numbers)} names, one for each number, got {columns}"
        )
    return numbers


class StudyError(RuntimeError):
    """Trials or the executor failed; the attribute ``study`` has the finished trials."""

    def __init__(self, message: str, study: Study | None = None) -> None:
        super().__init__(message)
        self.study = study


def run(
    trial: Trial,
    seeds: Iterable[SeedSequence | int],
    *,
    executor: Executor | None = None,
    workers: int | None = None,
    errors: str = "raise",
    progress: bool = True,
) -> Study:
    """Call ``trial(seed)`` for every seed, on several processes.

    The result depends on the trial and the seeds only, not on the executor, the number of workers
    or the order, if a trial draws from its seed (``np.random.default_rng(seed)``) and leaves no
    state for the next one.

    Parameters
    ----------
    trial : callable
        ``trial(seed) -> value``. It may be defined in a notebook, a script or a module beside
        them: its code is sent, not its name.
    seeds : iterable of SeedSequence or int
        A seed for each trial, all different, as made by `spawn`. A trial gets its own copy.
    executor : concurrent.futures.Executor, optional
        The executor to run on: ``dask.distributed.Client(...).get_executor()``, mpi4py's
        ``MPIPoolExecutor``, a pool of the standard library. Its workers need this package and the
        library. By default loky's pool of processes on this machine.
    workers : int, optional
        Number of processes, by default one a core; 1 runs in this process. With an `executor`, the
        number of trials that it runs at a time, if this is not one of its attributes.
    errors : {"raise", "collect"}
        Whether failures are raised after all trials have run, or only recorded.
    progress : bool
        Show a progress bar in a terminal or notebook.

    Raises
    ------
    StudyError
        If a trial failed and `errors` is ``"raise"``, or if the given executor failed. If a worker
        of the default pool dies, the unfinished trials run again one by one. A trial whose worker
        dies then is a failure of kind ``"died"``.

    Examples
    --------
    >>> study = run(
    ...     lambda seed: np.random.default_rng(seed).normal(), spawn(7, 100), workers=1
    ... )
    >>> study
    Study(100 trials: 100 done, 0 failed)
    """
    # Copies, so that a trial cannot spawn from a seed of the caller.
    seed_sequences = tuple(fresh(seed) for seed in seeds)
    outcomes_by_index: dict[int, Outcome] = {}
    results = outcomes(trial, list(enumerate(seed_sequences)), executor, workers)
    try:
        for outcome in track(results, len(seed_sequences), progress):
            outcomes_by_index[outcome.which] = outcome
    except ExecutorError as error:
        study = _study(seed_sequences, outcomes_by_index)
        raise StudyError(f"{error}: {study!r}", study) from error
    study = _study(seed_sequences, outcomes_by_index)
    if study.failures and errors == "raise":
        raise StudyError(f"{study!r}\n{study.failures[0]}", study)
    return study


def _study(seeds: tuple[SeedSequence, ...], results: Mapping[int, Outcome]) -> Study:
    """Return a study of the outcomes by their index; a missing one has not run."""
    values: list[Any] = [None] * len(seeds)
    done = np.zeros(len(seeds), dtype=bool)
    failures = []
    for i in sorted(results):
        outcome = results[i]
        if outcome.kind:
            failures.append(Failure(i, seeds[i], outcome.kind, outcome.text))
        else:
            # Values stay pickled until here, so that the parent is not slowed while
            # trials run.
            values[i] = pickle.loads(outcome.value)
            done[i] = True
    return Study(seeds, tuple(values), tuple(failures), done)


_NO_BAR = ("TQDM_DISABLE", "CI", "PYTEST_CURRENT_TEST")
"""Variables of an environment in which nobody watches."""


def track(items: Iterable[Any], total: int, show: bool) -> Iterable[Any]:
    """Return the items with a progress bar, in a terminal or notebook."""
    silent = any(os.environ.get(name) for name in _NO_BAR)
    # None hides the bar if the output is not a terminal.
    disable = True if silent or not show else None
    tracked: Iterable[Any] = tqdm(items, total=total, leave=False, disable=disable)
    return tracked


# Functions of a worker.

# A forked process inherits this name, hence the process number beside it.
_HOME = uuid.uuid4().hex


def home() -> str:
    """Return a name of this process that no fork and no process of another machine has."""
    return f"{_HOME}-{os.getpid()}"


def versions() -> dict[str, str]:
    """Return the versions that must be equal everywhere for a study to give the same bits."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {"distfilt": __version__, "numpy": np.__version__, "python": python}


class Outcome(NamedTuple):
    """The result of one trial: its pickled value, or the kind and text of its failure."""

    which: int
    value: bytes
    kind: str = ""
    text: str = ""


Job = tuple[bytes, str, dict[str, str]]
"""Common to all trials of a study: the pickled trial, the process that started it, versions."""


def chunk(job: Job, items: Sequence[Item]) -> tuple[float, list[Outcome]]:
    """Run some trials; return how long they took, and their outcomes."""
    trial, started, expected = job
    # Other versions may give other bits.
    if expected != versions():
        raise RuntimeError(f"a worker has {versions()}, the study {expected}")
    call = _loaded(trial)
    # In a process of the caller, the number of threads is limited by the caller.
    if started != home():
        _one_blas_thread()
    start_time = time.perf_counter()
    results = [_run_trial(call, *item) for item in items]
    return time.perf_counter() - start_time, results


_loaded = functools.lru_cache(maxsize=1)(pickle.loads)


def _run_trial(trial: Trial, which: int, seed: SeedSequence) -> Outcome:
    try:
        # Pickle at once: the next trial may overwrite a buffer that the value shares.
        return Outcome(which, cloudpickle.dumps(trial(seed)))
    except (Exception, SystemExit) as error:
        frames = (
            error.__traceback__ and error.__traceback__.tb_next
        )  # without this function's frame
        text = "".join(traceback.format_exception(type(error), error, frames))
        return Outcome(which, b"", type(error).__name__, text)


@functools.cache
def _one_blas_thread() -> None:
    """Limit a worker's linear algebra to one thread: the number of threads changes last bits."""
    threadpool_limits(1, user_api="blas")


def _start(*_: str) -> None:
    """Prepare a worker: only the process that started the study decides when it ends.

    Ctrl-C in a terminal reaches every process, so workers ignore it. If the parent is killed,
    workers get no signal: each checks regularly whether its parent is still the same.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()


def _end_with_parent(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    # Without the usual clean-up, which would wait for the running trial.
    os._exit(1)


# Functions of the process that starts a study.


class ExecutorError(Exception):
    """The executor failed, not a trial."""


def _pool(workers: int) -> Executor:
    # loky starts new workers if these arguments differ: a worker keeps the folder and the import
    # path with which it started.
    environment = (os.getcwd(), *sys.path)
    pool: Executor = get_reusable_executor(
        workers, timeout=10, initializer=_start, initargs=environment
    )
    return pool


def slots(executor: Executor) -> int:
    """Return how many calls an executor runs at a time, on its cluster or this machine."""
    # A cluster of Dask grows and shrinks: its workers' threads are counted.
    client = getattr(executor, "_client", None)
    if client:  # dask
        return max(1, int(sum(client.nthreads().values())))
    return int(getattr(executor, "_max_workers", None) or os.cpu_count() or 1)


def pickle_by_value(folder: Path) -> None:
    """Let functions of modules in a folder be sent by value: workers need not have the folder."""
    # Packages are installed everywhere; single files beside the script are not.
    for module in list(sys.modules.values()):
        file = getattr(module, "__file__", None)
        if (
            file
            and not module.__package__
            and Path(file).resolve().parent == folder.resolve()
        ):
            cloudpickle.register_pickle_by_value(module)


def _pickle_trial(trial: Trial) -> bytes:
    # Modules beside the trial and beside the script are sent by value.
    for name in (plain(trial).__module__, "__main__"):
        file = getattr(sys.modules[name], "__file__", None)
        if file and name not in sys.stdlib_module_names:
            pickle_by_value(Path(file).parent)
    return bytes(cloudpickle.dumps(trial))


@contextmanager
def _single_threaded() -> Iterator[None]:
    """Use one thread in linear algebra, and ignore warnings about replaced workers.

    loky replaces a worker whose memory has grown, for example by a cache; no result is lost.
    """
    with warnings.catch_warnings(), threadpool_limits(1, user_api="blas"):
        warnings.filterwarnings(
            "ignore", message="A worker (stopped|was restarted) while some"
        )
        yield


def outcomes(
    trial: Trial,
    items: Sequence[Item],
    executor: Executor | None,
    workers: int | None,
    *,
    one_by_one: bool = False,
) -> Iterator[Outcome]:
    """Yield every trial's outcome in the order in which they finish.

    With `one_by_one` a slot of the executor gets its next trial only after the last outcome was
    received here. Otherwise trials are sent in chunks, two for each slot.
    """
    workers = workers or (int(cpu_count()) if executor is None else None)
    job = (_pickle_trial(trial), home(), versions())
    with _single_threaded():
        if executor is None and workers == 1:
            # One worker: in this process, without an executor.
            for item in items:
                yield from chunk(job, [item])[1]
            return
        flight = _Flight(job, items, executor, workers, one_by_one)
        try:
            yield from flight.outcomes()
        finally:
            flight.abandon()


Chunk = Future[tuple[float, list[Outcome]]]


class _Flight:
    """The trials of a study while they run on an executor.

    Trials wait, then are in flight. If a worker of the own pool dies, all trials in flight become
    suspects and run one by one, so that the trial that kills its worker is found.
    """

    def __init__(
        self,
        job: Job,
        items: Sequence[Item],
        executor: Executor | None,
        workers: int | None,
        one_by_one: bool,
    ) -> None:
        self.job = job
        self.workers = workers
        self.one_by_one = one_by_one
        self.executor = executor or _pool(workers or 1)
        self.owns_executor = executor is None
        self.chunk_size = 1
        self.waiting = deque(items)
        self.suspects = deque[Item]()
        self.in_flight: dict[Chunk, list[Item]] = {}
        self.one_suspect = False
        self.broken = False
        self.n_slots = 1
        self.slots_valid_until = 0.0

    def outcomes(self) -> Iterator[Outcome]:
        while self.waiting or self.suspects or self.in_flight:
            self._fill()
            # A cancelled call does not end the wait of some executors, hence the timeout.
            wait(self.in_flight, timeout=1.0, return_when=FIRST_COMPLETED)
            for future in [f for f in self.in_flight if f.done()]:
                yield from self._collect(future, self.in_flight.pop(future))
                # Refill at once, so that no slot waits for the others' outcomes.
                self._fill()

    def _collect(self, future: Chunk, items: list[Item]) -> Iterable[Outcome]:
        """Return the outcomes of a chunk; if its worker died, a failure or, at first, nothing."""
        try:
            seconds, results = future.result()
            # Grow by a factor of 4 at most, since one fast trial may be an exception.
            largest = int(CHUNK_SECONDS * len(items) / max(seconds, 1e-9))
            self.chunk_size = max(1, min(largest, 4 * len(items)))
            return results
        except BrokenExecutor as error:
            if not self.owns_executor:
                raise ExecutorError(f"the executor broke ({error})") from error
            self.broken = True
            if self.one_suspect:
                text = f"its worker process died: {error}"
                return [Outcome(items[0][0], b"", DIED, text)]
            self.suspects.extend(items)
            return []
        except Exception as error:
            text = f"{type(error).__name__}: {error}"
            raise ExecutorError(f"the executor failed ({text})") from error

    def _fill(self) -> None:
        """Submit as many trials as there are free slots; suspects run alone."""
        # After a death the other chunks fail or finish soon: wait for all of them.
        if self.broken and self.in_flight:
            return
        if self.broken:
            self.executor = _pool(self.workers or 1)
            self.broken = False
        # While a suspect runs alone, nothing else is submitted.
        alone = self.one_suspect and bool(self.in_flight)
        self.one_suspect = bool(self.suspects) or alone
        if self.one_suspect:
            if not self.in_flight:
                self._submit([self.suspects.popleft()])
            return
        slots_now = self._count_slots()
        window = slots_now if self.one_by_one else 2 * slots_now
        while self.waiting and len(self.in_flight) < window and not self.broken:
            # Smaller chunks towards the end, so that all slots finish together.
            fair = ceil(len(self.waiting) / (2 * slots_now))
            size = 1 if self.one_by_one else min(self.chunk_size, fair)
            self._submit([self.waiting.popleft() for _ in range(size)])

    def _count_slots(self) -> int:
        """Return the number of slots; a cluster changes, so it is asked once a second."""
        if time.monotonic() > self.slots_valid_until:
            self.n_slots = slots(self.executor)
            self.slots_valid_until = time.monotonic() + 1.0
        return self.workers or self.n_slots

    def _submit(self, items: list[Item]) -> None:
        """Submit a chunk; if the own pool is broken, put its trials back."""
        try:
            self.in_flight[self.executor.submit(chunk, self.job, items)] = items
        except Exception as error:
            if not self.owns_executor:
                raise ExecutorError(f"the executor takes no trial ({error})") from error
            self.broken = True
            queue = self.suspects if self.one_suspect else self.waiting
            queue.extendleft(reversed(items))

    def abandon(self) -> None:
        """Cancel all calls in flight, and end the workers of the own pool."""
        for future in self.in_flight:
            future.cancel()
        if self.owns_executor and self.in_flight:
            stop: Any = self.executor.shutdown
            # A running trial would keep its worker busy after the study has ended.
            stop(wait=True, kill_workers=True)
