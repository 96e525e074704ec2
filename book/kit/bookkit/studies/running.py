"""Trials run for many seeds, on any executor, with the same bits."""

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
import scipy.linalg  # noqa: F401  its BLAS is loaded before threads are held
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
"""What trials that travel together should take: long against their transport."""

DIED = "died"
"""The kind of failure of a trial whose worker process ended before the trial did."""


def spawn(root: int, n: int) -> list[SeedSequence]:
    """The seeds of n independent trials.

    Seed i is ``SeedSequence(root, spawn_key=(i,))``, whatever n is: a study that is continued
    later keeps the trials that it has.

    Examples
    --------
    >>> [seed.spawn_key for seed in spawn(2023, 3)]
    [(0,), (1,), (2,)]
    """
    return [SeedSequence(root, spawn_key=(i,)) for i in range(n)]


def plain(function: Any) -> Any:
    """The function whose source says what a callable does."""
    while isinstance(function, functools.partial):
        function = function.func
    return inspect.unwrap(function)


def fresh(seed: SeedSequence | int) -> SeedSequence:
    """The same seed, which nobody has spawned from."""
    if not isinstance(seed, SeedSequence):
        return SeedSequence(seed)
    return SeedSequence(seed.entropy, spawn_key=seed.spawn_key)


class Failure(NamedTuple):
    """A trial that gave no value: ``trial(failure.seed)`` fails again.

    `kind` is the class of what it raised, or ``"died"`` if it took its worker process down.
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
    """What came of a study's trials, in the order of the seeds.

    Parameters
    ----------
    seeds : tuple of SeedSequence
        One a trial.
    values : tuple
        What each trial returned; None where it failed or was not run.
    failures : tuple of Failure
        Which raised or died.
    done : array of bool, (n,)
        Which trials returned.

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
        """Named numbers of the trials that are done, each (done,)."""
        kept = [v for v, done in zip(self.values, self.done, strict=True) if done]
        table = np.array([row(v, columns) for v in kept]).reshape(
            len(kept), len(columns)
        )
        return dict(zip(columns, table.T, strict=True))


def row(value: Any, columns: Sequence[str]) -> list[float]:
    """The metrics of one trial's value: a mapping, or numbers in the order of the columns."""
    if isinstance(value, Mapping):
        return [float(value[name]) for name in columns]
    numbers = [float(x) for x in np.atleast_1d(value)]
    if len(numbers) != len(columns):
        raise ValueError(
            f"columns must be {len(numbers)}, a name for each number, got {columns}"
        )
    return numbers


class StudyError(RuntimeError):
    """A study with trials that failed, or an executor that did; ``study`` holds what was done."""

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
    """Call ``trial(seed)`` for every seed, on as many processes as there are.

    The result depends on the trial and the seeds only: not on the executor, the number of workers
    or the order, as long as a trial draws from its seed (``np.random.default_rng(seed)``) and
    leaves nothing behind for the next one.

    Parameters
    ----------
    trial : callable
        ``trial(seed) -> value``. It may be defined in a notebook, a script or a module beside
        them: it is sent itself, not by its name.
    seeds : iterable of SeedSequence or int
        One for each trial, all different; `spawn` makes them. A trial gets its own copy.
    executor : concurrent.futures.Executor, optional
        Where to run: ``dask.distributed.Client(...).get_executor()``, mpi4py's
        ``MPIPoolExecutor``, a pool of the standard library. Its workers need this package and the
        library. By default loky's pool of processes on this machine.
    workers : int, optional
        How many processes, by default one a core; 1 runs in this process. With an `executor`, how
        many trials it runs at a time, where it does not tell itself.
    errors : {"raise", "collect"}
        Whether failures are raised once all trials have run, or left to the caller.
    progress : bool
        Show a bar, where a person may be watching.

    Raises
    ------
    StudyError
        If a trial failed and `errors` is ``"raise"``, or if the caller's executor failed. When a
        worker of the default pool dies, what was in flight runs again one by one: the trial that
        takes its worker down alone is a failure of kind ``"died"``.

    Examples
    --------
    >>> study = run(
    ...     lambda seed: np.random.default_rng(seed).normal(), spawn(7, 100), workers=1
    ... )
    >>> study
    Study(100 trials: 100 done, 0 failed)
    """
    given = tuple(fresh(seed) for seed in seeds)
    found: dict[int, Outcome] = {}
    flight = outcomes(trial, list(enumerate(given)), executor, workers)
    try:
        for outcome in track(flight, len(given), progress):
            found[outcome.which] = outcome
    except ExecutorError as error:
        study = _study(given, found)
        raise StudyError(f"{error}: {study!r}", study) from error
    study = _study(given, found)
    if study.failures and errors == "raise":
        raise StudyError(f"{study!r}\n{study.failures[0]}", study)
    return study


