"""Studies: the same bits everywhere, and nothing lost when a trial, a worker or the user stops."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import SeedSequence

from distfilt import studies
from distfilt.studies import Failure, Stored, Study, StudyError, StudyInterrupted

ROOT = Path(__file__).resolve().parents[2]


class Scores(NamedTuple):
    rmse: float
    nees: float


def draw(seed: SeedSequence) -> Any:
    """A trial with linear algebra and child streams, whose bits show any difference."""
    first, second = (np.random.default_rng(child) for child in seed.spawn(2))
    x = first.normal(size=(40, 40))
    return np.linalg.eigvalsh(x @ x.T)[[0, -1]], second.normal()


def number(seed: SeedSequence) -> int:
    return int(seed.spawn_key[0])


def scores(seed: SeedSequence) -> Scores:
    a, b = np.random.default_rng(seed).normal(size=2)
    return Scores(float(abs(a)), float(b * b))


def fails_at(bad: tuple[int, ...], seed: SeedSequence) -> float:
    if seed.spawn_key[0] in bad:
        raise ArithmeticError(f"trial {seed.spawn_key[0]} diverged")
    return float(seed.spawn_key[0])


def dies_at(bad: tuple[int, ...], seed: SeedSequence) -> int:
    if seed.spawn_key[0] in bad:
        os._exit(3)
    time.sleep(0.002)
    return int(seed.spawn_key[0])


def _study(**options: Any) -> Study:
    return studies.run(scores, studies.spawn(5, 6), workers=1, **options)


def _stored(folder: Path, text: str) -> Path:
    path = folder / "a.csv"
    path.write_text(text, encoding="utf-8", newline="")
    return path


def _store(study: Any = None, path: Any = "unused.csv", **options: Any) -> Path:
    chosen = {"parameters": {}, "columns": ["rmse", "nees"], **options}
    return studies.store(_study() if study is None else study, path, **chosen)


def _partial_study() -> Study:
    recipes = _study().recipes
    return Study((1.0,) * 6, np.arange(6) < 4, (), 0.0, recipes)


def _with_failure(kind: str) -> Study:
    recipes = _study().recipes
    failure = Failure(5, recipes[5], kind, "")
    return Study((Scores(1.0, 2.0),) * 6, np.arange(6) < 5, (failure,), 0.0, recipes)


_KEPT = [Path(__file__)]  # any file that is no stored study
_P = "distfilt.studies."
BAD_INPUT = {
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
        ("blas_threads", lambda: studies.run(number, [1], workers=1, blas_threads=0)),
    ],
    _P + "spawn": [
        ("root", lambda: studies.spawn(-1, 3)),
        ("root", lambda: studies.spawn(None, 3)),
        ("n", lambda: studies.spawn(1, 0)),
    ],
    _P + "Study": [
        ("values", lambda: Study((), np.ones(6), (), 0.0, _study().recipes)),
        ("done", lambda: Study((None,) * 6, np.ones(5), (), 0.0, _study().recipes)),
        (
            "failures",
            lambda: Study(
                (1.0,) * 6,
                np.ones(6),
                (Failure(0, _study().recipes[0], "", ""),),
                0.0,
                _study().recipes,
            ),
        ),
        ("index", lambda: _study().seed(6)),
        ("index", lambda: _study().seed(-1)),
        ("values", lambda: studies.run(draw, [1, 2], workers=1).array()),
        ("columns", lambda: _study().metrics("rmse")),
        ("columns", lambda: _study().metrics(["rmse", "rmse"])),
        ("columns", lambda: _study().metrics(["crps"])),
        ("columns", lambda: studies.run(np.random.default_rng, [1], workers=1).metrics([])),
        ("values", lambda: studies.run(draw, [1], workers=1).metrics(["a", "b"])),
        ("columns", lambda: studies.run(partial(fails_at, ()), studies.spawn(1, 2), workers=1)
            .metrics(["a", "b"])),
    ],
    _P + "StudyError": [
        ("trial 1", lambda: studies.run(partial(fails_at, (1,)), studies.spawn(1, 3), workers=1)),
    ],
    _P + "fingerprint": [
        ("function", lambda: studies.fingerprint(3)),
        ("function", lambda: studies.fingerprint(len)),
    ],
    _P + "store": [
        ("study", lambda: _store([1.0])),
        ("study", lambda: _store(_partial_study())),
        ("study", lambda: _store(_with_failure("died"))),
        ("study", lambda: _store(studies.run(scores, [SeedSequence(1, pool_size=8)], workers=1))),
        ("path", lambda: _store(path=3)),
        ("columns", lambda: _store(columns=["rmse", "crps"])),
        ("columns", lambda: _store(columns=["index"])),
        ("columns", lambda: _store(columns=["a,b"])),
        ("parameters", lambda: _store(parameters=[1])),
        ("parameters", lambda: _store(parameters={"a b": 1})),
        ("parameters", lambda: _store(parameters={"gain": float("nan")})),
        ("parameters", lambda: _store(parameters={"model": number})),
        ("code", lambda: _store(code=3)),
        ("function", lambda: _store(code=[len])),
        ("values", lambda: _store(_big(), columns=["value"])),
    ],
    _P + "load": [
        ("path", lambda: studies.load(3)),
        ("path", lambda: studies.load("no-such-file.csv")),
        ("line 1", lambda: studies.load(_KEPT[0])),
    ],
    _P + "Stored": [
        ("column", lambda: _example().metric("crps")),
        ("index", lambda: _example().seed(2)),
    ],
    _P + "check": [
        ("path", lambda: studies.check("no-such-file.csv", scores)),
    ],
}
EXEMPT = {
    _P + "Failure": "made by run, from what a worker sends",
    _P + "StudyInterrupted": "raised by Ctrl-C; tested with a signal below",
}


def _big() -> Study:
    return studies.run(lambda seed: 2**53 + 1, [1], workers=1)


def _example() -> Stored:
    recipes = tuple(_study().recipes[:2])
    return Stored(Path("a.csv"), {}, {}, {}, recipes, ("", ""), {"rmse": np.ones(2)})


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
    from distfilt.studies import _worker

    real = _worker.versions()
    monkeypatch.setattr(_worker, "versions", lambda: (("distfilt", "0.0.0"), *real[1:]))
    with pytest.raises(StudyError, match="0.0.0"):
        studies.run(number, studies.spawn(1, 4), workers=2, errors="collect")


# Ctrl-C.

INTERRUPTED = """
import sys, time
from distfilt import studies

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
    began = time.monotonic()
    out, err = process.communicate(timeout=20)
    assert time.monotonic() - began < 5
    assert err == "" and process.returncode == 0
    name, kept, failed, missing = out.split()
    assert name == "StudyInterrupted" and failed == "0"
    assert 20 <= int(kept) < 500 and int(kept) + int(missing) == 2000


