"""What runs in a worker: a chunk of trials, its threads, and the check of its versions."""

from __future__ import annotations

import os
import pickle
import platform
import signal
import threading
import time
import traceback
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from distfilt import __version__

from .seeds import Recipe
from .study import LATE

__all__: list[str] = []  # used inside this folder only

_IMPORTED = uuid.uuid4().hex


class Item(NamedTuple):
    """One trial to run."""

    which: int
    recipe: Recipe


class Outcome(NamedTuple):
    """What came of one trial: its pickled value, or the kind and the text of its failure."""

    which: int
    value: bytes | None
    kind: str
    traceback: str
    seconds: float


class _Kept(NamedTuple):
    """A plain value that is not pickled yet."""

    which: int
    value: Any
    seconds: float

    def outcome(self) -> Outcome:
        return Outcome(self.which, _dumps(self.value), "", "", self.seconds)


class Job(NamedTuple):
    """What every chunk of a study shares."""

    trial: bytes
    timeout: float | None
    threads: int | None
    home: str
    own: bool
    versions: tuple[tuple[str, str], ...]


class VersionError(RuntimeError):
    """A worker has other versions than the process that started the study."""


def home() -> str:
    """A name for this process that neither a fork of it nor another machine's process has."""
    return f"{_IMPORTED}-{os.getpid()}"


def versions() -> tuple[tuple[str, str], ...]:
    """What has to be the same everywhere for a study to give the same bits."""
    return (
        ("distfilt", __version__),
        ("numpy", np.__version__),
        ("python", ".".join(platform.python_version_tuple()[:2])),
    )


_LOOK_SECONDS = 0.5


def start(*_: str) -> None:
    """Prepare a worker: only the process that started the study decides when it ends.

    Ctrl-C in a terminal reaches every process, so workers ignore it. If the first process is
    killed, nobody tells its workers: each looks whether its parent is still the one it had.
    """
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(_LOOK_SECONDS)
    os._exit(1)


def hello() -> bool:
    """Answer: a pool whose workers die before their first trial is told from one that works."""
    return True


@lru_cache(maxsize=1)
def _controller(modules: int) -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


@contextmanager
def limited(threads: int | None) -> Iterator[None]:
    """Hold every BLAS of this process to a number of threads.

    Finding the libraries takes milliseconds, so it is done again only after new modules, which may
    have brought another one. scipy's own BLAS is loaded first, for a trial that imports it late.
    """
    if threads is None:
        yield
        return
    import sys

    import scipy.linalg  # noqa: F401

    with _controller(len(sys.modules)).limit(limits=threads, user_api="blas"):
        yield


_held: dict[str, Any] = {"wanted": None, "limiter": None}


def _hold(threads: int | None) -> None:
    """Hold the threads of a worker of our own until another number is wanted.

    Nobody else uses its process, so nothing has to be given back after each chunk.
    """
    import sys

    import scipy.linalg  # noqa: F401

    wanted = (threads, len(sys.modules))
    if _held["wanted"] == wanted:
        return
    if _held["limiter"] is not None:
        _held["limiter"].restore_original_limits()
        _held["limiter"] = None
    if threads is not None:
        _held["limiter"] = _controller(wanted[1]).limit(limits=threads, user_api="blas")
    _held["wanted"] = wanted


def chunk(job: Job, items: Sequence[Item]) -> list[Outcome]:
    """Run some trials; what a trial raises becomes its outcome.

    In the process that started the study the threads are limited once, around everything: threads
    of one pool that set and restore the limit would undo each other's.
    """
    if job.versions != versions():
        raise VersionError(f"a worker has {dict(versions())}, the study {dict(job.versions)}")
    trial = pickle.loads(job.trial)
    # A trial leaves the processor's caches cold, and then everything small costs ten times as
    # much: what can be done before the first trial or after the last is done there.
    seeds = [item.recipe.seed() for item in items]
    if job.own:
        _hold(job.threads)
    with limited(None if job.own or job.home == home() else job.threads):
        done = [
            _outcome(trial, item, seed, job.timeout)
            for item, seed in zip(items, seeds, strict=True)
        ]
    return [d if isinstance(d, Outcome) else d.outcome() for d in done]


class _TooLateError(BaseException):
    """Raised inside a trial when its time is over; `except Exception` in a trial lets it pass."""


@contextmanager
def _alarm(seconds: float | None) -> Iterator[None]:
    """Raise `_TooLateError` in what runs here after that time, where a signal can do so.

    Signals reach the main thread only, and no code that does not come back to Python.
    """
    here = threading.current_thread() is threading.main_thread()
    if seconds is None or not here or not hasattr(signal, "setitimer"):
        yield
        return

    def ring(*_: Any) -> None:
        raise _TooLateError

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _outcome(
    trial: Callable[[Any], Any], item: Item, seed: Any, timeout: float | None
) -> Outcome | _Kept:
    """One trial's outcome; a plain value is only copied here, to be pickled later."""
    began = time.perf_counter()
    try:
        if timeout is None:
            value = trial(seed)
        else:
            with _alarm(timeout):
                value = trial(seed)
        # Values that share a buffer, which the next trial overwrites, would differ with the size
        # of the chunk: each is copied or pickled at once.
        kept, plain = _copied(value)
        if not plain:
            kept = _dumps(value)
    except _TooLateError:
        return late(item, timeout, time.perf_counter() - began)
    except (Exception, SystemExit) as error:
        # The first frame is this function's.
        inner = error.__traceback__.tb_next if error.__traceback__ else None
        text = "".join(traceback.format_exception(type(error), error, inner))
        seconds = time.perf_counter() - began
        return Outcome(item.which, None, type(error).__name__, text, seconds)
    seconds = time.perf_counter() - began
    if timeout is not None and seconds > timeout:  # in a thread, which no signal can stop
        return late(item, timeout, seconds)
    if plain:
        return _Kept(item.which, kept, seconds)
    return Outcome(item.which, kept, "", "", seconds)


def _dumps(value: Any) -> bytes:
    import cloudpickle

    return bytes(cloudpickle.dumps(value))


_SCALARS = frozenset({float, int, bool, str, type(None), np.float64, np.bool_, np.int64})


def _copied(value: Any) -> tuple[Any, bool]:
    """A copy of a plain value, and whether it is one: numbers, and flat lists and dicts of them."""
    kind = type(value)
    if kind in _SCALARS:
        return value, True
    if kind in (list, tuple) and all(type(v) in _SCALARS for v in value):
        return kind(value), True
    if kind is dict and all(type(v) in _SCALARS for v in value.values()):
        return dict(value), all(type(k) in _SCALARS for k in value)
    return None, False


def late(item: Item, timeout: float | None, seconds: float) -> Outcome:
    """The outcome of a trial that took too long."""
    return Outcome(item.which, None, LATE, f"no value after {timeout:g} s", seconds)
