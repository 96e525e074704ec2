"""Running: the same bits everywhere, and nothing lost when a trial, a worker or a user stops."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import SeedSequence

from bookkit import studies
from bookkit.studies import Study, StudyError, StudyInterrupted
from bookkit.studies._pool import Flight, Pool

from .trials import dies_at, draw, fails_at, number

_P = "bookkit.studies."
_REFUSED = {
    _P + "run": [
        ("trial", lambda: studies.run(3, [1])),
        ("trial", lambda: studies.run(partial(fails_at, threading.Lock()), [1])),
        ("seeds", lambda: studies.run(number, 7)),
        ("seeds", lambda: studies.run(number, "123")),
        ("seeds", lambda: studies.run(number, [])),
        ("seeds", lambda: studies.run(number, [1.5])),
        ("seeds", lambda: studies.run(number, [True])),
        ("seeds", lambda: studies.run(number, [-1])),
        ("seeds", lambda: studies.run(number, [np.random.default_rng(1)])),
        ("seeds", lambda: studies.run(number, [3, 4, SeedSequence(3)])),
        ("executor", lambda: studies.run(number, [1], executor=4)),
        ("workers", lambda: studies.run(number, [1], workers=0)),
        ("chunk", lambda: studies.run(number, [1], workers=1, chunk=0)),
        ("errors", lambda: studies.run(number, [1], workers=1, errors="ignore")),
        ("timeout", lambda: studies.run(number, [1], workers=1, timeout=0)),
        ("timeout", lambda: studies.run(number, [1], workers=1, timeout="long")),
        ("blas_threads", lambda: studies.run(number, [1], workers=1, blas_threads=0)),
    ],
    _P + "spawn": [
        ("root", lambda: studies.spawn(-1, 3)),
        ("root", lambda: studies.spawn(None, 3)),
        ("n", lambda: studies.spawn(1, 0)),
    ],
    _P + "StudyError": [
        ("trial 1", lambda: studies.run(partial(fails_at, (1,)), studies.spawn(1, 3), workers=1)),
    ],
}
_NONE = {_P + "StudyInterrupted": "raised by Ctrl-C; tested with a signal below"}


def bits(study: Study) -> list[bytes]:
    return [np.asarray(v[0]).tobytes() + np.float64(v[1]).tobytes() for v in study.values]


@pytest.fixture
def spawned_pool() -> Iterator[Executor]:
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        yield pool


# The same bits.


@pytest.mark.parametrize("workers", [1, 2, 4])
def test_workers_chunks_and_threads_change_no_bit(workers: int) -> None:
    seeds = studies.spawn(7, 40)
    reference = bits(Study(tuple(draw(s) for s in studies.spawn(7, 40)), np.ones(40), (), 0.0,
                           studies.run(number, seeds, workers=1).recipes))
    assert len(set(reference)) == 40
    for chunk in (None, 1, 7, 40):
        for threads in (1, 2):
            study = studies.run(draw, seeds, workers=workers, chunk=chunk, blas_threads=threads)
            assert bits(study) == reference


def test_any_executor_changes_no_bit(spawned_pool: Executor) -> None:
    seeds = studies.spawn(7, 20)
    reference = bits(studies.run(draw, seeds, workers=1))
    with ThreadPoolExecutor(3) as threads:
        assert bits(studies.run(draw, seeds, executor=threads)) == reference
    assert bits(studies.run(draw, seeds, executor=spawned_pool, chunk=3)) == reference


@given(st.integers(0, 2**128), st.lists(st.integers(0, 2**31), max_size=3))
def test_a_seed_is_rebuilt_whatever_was_spawned_from_it(entropy: int, key: list[int]) -> None:
    seed = SeedSequence(entropy, spawn_key=key)
    seed.spawn(3)
    study = studies.run(lambda s: s.spawn(1)[0].generate_state(2), [seed], workers=1)
    again = SeedSequence(entropy, spawn_key=key).spawn(1)[0].generate_state(2)
    assert (study.values[0] == again).all()
    assert study.seed(0).n_children_spawned == 0 and seed.n_children_spawned == 3


def test_seeds_are_numpy_s_own_children() -> None:
    ours, theirs = studies.spawn(2023, 5), SeedSequence(2023).spawn(5)
    for a, b in zip(ours, theirs, strict=True):
        assert (a.generate_state(4) == b.generate_state(4)).all()
    words = studies.run(lambda s: s.generate_state(2), [5, SeedSequence([1, 2])], workers=1)
    assert (words.values[0] == SeedSequence(5).generate_state(2)).all()
    assert (words.values[1] == SeedSequence([1, 2]).generate_state(2)).all()


def test_values_that_share_a_buffer_are_kept_apart() -> None:
    buffer = np.zeros(1)

    def trial(seed: SeedSequence) -> np.ndarray:
        buffer[0] = seed.spawn_key[0]
        return buffer

    with ThreadPoolExecutor(1) as pool:
        for options in ({"workers": 1}, {"executor": pool}, {"workers": 2}):
            study = studies.run(trial, studies.spawn(1, 9), chunk=9, **options)
            assert (study.array()[:, 0] == np.arange(9)).all()
    assert buffer[0] == 0


def _blas_threads(seed: SeedSequence) -> list[int]:
    import scipy.linalg  # noqa: F401
    from threadpoolctl import threadpool_info

    return [lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"]


def test_threads_of_every_blas_are_held_and_given_back(spawned_pool: Executor) -> None:
    before = _blas_threads(SeedSequence(0))
    assert before
    with ThreadPoolExecutor(4) as threads:
        for options in ({"workers": 1}, {"workers": 2}, {"executor": spawned_pool},
                        {"executor": threads}):
            for wanted in (1, 2):
                study = studies.run(
                    _blas_threads, studies.spawn(0, 8), blas_threads=wanted, **options
                )
                # A library that was built for one thread stays at one.
                assert all(set(found) <= {1, wanted} for found in study.values)
                assert all(wanted in found for found in study.values)
    assert _blas_threads(SeedSequence(0)) == before


# Trials that fail.


@pytest.mark.parametrize("workers", [1, 2])
def test_a_trial_that_raises_is_named_and_the_others_kept(workers: int) -> None:
    trial = partial(fails_at, (3, 17))
    study = studies.run(trial, studies.spawn(9, 30), workers=workers, errors="collect")
    assert [f.index for f in study.failures] == [3, 17] and study.missing == ()
    assert [v for v in study.values if v is not None] == [
        float(i) for i in range(30) if i not in (3, 17)
    ]
    first = study.failures[0]
    assert first.kind == "ArithmeticError" and "fails_at" in first.traceback
    assert str(first) == (
        "trial 3, SeedSequence(9, spawn_key=(3,)): ArithmeticError: trial 3 diverged"
    )
    for _ in range(2):
        with pytest.raises(ArithmeticError, match="trial 3 diverged"):
            trial(first.seed)


@pytest.mark.parametrize("workers", [1, 2])
def test_raise_stops_at_the_first_failure_and_keeps_what_was_done(workers: int) -> None:
    trial = partial(fails_at, (10,))
    with pytest.raises(StudyError, match="trial 10 diverged") as caught:
        studies.run(trial, studies.spawn(9, 2000), workers=workers, chunk=1)
    study = caught.value.study
    assert [f.index for f in study.failures] == [10]
    # At most four chunks a worker are ahead of the oldest that is not back.
    assert study.done.sum() >= 3 and len(study.missing) > 1900
    assert len(study.missing) + study.done.sum() + 1 == 2000
    # What is missing completes the study.
    rest = studies.run(number, [study.seed(i) for i in study.missing], workers=1)
    assert list(rest.values) == list(study.missing)


def test_values_that_cannot_travel_and_exits_are_failures() -> None:
    def odd(seed: SeedSequence) -> Any:
        if seed.spawn_key[0] == 0:
            return (k for k in range(3))
        if seed.spawn_key[0] == 1:
            sys.exit(2)
        return 1.0

    study = studies.run(odd, studies.spawn(1, 3), workers=2, errors="collect")
    assert [f.kind for f in study.failures] == ["TypeError", "SystemExit"]
    assert study.values[2] == 1.0


def test_trials_that_kill_their_worker_are_the_ones_named() -> None:
    study = studies.run(
        partial(dies_at, (37, 120)), studies.spawn(4, 200), workers=2, errors="collect"
    )
    assert [(f.index, f.kind) for f in study.failures] == [(37, "died"), (120, "died")]
    assert [f.seed.spawn_key for f in study.failures] == [(37,), (120,)]
    assert [f.seed.entropy for f in study.failures] == [4, 4]
    assert study.done.sum() == 198
    assert [v for v in study.values if v is not None] == [
        i for i in range(200) if i not in (37, 120)
    ]
    assert "EXIT(3)" in study.failures[0].traceback


def test_a_dead_worker_stops_a_study_that_raises() -> None:
    with pytest.raises(StudyError, match="trial 5, .*worker process died") as caught:
        studies.run(partial(dies_at, (5,)), studies.spawn(4, 50), workers=2)
    assert caught.value.study.done[:5].all()


def test_a_foreign_pool_that_breaks_gives_the_partial_study(spawned_pool: Executor) -> None:
    with pytest.raises(StudyError, match="the pool failed") as caught:
        studies.run(
            partial(dies_at, (60,)),
            studies.spawn(4, 80),
            executor=spawned_pool,
            chunk=2,
            errors="collect",
        )
    study = caught.value.study
    assert study.done.sum() >= 40 and not study.done[60] and 60 in study.missing
    assert all(study.values[i] == i for i in np.flatnonzero(study.done))


def test_a_pool_that_is_shut_down_gives_the_partial_study() -> None:
    pool = ThreadPoolExecutor(1)

    def trial(seed: SeedSequence) -> int:
        return int(seed.spawn_key[0])

    pool.shutdown()
    with pytest.raises(StudyError, match="the pool failed") as caught:
        studies.run(trial, studies.spawn(4, 8), executor=pool)
    assert caught.value.study.missing == tuple(range(8))


def test_chunks_that_are_cancelled_do_not_hang() -> None:
    pool = ThreadPoolExecutor(1)
    killer = threading.Timer(0.2, pool.shutdown, kwargs={"wait": False, "cancel_futures": True})
    killer.start()

    def trial(seed: SeedSequence) -> int:
        time.sleep(0.05)
        return int(seed.spawn_key[0])

    with pytest.raises(StudyError, match="the pool failed") as caught:
        studies.run(trial, studies.spawn(4, 200), executor=pool, chunk=1)
    killer.join()
    assert caught.value.study.values[0] == 0


def test_a_worker_with_other_versions_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    from bookkit.studies import _worker

    real = _worker.versions()
    monkeypatch.setattr(_worker, "versions", lambda: (("distfilt", "0.0.0"), *real[1:]))
    with pytest.raises(StudyError, match="0.0.0"):
        studies.run(number, studies.spawn(1, 4), workers=2, errors="collect")



# Trials that take too long.


def slow_at(bad: tuple[int, ...], kind: str, seed: SeedSequence) -> int:
    """Some trials sleep, spin in Python, catch everything, or stay in compiled code."""
    k = int(seed.spawn_key[0])
    began = time.monotonic()
    while k in bad and time.monotonic() - began < 60:
        if kind == "sleep":
            time.sleep(60)
        elif kind == "catch":
            with contextlib.suppress(Exception):
                time.sleep(60)
        elif kind == "compiled":
            sum(range(10**12))
    return k


@pytest.mark.parametrize("kind", ["sleep", "spin", "catch"])
@pytest.mark.parametrize("workers", [1, 2])
def test_a_trial_that_takes_too_long_is_named_and_the_others_kept(kind: str, workers: int) -> None:
    trial = partial(slow_at, (3, 7), kind)
    study = studies.run(
        trial, studies.spawn(9, 12), workers=workers, errors="collect", timeout=1.0
    )
    assert [(f.index, f.kind) for f in study.failures] == [(3, "timeout"), (7, "timeout")]
    assert str(study.failures[0]).endswith("(9, spawn_key=(3,)): no value after 1 s")
    assert [v for v in study.values if v is not None] == [
        i for i in range(12) if i not in (3, 7)
    ]


def test_a_trial_that_hangs_in_compiled_code_loses_its_process() -> None:
    study = studies.run(
        partial(slow_at, (2,), "compiled"), studies.spawn(9, 6), workers=2, errors="collect",
        timeout=1.0,
    )  # fmt: skip
    assert [(f.index, f.kind) for f in study.failures] == [(2, "timeout")]
    assert study.done.sum() == 5


def test_time_is_over_in_a_thread_when_the_trial_ends() -> None:
    with ThreadPoolExecutor(2) as pool:
        study = studies.run(
            lambda s: time.sleep(0.2 * (s.spawn_key[0] == 1)), studies.spawn(1, 3),
            executor=pool, errors="collect", timeout=0.1,
        )  # fmt: skip
    assert [(f.index, f.kind) for f in study.failures] == [(1, "timeout")]


def test_a_limit_stops_a_study_that_raises_and_leaves_no_alarm() -> None:
    before = signal.getsignal(signal.SIGALRM)
    with pytest.raises(StudyError, match="trial 1, .*no value after 0.2 s"):
        studies.run(partial(slow_at, (1,), "sleep"), studies.spawn(1, 3), workers=1, timeout=0.2)
    assert signal.getsignal(signal.SIGALRM) is before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    quick = studies.run(number, studies.spawn(1, 20), workers=1, timeout=5.0)
    assert list(quick.values) == list(range(20))


# Ctrl-C.

INTERRUPTED = """
import signal, sys, time
from bookkit import studies

signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell ignores it

def trial(seed):
    if seed.spawn_key[0] == 30:
        print("running", flush=True)
    time.sleep(0.02)
    return seed.spawn_key[0]

if __name__ == "__main__":
    try:
        studies.run(trial, studies.spawn(1, 2000), workers={workers}, progress=False)
    except KeyboardInterrupt as stop:
        study = stop.study
        kept = [v for v in study.values if v is not None]
        assert kept == [i for i in range(2000) if study.done[i]]
        print(type(stop).__name__, len(kept), len(study.failures), len(study.missing), flush=True)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals to a group of processes")
@pytest.mark.parametrize("workers", [1, 2])
def test_ctrl_c_keeps_the_partial_study(workers: int, tmp_path: Path) -> None:
    """As in a terminal: the signal reaches the workers too."""
    script = tmp_path / "long.py"
    script.write_text(INTERRUPTED.format(workers=workers), encoding="utf-8")
    process = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "running\n"
    time.sleep(0.5)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=20)  # the rest of the study would take far longer
    # loky's own tracker may still report a semaphore that the signal left behind.
    assert "Traceback" not in err and process.returncode == 0
    name, kept, failed, missing = out.split()
    assert name == "StudyInterrupted" and failed == "0"
    assert 0 < int(kept) < 2000 and int(kept) + int(missing) == 2000


