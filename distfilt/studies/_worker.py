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

from .. import __version__
from .seeds import Recipe

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


class Job(NamedTuple):
    """What every chunk of a study shares."""

    trial: bytes
    threads: int | None
    home: str
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


def start(*_: str) -> None:
    """Prepare a worker: Ctrl-C in a terminal reaches every process, and only the first decides."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


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


def chunk(job: Job, items: Sequence[Item]) -> list[Outcome]:
    """Run some trials; what a trial raises becomes its outcome.

    In the process that started the study the threads are limited once, around everything: threads
    of one pool that set and restore the limit would undo each other's.
    """
    if job.versions != versions():
        raise VersionError(f"a worker has {dict(versions())}, the study {dict(job.versions)}")
    trial = pickle.loads(job.trial)
    with limited(None if job.home == home() else job.threads):
        return [_outcome(trial, item) for item in items]


def _outcome(trial: Callable[[Any], Any], item: Item) -> Outcome:
    # Each value is pickled by itself and at once: values that share a buffer, which the next
    # trial overwrites, would differ with the size of the chunk.
    import cloudpickle

    began = time.perf_counter()
    try:
        value = cloudpickle.dumps(trial(item.recipe.seed()))
    except (Exception, SystemExit) as error:
        # The first frame is this function's.
        inner = error.__traceback__.tb_next if error.__traceback__ else None
        text = "".join(traceback.format_exception(type(error), error, inner))
        seconds = time.perf_counter() - began
        return Outcome(item.which, None, type(error).__name__, text, seconds)
    return Outcome(item.which, value, "", "", time.perf_counter() - began)