def test_ctrl_c_is_a_keyboard_interrupt() -> None:
    def trial(seed: SeedSequence) -> int:
        if seed.spawn_key[0] == 3:
            raise KeyboardInterrupt
        return int(seed.spawn_key[0])

    assert issubclass(StudyInterrupted, KeyboardInterrupt)
    with pytest.raises(StudyInterrupted, match="3 done") as caught:
        studies.run(trial, studies.spawn(1, 9), workers=1, chunk=1)
    assert caught.value.study.values[:4] == (0, 1, 2, None)


# Notebooks and scripts.

CELLS = [
    """
    from dataclasses import dataclass
    import numpy as np
    from distfilt import studies
    scale = 3
    """,
    """
    @dataclass(frozen=True)
    class Score:
        rmse: float

    def inner(rng):
        return scale * rng.normal()

    def trial(seed):
        return Score(inner(np.random.default_rng(seed)))
    """,
    """
    study = studies.run(trial, studies.spawn(1, 40), workers=2)
    alone = studies.run(trial, studies.spawn(1, 40), workers=1)
    assert study.values == alone.values and len(set(study.values)) == 40
    assert all(type(v) is Score for v in study.values)
    assert set(study.code) == {"trial"}
    study
    """,
]


def _notebook() -> Any:
    import nbformat
    from nbformat.v4 import new_code_cell, new_notebook

    notebook = new_notebook(cells=[new_code_cell(textwrap.dedent(c).strip()) for c in CELLS])
    notebook.metadata["kernelspec"] = {
        "name": "python3", "display_name": "Python 3", "language": "python",
    }
    nbformat.validate(notebook)
    return notebook


@pytest.fixture(scope="module")
def executed() -> Any:
    from nbclient import NotebookClient

    notebook = _notebook()
    NotebookClient(notebook, timeout=60, kernel_name="python3").execute()
    return notebook


def test_functions_and_classes_of_a_notebook_run_in_silence(executed: Any) -> None:
    outputs = [output for cell in executed.cells for output in cell.outputs]
    assert [output.output_type for output in outputs] == ["execute_result"]
    assert outputs[0]["data"]["text/plain"] == "Study(40 trials: 40 done, 0 failed, 0 not run)"