def _study(seeds: tuple[SeedSequence, ...], found: Mapping[int, Outcome]) -> Study:
    failed = tuple(
        Failure(i, seeds[i], *found[i][2:]) for i in sorted(found) if found[i].kind
    )
    done = np.array([i in found and not found[i].kind for i in range(len(seeds))])
    values = tuple(
        pickle.loads(found[i].value) if good else None for i, good in enumerate(done)
    )
    return Study(seeds, values, failed, done)


def track(items: Iterable[Any], total: int, show: bool) -> Iterable[Any]:
    """The items, behind a progress bar where a person may be watching."""
    silent = any(
        os.environ.get(name) for name in ("TQDM_DISABLE", "CI", "PYTEST_CURRENT_TEST")
    )
    hidden = (
        True if silent or not show else None
    )  # None: where the output is no terminal
    shown: Iterable[Any] = tqdm(items, total=total, leave=False, disable=hidden)
    return shown


# What runs in a worker.

_HOME = uuid.uuid4().hex


def home() -> str:
    """A name for this process that neither a fork of it nor another machine's process has."""
    return f"{_HOME}-{os.getpid()}"


def versions() -> dict[str, str]:
    """What has to be the same everywhere for a study to give the same bits."""
    python = ".".join(platform.python_version_tuple()[:2])
    return {"distfilt": __version__, "numpy": np.__version__, "python": python}


class Outcome(NamedTuple):
    """What came of one trial: its pickled value, or the kind and text of its failure."""

    which: int
    value: bytes
    kind: str = ""
    text: str = ""


Job = tuple[bytes, str, dict[str, str]]
"""What all trials of a study share: the pickled trial, where it started, its versions."""


def chunk(job: Job, items: Sequence[Item]) -> tuple[float, list[Outcome]]:
    """Run some trials; say how long they took, and what came of each."""
    trial, started, wanted = job
    if wanted != versions():
        raise RuntimeError(f"a worker has {versions()}, the study {wanted}")
    call = _loaded(trial)
    if started != home():
        _one_blas_thread()
    began = time.perf_counter()
    found = [_outcome(call, *item) for item in items]
    return time.perf_counter() - began, found


_loaded = functools.lru_cache(maxsize=1)(pickle.loads)


def _outcome(trial: Trial, which: int, seed: SeedSequence) -> Outcome:
    try:
        # At once: the next trial may overwrite a buffer that the value shares.
        return Outcome(which, cloudpickle.dumps(trial(seed)))
    except (Exception, SystemExit) as error:
        inner = (
            error.__traceback__ and error.__traceback__.tb_next
        )  # without this function's frame
        text = "".join(traceback.format_exception(type(error), error, inner))
        return Outcome(which, b"", type(error).__name__, text)


@functools.cache
def _one_blas_thread() -> None:
    """Hold a worker's linear algebra to one thread: with another number its last bits differ."""
    threadpool_limits(1, user_api="blas")


def _start(*_: str) -> None:
    """Prepare a worker: only the process that started the study decides when it ends.

    Ctrl-C in a terminal reaches every process, so workers ignore it. If the first process is
    killed, nobody tells its workers: each looks whether its parent is still the one it had.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


# What runs here.


class ExecutorError(Exception):
    """The executor failed, not a trial."""


def _pool(workers: int) -> Executor:
    # loky starts new workers where these arguments differ: a worker keeps the folder and the
    # import path that it was born with.
    here = (os.getcwd(), *sys.path)
    pool: Executor = get_reusable_executor(
        workers, timeout=10, initializer=_start, initargs=here
    )
    return pool


def slots(executor: Executor) -> int:
    """How many calls an executor runs at a time: those of its cluster, not this machine's cores."""
    if client := getattr(executor, "_client", None):  # dask's
        return max(1, int(sum(client.nthreads().values())))
    return int(getattr(executor, "_max_workers", None) or os.cpu_count() or 1)


def sent_by_value(folder: Path) -> None:
    """Send the functions of modules in a folder themselves: a worker need not have the folder."""
    for module in list(sys.modules.values()):
        file = getattr(module, "__file__", None)
        if (
            file
            and not module.__package__
            and Path(file).resolve().parent == folder.resolve()
        ):
            cloudpickle.register_pickle_by_value(module)


