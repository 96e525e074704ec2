"""Where chunks run: in this process, on a pool of our own that can be rebuilt, or on a caller's."""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import contextmanager
from math import ceil
from typing import Any

from . import _worker
from ._worker import Item, Job, Outcome, late
from .study import DIED

__all__: list[str] = []  # used inside this folder only

CHUNK_SECONDS = 0.4
"""What a chunk should take: long against its transport, short against a wait for Ctrl-C."""

CHUNKS_AHEAD = 4
"""Chunks per worker that are submitted but not back; memory does not grow with the study."""

_LOOK_SECONDS = 1.0
_GRACE_SECONDS = 2.0
"""What a trial may take beyond its time before its process is ended."""

_IDLE_SECONDS = 10
"""After this time without work the workers of our own pool end."""


class PoolError(Exception):
    """The pool failed, not a trial."""


class _Here(Executor):
    """Runs what is submitted in this process, at once."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Pool:
    """An executor, how many workers it has, and whether it is ours to rebuild."""

    def __init__(self, executor: Executor | None, workers: int | None) -> None:
        self.own = self.killed = False
        if executor is not None:
            known = getattr(executor, "_max_workers", None)
            self.workers = workers or (known if isinstance(known, int) else os.cpu_count()) or 1
            self.executor = executor
        else:
            if workers is None:
                from loky import cpu_count

                workers = int(cpu_count())
            self.workers = workers
            self.own = workers > 1
            self.executor = self._rebuilt() if self.own else _Here()
        self.window = 1 if isinstance(self.executor, _Here) else CHUNKS_AHEAD * self.workers

    def _rebuilt(self) -> Executor:
        from loky import get_reusable_executor

        # loky starts new workers where these arguments differ: a worker keeps the folder and the
        # import path that it was born with.
        here = (os.getcwd(), *sys.path)
        pool: Executor = get_reusable_executor(
            self.workers, timeout=_IDLE_SECONDS, initializer=_worker.start, initargs=here
        )
        return pool

    def submit(self, job: Job, items: Sequence[Item]) -> Future[list[Outcome]]:
        return self.executor.submit(_worker.chunk, job, items)

    def restart(self) -> None:
        """Replace a broken pool of our own by one that is seen to work."""
        self.killed = False
        try:
            self.executor = self._rebuilt()
            self.executor.submit(_worker.hello).result()
        except BrokenExecutor as error:
            raise PoolError("workers die before they run a trial") from error

    def kill(self) -> None:
        """End our own workers at once; a caller's pool is left to the caller."""
        if self.own:
            self.killed = True
            stop: Any = self.executor.shutdown
            stop(wait=True, kill_workers=True)


@contextmanager
def quiet() -> Iterator[None]:
    """Without loky's word on a worker that it replaces, which costs no result.

    It replaces a worker whose memory has grown by 300 MB, as a cache does.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="A worker (stopped|was restarted) while some")
        yield


class _Sizes:
    """How many trials the next chunk takes: a fixed number, or as the last chunk's speed says."""

    def __init__(self, chunk: int | None, workers: int) -> None:
        self.chunk, self.workers, self.next = chunk, workers, 1

    def size(self, waiting: int) -> int:
        """The next chunk's size; towards the end smaller ones, so that no worker is left alone."""
        if self.chunk is not None:
            return self.chunk
        return max(1, min(self.next, ceil(waiting / (2 * self.workers))))

    def learn(self, outcomes: Sequence[Outcome]) -> None:
        mean = sum(o.seconds for o in outcomes) / len(outcomes)
        # One quick trial does not make a study of quick trials: grow by steps.
        self.next = max(1, min(int(CHUNK_SECONDS / max(mean, 1e-9)), 4 * len(outcomes)))