@pytest.mark.slow
def test_nbval_sees_nothing_but_the_result(executed: Any, tmp_path: Path) -> None:
    import nbformat

    path = tmp_path / "study.ipynb"
    nbformat.write(executed, path)
    environment = {k: v for k, v in os.environ.items() if k not in ("CI", "TQDM_DISABLE")}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--nbval"]
    done = subprocess.run(
        [*command, "--rootdir", str(tmp_path), str(path)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "3 passed" in done.stdout, done.stdout + done.stderr


def test_a_script_is_silent_in_a_pipe(tmp_path: Path) -> None:
    """A bar is asked for, and nobody watches; the functions are ``__main__``'s, without a guard."""
    script = tmp_path / "script.py"
    script.write_text(
        textwrap.dedent("""
        from dataclasses import dataclass
        from distfilt import studies

        @dataclass
        class Score:
            rmse: int

        study = studies.run(lambda seed: Score(seed.spawn_key[0]), studies.spawn(1, 20), workers=2)
        assert study.values == tuple(Score(i) for i in range(20))
        """),
        encoding="utf-8",
    )
    names = ("CI", "TQDM_DISABLE", "PYTEST_CURRENT_TEST")
    environment = {k: v for k, v in os.environ.items() if k not in names}
    done = subprocess.run(
        [sys.executable, "-W", "error", str(script)],
        env=environment, capture_output=True, text=True,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.slow
def test_a_worker_whose_memory_grows_is_replaced_without_a_word() -> None:
    import warnings

    def hoard(seed: SeedSequence) -> int:
        sys.__dict__.setdefault("hoard", []).append(np.ones(2**23))
        time.sleep(0.3)
        return int(seed.spawn_key[0])

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        study = studies.run(hoard, studies.spawn(1, 60), workers=2, chunk=1)
    assert list(study.values) == list(range(60))


# What a study gives.


def test_metrics_of_mappings_tuples_vectors_and_numbers() -> None:
    @dataclass(frozen=True)
    class Score:
        b: float
        a: int

    seeds = studies.spawn(1, 4)
    trials: list[Callable[[SeedSequence], Any]] = [
        lambda s: {"b": 0.5, "a": s.spawn_key[0]},
        lambda s: Score(0.5, s.spawn_key[0]),
        lambda s: np.array([s.spawn_key[0], 0.5]),
        lambda s: (s.spawn_key[0], np.float32(0.5)),
    ]
    for trial in trials:
        found = studies.run(trial, seeds, workers=1).metrics(["a", "b"])
        assert list(found) == ["a", "b"]
        assert found["a"].tolist() == [0, 1, 2, 3] and found["b"].tolist() == [0.5] * 4
    study = studies.run(partial(fails_at, (1,)), seeds, workers=1, errors="collect")
    assert study.metrics(["x"])["x"].tolist() == [0, 2, 3] == study.array().tolist()
    frame = study.frame(["x"])
    assert frame.index.tolist() == [0, 2, 3] and frame["x"].tolist() == [0, 2, 3]


def test_done_cannot_be_written() -> None:
    with pytest.raises(ValueError, match="read-only"):
        _study().done[0] = False


def test_fingerprint_follows_the_source() -> None:
    def one() -> int:
        return 1

    def two() -> int:
        return 2

    assert studies.fingerprint(one) != studies.fingerprint(two)
    assert studies.fingerprint(partial(fails_at, (1,))) == studies.fingerprint(fails_at)
    assert studies.fingerprint(Scores) != studies.fingerprint(fails_at)
    # What a reader computes by hand.
    import hashlib
    import inspect

    text = textwrap.dedent(inspect.getsource(one)).strip()
    assert studies.fingerprint(one) == hashlib.sha256(text.encode()).hexdigest()[:16]


# Stored studies.


@given(
    st.lists(
        st.tuples(st.integers(0, 2**130), st.floats(width=64), st.integers(-(2**53), 2**53)),
        min_size=1,
        max_size=5,
        unique_by=lambda row: row[0],
    )
)
def test_every_float_and_seed_comes_back(rows: list[tuple[int, float, int]]) -> None:
    import tempfile

    given_rows = {SeedSequence(e).entropy: (x, k) for e, x, k in rows}
    study = studies.run(lambda s: given_rows[s.entropy], list(given_rows), workers=1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "deep" / "a.csv"
        studies.store(study, path, parameters={}, columns=["x", "k"])
        stored = studies.load(path)
    wanted = study.metrics(["x", "k"])
    for name in ("x", "k"):
        same = stored.metric(name) == wanted[name]
        assert (same | (np.isnan(wanted[name]) & np.isnan(stored.metric(name)))).all()
        assert (np.signbit(stored.metric(name)) == np.signbit(wanted[name])).sum() >= same.sum()
    assert stored.recipes == study.recipes


def test_a_stored_study_says_how_it_was_made(tmp_path: Path) -> None:
    parameters = {"gain": 0.1, "members": np.int64(50), "x0": np.array([1.0, 2.5]), "rule": "mean"}
    seeds = [*studies.spawn(5, 4), SeedSequence([1, 2]), 9]
    study = studies.run(scores, seeds, workers=1)
    path = studies.store(
        study, tmp_path / "a.csv", parameters=parameters, columns=["rmse", "nees"], code=[fails_at]
    )
    stored = studies.load(path)
    assert stored.parameters == {"gain": 0.1, "members": 50, "x0": [1.0, 2.5], "rule": "mean"}
    assert stored.code == {f.__name__: studies.fingerprint(f) for f in (scores, fails_at)}
    assert set(stored.versions) == {"distfilt", "numpy", "python"}
    assert stored.versions["numpy"] == np.__version__
    assert scores(stored.seed(3)) == study.values[3] and scores(stored.seed(4)) == study.values[4]
    before = path.read_bytes()
    assert b"\r" not in before
    studies.store(
        studies.run(scores, seeds, workers=2), path, parameters=parameters,
        columns=["rmse", "nees"], code=[fails_at],
    )
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_a_failure_is_stored_and_has_to_fail_again(tmp_path: Path) -> None:
    trial = partial(fails_at, (2,))
    study = studies.run(trial, studies.spawn(5, 5), workers=1, errors="collect")
    path = studies.store(study, tmp_path / "a.csv", parameters={}, columns=["x"])
    stored = studies.check(path, trial)
    assert stored.failures == ("", "", "ArithmeticError", "", "")
    assert stored.metric("x").tolist() == [0, 1, 3, 4] and np.isnan(stored.columns["x"][2])
    with pytest.raises(AssertionError, match="trial 2: stored ArithmeticError, now a value"):
        studies.check(path, partial(fails_at, ()))
    with pytest.raises(AssertionError, match="trial 1: stored a value, now ArithmeticError"):
        studies.check(path, partial(fails_at, (1, 2)), indices=[1])


def test_check_finds_the_last_bit(tmp_path: Path) -> None:
    path = _store(path=tmp_path / "a.csv")
    stored = studies.check(path, scores, indices=[0, 4])
    assert len(stored) == 6
    studies.check(path, scores, workers=2)
    value = float(stored.columns["rmse"][4])
    text = path.read_text(encoding="utf-8")
    wrong = text.replace(repr(value), repr(float(np.nextafter(value, 9.0))))
    assert wrong != text
    path.write_text(wrong, encoding="utf-8")
    studies.check(path, scores, indices=[0, 1, 2, 3, 5])
    studies.check(path, scores, rtol=1e-12)
    with pytest.raises(AssertionError, match="trial 4: rmse stored") as caught:
        studies.check(path, scores, indices=[0, 4])
    assert "source" not in str(caught.value)

    def other(seed: SeedSequence) -> Scores:
        return Scores(*(2 * v for v in scores(seed)))

    other.__qualname__ = "scores"
    with pytest.raises(AssertionError, match="the source of scores is another one"):
        studies.check(path, other, indices=[0], rtol=0.1)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"indices": []}, "indices"),
        ({"indices": [6]}, "indices"),
        ({"indices": [1, 1]}, "indices"),
        ({"indices": 3}, "indices"),
        ({"rtol": -1.0}, "rtol"),
        ({"workers": 0}, "workers"),
    ],
)
def test_check_refuses(options: dict[str, Any], name: str, tmp_path: Path) -> None:
    path = _store(path=tmp_path / "a.csv")
    with pytest.raises(ValueError, match=name):
        studies.check(path, scores, **options)