def _pickled(trial: Trial) -> bytes:
    for name in (plain(trial).__module__, "__main__"):
        file = getattr(sys.modules[name], "__file__", None)
        if file and name not in sys.stdlib_module_names:
            sent_by_value(Path(file).parent)
    return bytes(cloudpickle.dumps(trial))


@contextmanager
def _held() -> Iterator[None]:
    """One thread in this process's linear algebra, and no word on a worker that loky replaces.

    It replaces one whose memory has grown, as a cache's does, which costs no result.
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
    """Every trial's outcome, as it comes.

    With `one_by_one` a slot of the executor gets its next trial only after the outcome of its last
    one was taken here; else trials travel in chunks, two for each slot.
    """
    workers = workers or (int(cpu_count()) if executor is None else None)
    job = (_pickled(trial), home(), versions())
    with _held():
        if executor is None and workers == 1:
            for item in items:
                yield from chunk(job, [item])[1]
            return
        flight = _Flight(job, items, executor, workers, one_by_one)
        try:
            yield from flight.outcomes()
        finally:
            flight.abandon()


Landed = Future[tuple[float, list[Outcome]]]


class _Flight:
    """The trials of a study on their way through an executor."""

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
        self.own = executor is None
        self.size = 1
        self.waiting = deque(items)
        self.suspects = deque[Item]()
        self.flying: dict[Landed, list[Item]] = {}
        self.alone = False
        self.broken = False
        self.room = 1
        self.known_until = 0.0

    def outcomes(self) -> Iterator[Outcome]:
        while self.waiting or self.suspects or self.flying:
            self._fill()
            # Executors do not tell those who wait of a call that was cancelled: look again.
            wait(self.flying, timeout=1.0, return_when=FIRST_COMPLETED)
            for future in [f for f in self.flying if f.done()]:
                yield from self._landed(future, self.flying.pop(future))
                self._fill()  # at once: no slot waits for the others' outcomes

    def _landed(self, future: Landed, items: list[Item]) -> Iterable[Outcome]:
        """The outcomes of a chunk; of one whose worker died, none, or the trial's that did it."""
        try:
            seconds, found = future.result()
            # One quick trial does not make a study of quick trials: grow by steps.
            most = int(CHUNK_SECONDS * len(items) / max(seconds, 1e-9))
            self.size = max(1, min(most, 4 * len(items)))
            return found
        except BrokenExecutor as error:
            if not self.own:
                raise ExecutorError(f"the executor broke ({error})") from error
            self.broken = True
            if self.alone:
                return [
                    Outcome(items[0][0], b"", DIED, f"its worker process died: {error}")
                ]
            self.suspects.extend(items)
            return []
        except Exception as error:
            raise ExecutorError(
                f"the executor failed ({type(error).__name__}: {error})"
            ) from error

    def _fill(self) -> None:
        """Submit what there is room for: a worker's death is the fault of one that flies alone."""
        if self.broken and self.flying:  # the others are lost or back soon
            return
        if self.broken:
            self.executor = _pool(self.workers or 1)
            self.broken = False
        self.alone = bool(self.suspects) or (self.alone and bool(self.flying))
        if self.alone and not self.flying:
            self._submit([self.suspects.popleft()])
        if (
            time.monotonic() > self.known_until
        ):  # a cluster grows and shrinks; asking it takes time
            self.room = slots(self.executor)
            self.known_until = time.monotonic() + 1.0
        room = self.workers or self.room
        window = room if self.one_by_one else 2 * room
        while (
            self.waiting
            and len(self.flying) < window
            and not (self.alone or self.broken)
        ):
            fair = ceil(
                len(self.waiting) / (2 * room)
            )  # towards the end nobody is left alone
            size = 1 if self.one_by_one else min(self.size, fair)
            self._submit([self.waiting.popleft() for _ in range(size)])

    def _submit(self, items: list[Item]) -> None:
        try:
            self.flying[self.executor.submit(chunk, self.job, items)] = items
        except Exception as error:
            if not self.own:
                raise ExecutorError(f"the executor takes no trial ({error})") from error
            self.broken = True
            (self.suspects if self.alone else self.waiting).extendleft(reversed(items))

    def abandon(self) -> None:
        """Give up what is in flight."""
        for future in self.flying:
            future.cancel()
        if self.own and self.flying:
            stop: Any = self.executor.shutdown
            stop(wait=True, kill_workers=True)