class Flight:
    """The trials of a study on their way through a pool."""

    def __init__(self, pool: Pool, job: Job, items: Sequence[Item], chunk: int | None) -> None:
        self.pool, self.job = pool, job
        self.waiting = deque(items)
        self.flying: dict[Future[list[Outcome]], list[Item]] = {}
        self.sizes = _Sizes(chunk, pool.workers)
        self.heard = time.monotonic()

    def outcomes(self) -> Iterator[Outcome]:
        """Every trial's outcome, as it comes.

        A chunk is forgotten only after its outcomes were taken, so that `arrived` misses none of
        them when the taker is interrupted.
        """
        while self.waiting or self.flying:
            self._fill()
            # Executors do not tell those who wait of a chunk that was cancelled: look again.
            wait(self.flying, timeout=_LOOK_SECONDS, return_when=FIRST_COMPLETED)
            ready = [f for f in self.flying if f.done()]
            if ready:
                self.heard = time.monotonic()
            elif self._stuck():
                self.pool.kill()
            for future in ready:
                if self._broke(future):
                    yield from self._one_by_one()
                    break
                self.sizes.learn(future.result())
                yield from future.result()
                del self.flying[future]

    def _stuck(self) -> bool:
        """Whether some worker must be busy with a trial that no signal ends: nothing came back.

        Every worker has a chunk in hand, and of the longest one every trial may take its time.
        """
        if self.job.timeout is None or not self.pool.own or not self.flying:
            return False
        longest = max(map(len, self.flying.values()))
        allowed = longest * self.job.timeout + _GRACE_SECONDS
        return time.monotonic() - self.heard > allowed

    def _fill(self) -> None:
        while self.waiting and len(self.flying) < self.pool.window:
            size = min(self.sizes.size(len(self.waiting)), len(self.waiting))
            items = [self.waiting.popleft() for _ in range(size)]
            try:
                self.flying[self.pool.submit(self.job, items)] = items
            except BrokenExecutor as error:
                self.waiting.extendleft(reversed(items))
                if not self.pool.own:
                    raise PoolError(_named(error)) from error
                if self.flying:  # the break will show on what is in flight
                    return
                self.pool.restart()
            except RuntimeError as error:
                self.waiting.extendleft(reversed(items))
                raise PoolError(_named(error)) from error

    def _broke(self, future: Future[list[Outcome]]) -> bool:
        """Say whether a worker of our own died; what else went wrong is not the trials' doing."""
        if future.cancelled():
            raise PoolError("a chunk was cancelled: the executor was shut down")
        error = future.exception()
        if isinstance(error, KeyboardInterrupt):
            raise error
        lost = self.pool.killed or isinstance(error, BrokenExecutor)
        if error is None or (self.pool.own and lost):
            return error is not None
        raise PoolError(_named(error)) from error

    def _one_by_one(self) -> Iterator[Outcome]:
        """Run again what was in flight when a worker died, each trial alone in the pool.

        A worker takes the whole pool down; only a trial that does so alone is to blame.
        """
        wait(self.flying)
        suspects: list[Item] = []
        for future, items in self.flying.items():
            if self._broke(future):
                suspects += items
            else:
                yield from future.result()
        self.flying.clear()
        self.pool.restart()
        for item in suspects:
            future = self.pool.submit(self.job, [item])
            self.flying[future] = [item]
            limit = self.job.timeout
            if not wait(self.flying, None if limit is None else limit + _GRACE_SECONDS).done:
                yield late(item, limit, 0.0)
                self.flying.clear()
                self.pool.kill()
                self.pool.restart()
            elif self._broke(future):
                yield Outcome(item.which, None, DIED, str(future.exception()), 0.0)
                self.flying.clear()
                self.pool.restart()
            else:
                yield from future.result()
                self.flying.clear()

    def arrived(self) -> list[Outcome]:
        """Outcomes that are back but were perhaps not taken."""
        out: list[Outcome] = []
        for future in self.flying:
            if future.done() and not future.cancelled() and future.exception() is None:
                out += future.result()
        return out

    def abandon(self) -> None:
        """Give up what is in flight."""
        if self.pool.own and self.flying:
            self.pool.kill()
        for future in self.flying:
            future.cancel()
        self.flying.clear()


def _named(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"