GOOD = (
    '# distfilt study, format 1\n# version numpy: "2.0.0"\n# parameter gain: 0.5\n'
    "index,entropy,spawn_key,failure,rmse\n0,1,0,,0.5\n1,1,1,ValueError,\n2,1,2 7,,nan\n"
)


@pytest.mark.parametrize(
    ("old", "new", "line", "word"),
    [
        ("format 1", "format 2", 1, "format 1"),
        (": 0.5", " 0.5", 3, "JSON"),
        (": 0.5", ": 0,5", 3, "Extra data"),
        ("# parameter gain", "# remark gain", 3, "parameter"),
        ("# version numpy: \"2.0.0\"", "# parameter gain: 1", 3, "already"),
        ("index,", "trial,", 4, "index"),
        (",rmse", "", 4, "columns"),
        (",rmse", ",rmse,rmse", 4, "columns"),
        ("0,1,0,,0.5", "0,1,0,,0.5,0.6", 5, "cells"),
        ("0,1,0,,0.5", "1,1,0,,0.5", 5, "index"),
        ("0,1,0,,0.5", "0,x,0,,0.5", 5, "entropy"),
        ("0,1,0,,0.5", "0,,0,,0.5", 5, "entropy"),
        ("0,1,0,,0.5", "0,1,-1,,0.5", 5, "spawn_key"),
        ("0,1,0,,0.5", "0,1,0,,", 5, "rmse"),
        ("0,1,0,,0.5", "0,1,0,,half", 5, "rmse"),
        ("0,1,0,,0.5", "0,1,0,,0.50", 5, "rmse"),
        ("ValueError,", "ValueError,0.1", 6, "failed"),
        ("ValueError,", "a value,", 6, "failure"),
        ("2,1,2 7", "2,1,1", 7, "different seeds"),
        ("\n2,1", "\n\n2,1", 8, "empty line"),
        ("nan\n", "nan", 7, "end of line"),
        ("0,1,0,,0.5\n1,1,1,ValueError,\n2,1,2 7,,nan\n", "", 5, "at least one trial"),
        ("nan", "n\u00e9", 7, "rmse"),
    ],
)
def test_a_malformed_file_is_refused_with_its_line(
    old: str, new: str, line: int, word: str, tmp_path: Path
) -> None:
    assert len(studies.load(_stored(tmp_path, GOOD))) == 3
    assert GOOD.count(old) == 1
    path = _stored(tmp_path, GOOD.replace(old, new))
    with pytest.raises(ValueError, match=rf"a\.csv, line {line}: .*{word}"):
        studies.load(path)