def test_ctrl_c_is_a_keyboard_interrupt() -> None:
    def trial(seed: SeedSequence) -> int:
        if seed.spawn_key[0] == 3:
            raise KeyboardInterrupt
        return int(seed.spawn_key[0])

    assert issubclass(StudyInterrupted, KeyboardInterrupt)
    with pytest.raises(StudyInterrupted, match="3 done") as caught:
        studies.run(trial, studies.spawn(1, 9), workers=1, chunk=1)
    assert caught.value.study.values[:4] == (0, 1, 2, None)


# A parent that is killed.

KILLED = """
import os, time
from bookkit import studies

def trial(seed):
    with open(f"{os.getpid()}.pid", "w"):
        pass
    time.sleep(60)

studies.run(trial, studies.spawn(1, 4), workers=2, progress=False)
"""


def _alive(pid: int) -> bool:
    """Whether the process still runs; one that nobody has waited for yet does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for processes in /proc")
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_their_parent(how: signal.Signals, tmp_path: Path) -> None:
    script = tmp_path / "killed.py"
    script.write_text(KILLED, encoding="utf-8")
    process = subprocess.Popen(
        [sys.executable, str(script)], cwd=tmp_path, start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )  # fmt: skip
    began = time.monotonic()
    while len(list(tmp_path.glob("*.pid"))) < 2 and time.monotonic() - began < 60:
        time.sleep(0.05)
    workers = [int(path.stem) for path in tmp_path.glob("*.pid")]
    assert len(workers) == 2 and all(map(_alive, workers))
    process.send_signal(how)
    process.wait()
    began = time.monotonic()
    while any(map(_alive, workers)) and time.monotonic() - began < 20:
        time.sleep(0.05)
    assert not any(map(_alive, workers))


def test_an_executor_s_own_number_of_workers_is_used_unless_another_is_given() -> None:
    with ThreadPoolExecutor(max_workers=3) as threads:
        assert Pool(threads, None).workers == 3
        assert Pool(threads, 2).workers == 2


def test_what_came_back_is_kept_when_the_taker_stops() -> None:
    back, broken, dropped, away = (Future[Any]() for _ in range(4))
    back.set_result(["one", "two"])
    broken.set_exception(OSError())
    dropped.cancel()
    flight = Flight(Pool(None, 1), Any, [], None)
    flight.flying = {future: [] for future in (away, broken, back, dropped)}
    assert flight.arrived() == ["one", "two"]