def test_a_file_that_is_not_text_is_refused_with_its_line(tmp_path: Path) -> None:
    path = _stored(tmp_path, GOOD)
    path.write_bytes(path.read_bytes().replace(b"nan", b"\xff"))
    with pytest.raises(ValueError, match="line 7"):
        studies.load(path)


# `make studies`.


def _tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("tool", ROOT / "book" / "tools" / "studies.py")
    assert spec is not None and spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    return tool


SCRIPT = """
import numpy as np
from distfilt import studies

NAME, PAPER = "spread", "zheng"
parameters = {"members": 20}
columns = ["mean", "spread"]
seeds = studies.spawn(2023, 12)

def trial(seed):
    x = np.random.default_rng(seed).normal(size=parameters["members"])
    return x.mean(), x.std()
"""


def test_make_studies_without_a_script(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _tool().main([], tmp_path) == 0
    assert "no script" in capsys.readouterr().out


def test_make_studies_stores_and_checks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tool, folder = _tool(), tmp_path / "book" / "studies"
    folder.mkdir(parents=True)
    script = folder / "spread.py"
    script.write_text(SCRIPT, encoding="utf-8")
    assert tool.main(["--check"], tmp_path) == 1
    assert "not stored yet" in capsys.readouterr().err
    assert tool.main(["--workers", "2"], tmp_path) == 0
    path = tmp_path / "data" / "studies" / "zheng" / "spread.csv"
    stored = studies.load(path)
    assert len(stored) == 12 and stored.parameters == {"members": 20} and "trial" in stored.code
    assert tool.main(["spread", "--check", "--workers", "1"], tmp_path) == 0
    assert tool.main(["sprawl"], tmp_path) == 1
    capsys.readouterr()
    for old, new, word in [
        ("size=para", "loc=1e-12, size=para", "another run"),
        ("2023, 12", "2023, 11", "other seeds"),
        ('"members": 20', '"rule": "mean", "members": 20', "other parameters"),
        ('"spread", "z', '"spreads", "z', "no script in book/studies makes it"),
    ]:
        script.write_text(SCRIPT.replace(old, new), encoding="utf-8")
        os.utime(script, (0, hash(word) % 2**30))  # a new time: python caches by it
        assert tool.main(["--check", "--workers", "1"], tmp_path) == 1
        assert word in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("columns =", "names =", "columns"),
        ('"zheng"', '"chang"', "PAPER"),
        ('"spread", "zheng"', '"a/b", "zheng"', "NAME"),
    ],
)
def test_make_studies_refuses_a_script(old: str, new: str, word: str, tmp_path: Path) -> None:
    folder = tmp_path / "book" / "studies"
    folder.mkdir(parents=True)
    (folder / "a.py").write_text(SCRIPT.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ValueError, match=word):
        _tool().main([], tmp_path)


@pytest.mark.slow
def test_every_stored_study_runs_again() -> None:
    assert _tool().main(["--check"]) == 0
