"""Studies: the same bits everywhere, and no loss if a trial, a worker or a client stops."""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import SeedSequence

from bookkit import studies
from bookkit.folders import data_root
from bookkit.studies import StudyError

COLUMNS = ["mean", "norm"]


def draw(seed: SeedSequence) -> list[float]:
    """Return numbers whose last bits depend on the order of sums."""
    rng = np.random.default_rng(seed.spawn(1)[0])
    a = rng.standard_normal((40, 40))
    return [float((a @ a).mean()), float(np.linalg.norm(a))]


def fails_at(bad: tuple[int, ...], seed: SeedSequence) -> list[float]:
    # `spawn` numbers the trials by their spawn keys.
    if seed.spawn_key[0] in bad:
        raise ArithmeticError(f"no value for {seed.spawn_key[0]}")
    return draw(seed)


def dies_at(bad: int, seed: SeedSequence) -> list[float]:
    if seed.spawn_key[0] == bad:
        os.kill(os.getpid(), signal.SIGKILL)
    return draw(seed)


def bits(study: studies.Study) -> bytes:
    return np.array(study.values, dtype=float).tobytes()


SEEDS = studies.spawn(7, 30)
REFERENCE = np.array([draw(seed) for seed in SEEDS]).tobytes()


def store(path: Path, **options: Any) -> Path:
    options = {"workers": 1, "columns": COLUMNS, "parameters": {"size": 40}} | options
    return studies.store(
        path, options.pop("trial", draw), options.pop("seeds", SEEDS), **options
    )


def test_neither_workers_nor_executor_change_a_bit() -> None:
    # Sums depend on their order and on the number of threads; both are fixed.
    assert bits(studies.run(draw, SEEDS, workers=2)) == REFERENCE
    with ThreadPoolExecutor(3) as threads:
        assert bits(studies.run(draw, SEEDS, executor=threads)) == REFERENCE
    # A spawned worker imports nothing of this module: the trial is sent by value.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        assert bits(studies.run(draw, SEEDS, executor=pool)) == REFERENCE


def test_seeds_are_numpy_s_own_children_whatever_was_spawned_from_them() -> None:
    for ours, theirs in zip(
        studies.spawn(2023, 5), SeedSequence(2023).spawn(5), strict=True
    ):
        # Spawning by the caller must not shift the children that a trial spawns.
        first = theirs.spawn(3)[0].generate_state(2)
        study = studies.run(
            lambda s: s.spawn(1)[0].generate_state(2), [ours, theirs], workers=1
        )
        assert (np.array(study.values) == first).all()
        assert theirs.n_children_spawned == 3
    study = studies.run(lambda s: s.generate_state(2), [5], workers=1)
    assert (study.values[0] == SeedSequence(5).generate_state(2)).all()


def test_values_that_share_a_buffer_are_kept_apart() -> None:
    buffer = np.zeros(1)

    def trial(seed: SeedSequence) -> np.ndarray:
        buffer[0] = seed.spawn_key[0]
        return buffer

    # A thread shares the buffer with this test; a process would copy it.
    with ThreadPoolExecutor(1) as pool:
        study = studies.run(trial, studies.spawn(1, 9), executor=pool)
    assert study.metrics(["k"])["k"].tolist() == list(range(9))


def test_metrics_are_taken_by_name_or_in_order() -> None:
    study = studies.run(
        lambda s: {"b": 2, "a": s.spawn_key[0]}, studies.spawn(1, 2), workers=1
    )
    assert study.metrics(["a"])["a"].tolist() == [0.0, 1.0]


def test_one_blas_thread_in_every_worker() -> None:
    def threads(seed: SeedSequence) -> list[int]:
        import scipy.linalg  # noqa: F401
        from threadpoolctl import threadpool_info

        return [
            lib["num_threads"] for lib in threadpool_info() if lib["user_api"] == "blas"
        ]

    for workers in (1, 2):
        study = studies.run(threads, [1, 2], workers=workers)
        assert all(set(threads_of_trial) == {1} for threads_of_trial in study.values)


# Failures.


@pytest.mark.parametrize("workers", [1, 2])
def test_a_raised_trial_is_reported_with_its_seed_and_the_others_are_kept(
    workers: int,
) -> None:
    trial = partial(fails_at, (3, 11))
    study = studies.run(trial, SEEDS, workers=workers, errors="collect")
    assert [f.which for f in study.failures] == [3, 11]
    assert study.done.sum() == 28
    assert study.failures[1].kind == "ArithmeticError"
    assert "spawn_key=(11,)" in str(study.failures[1])
    assert "no value for 11" in str(study.failures[1])
    # The reported seed makes the same trial fail here.
    with pytest.raises(ArithmeticError):
        trial(study.failures[0].seed)
    with pytest.raises(StudyError, match="trial 3, SeedSequence") as caught:
        studies.run(trial, SEEDS, workers=workers)
    assert caught.value.study is not None
    assert caught.value.study.done.sum() == 28


@pytest.mark.parametrize("bad", [5, 29])
def test_a_killed_worker_costs_its_own_trial_only(bad: int, tmp_path: Path) -> None:
    with pytest.raises(
        StudyError, match=f"trial {bad}, .*(?s:.*)the other trials are in .*.part"
    ):
        store(tmp_path / "a.csv", trial=partial(dies_at, bad), workers=2)
    # All trials but the one that kills its worker are stored.
    rows = (tmp_path / "a.csv.part").read_text().splitlines()[-29:]
    assert sorted(int(row.split(",")[0]) for row in rows) == [
        k for k in range(30) if k != bad
    ]
    assert not (tmp_path / "a.csv").exists()


def test_a_broken_executor_leaves_what_was_done() -> None:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        # An executor of the caller cannot be replaced, so the study stops.
        with pytest.raises(StudyError, match="the executor broke") as caught:
            studies.run(partial(dies_at, 29), SEEDS, executor=pool)
        assert caught.value.study is not None
        assert 0 < caught.value.study.done.sum() < 30


class Cluster(Executor):
    """An executor that runs its calls as soon as all of its slots are taken."""

    def __init__(self, slots: int, on_full: Callable[[list[Any]], None]) -> None:
        self._max_workers = slots
        self.on_full = on_full
        self.calls: list[Any] = []

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.calls.append((future, fn, args))
        # Nothing runs before all slots are taken: fewer calls would wait for ever.
        if len(self.calls) == self._max_workers:
            self.on_full(self.calls)
            for pending, call, arguments in self.calls:
                pending.set_result(call(*arguments))
            self.calls = []
        return future


def test_as_many_trials_are_in_flight_as_the_executor_has_slots(tmp_path: Path) -> None:
    part = tmp_path / "a.csv.part"
    in_flight = []

    def record(calls: list[Any]) -> None:
        rows = part.read_text().count("\n") - n_head if part.exists() else 0
        in_flight.append((len(calls), rows))

    # Lines of versions, code and parameters.
    n_head = 3 + 2 + 1
    studies.store(
        tmp_path / "a.csv",
        draw,
        studies.spawn(7, 48),
        columns=COLUMNS,
        parameters={"size": 40},
        code=[bits],
        executor=Cluster(24, record),
    )
    # The first 24 rows are on disk before the next trials start.
    assert in_flight == [(24, 0), (24, 24)]


# Files.


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return store(tmp_path_factory.mktemp("whole") / "a.csv")


def test_a_file_gives_back_every_bit(whole: Path) -> None:
    study = studies.load(whole)
    assert np.stack([study.columns[c] for c in COLUMNS], axis=1).tobytes() == REFERENCE
    assert study.parameters == {"size": 40}
    assert len(study) == 30
    assert study.metadata["code"] == {"draw": studies.fingerprint(draw)}


@settings(max_examples=25)
@given(
    st.lists(st.floats(), min_size=1, max_size=4),
    st.integers(0, 2**128),
    st.lists(st.integers(0, 2**31), max_size=3),
)
def test_any_number_and_seed_comes_back(
    tmp_path_factory: pytest.TempPathFactory,
    # Infinite, NaN and subnormal numbers, and seeds of any size, must survive as text.
    numbers: list[float],
    entropy: int,
    key: list[int],
) -> None:
    seed = SeedSequence(entropy, spawn_key=key)
    path = tmp_path_factory.mktemp("any") / "a.csv"
    columns = [f"c{k}" for k in range(len(numbers))]
    study = studies.load(
        store(path, trial=lambda s: numbers, seeds=[seed], columns=columns)
    )
    for name, number in zip(columns, numbers, strict=True):
        assert np.array_equal(study.metric(name), [number], equal_nan=True)
        assert (
            # array_equal takes -0.0 for 0.0; NaN has no sign that counts.
            np.signbit(study.metric(name)[0]) == np.signbit(number) or number != number
        )
    assert (study.seed(0).generate_state(4) == seed.generate_state(4)).all()


def test_a_failure_is_stored_by_its_class(tmp_path: Path) -> None:
    study = studies.load(store(tmp_path / "a.csv", trial=partial(fails_at, (3,))))
    assert study.failures[3] == "ArithmeticError"
    assert np.isnan(study.columns["mean"][3])
    assert study.metric("mean").shape == (29,)
    # A failure of the same kind is the stored result.
    studies.check(study, partial(fails_at, (3,)))
    with pytest.raises(
        AssertionError, match="trial 3: stored ArithmeticError, now a value"
    ):
        studies.check(study, draw)


def test_every_flipped_bit_is_refused_by_name(whole: Path, tmp_path: Path) -> None:
    # The checksum in the head covers all bytes after it.
    raw = whole.read_bytes()
    path = tmp_path / "b.csv"
    rng = np.random.default_rng(1)
    damaged = [b"", raw[:-20], raw + b"\n", raw.split(b"\n")[0]]
    # One flipped bit anywhere: in the head, the seal, the rows or the last byte
    for place in [0, 30, len(raw) - 1, *rng.integers(len(raw), size=200)]:
        flipped = bytearray(raw)
        flipped[place] ^= 1 << rng.integers(8)
        damaged.append(bytes(flipped))
    for text in damaged:
        path.write_bytes(text)
        with pytest.raises(ValueError, match="b.csv is damaged"):
            studies.load(path)


def test_the_book_s_own_studies_are_whole() -> None:
    for path in (data_root() / "studies").glob("*/*.csv"):
        assert len(studies.stored(path.parent.name, path.stem)) > 0
    for paper, name in [("grange", "../das/pendulum"), ("..", "a"), ("grange", "none")]:
        with pytest.raises(ValueError, match="^(paper|name) must be one of"):
            studies.stored(paper, name)
    with pytest.raises(ValueError, match="^name must be one of"):
        studies.script("../studies/table-2")


def test_a_row_that_was_cut_off_or_damaged_runs_again(
    whole: Path, tmp_path: Path
) -> None:
    path = tmp_path / "a.csv"
    part = tmp_path / "a.csv.part"
    assert store(path, indices=range(20)) == part
    text = part.read_text()
    # A row cut in the middle, a changed digit, a cut head, an empty file
    position = text.index("\n4,")
    for damaged in (
        text[:-9],
        text[: position + 6] + "9" + text[position + 7 :],
        text[:40],
        "",
    ):
        part.write_text(damaged)
        assert store(path).read_bytes() == whole.read_bytes()


def test_parts_of_several_machines_merge(whole: Path, tmp_path: Path) -> None:
    for k in range(3):
        store(tmp_path / f"{k}.csv", indices=range(8 * k, 8 * k + 10))
    studies.merge(tmp_path / "a.csv", *(tmp_path / f"{k}.csv.part" for k in range(3)))
    # Parts overlap in two trials, which are stored once.
    assert (tmp_path / "a.csv.part").read_text().count("\n7,") == 1
    assert store(tmp_path / "a.csv").read_bytes() == whole.read_bytes()
    # Parts of two different studies must not mix.
    store(tmp_path / "b.csv", indices=[0], parameters={"size": 41})
    with pytest.raises(ValueError, match="must have the same code, parameters and"):
        studies.merge(
            tmp_path / "c.csv", tmp_path / "0.csv.part", tmp_path / "b.csv.part"
        )
    (tmp_path / "b.csv.part").write_text("# version")
    with pytest.raises(ValueError, match="b.csv.part is damaged"):
        studies.merge(tmp_path / "c.csv", tmp_path / "b.csv.part")


@pytest.mark.parametrize(
    "other",
    [
        {"parameters": {}},
        {"trial": partial(fails_at, ())},
        {"seeds": studies.spawn(8, 30)},
    ],
)
def test_a_part_of_another_study_is_refused(
    tmp_path: Path, other: dict[str, Any]
) -> None:
    store(tmp_path / "a.csv", indices=[2])
    with pytest.raises(ValueError, match="a.csv.part"):
        store(tmp_path / "a.csv", **other)


def test_a_full_disk_is_named_and_loses_nothing(whole: Path, tmp_path: Path) -> None:
    most = len(whole.read_bytes()) * 6 // 10
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    # A limit on the size of files has the same effect as a full disk.
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, limits[1]))
    try:
        with pytest.raises(OSError, match=r"File too large: .*a\.csv\.part"):
            store(tmp_path / "a.csv")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (tmp_path / "a.csv.part").stat().st_size == most
    # With space again the run continues, and the file is the same.
    assert store(tmp_path / "a.csv").read_bytes() == whole.read_bytes()


@pytest.mark.parametrize(
    ("change", "options", "passes"),
    [
        (1e-9, {}, False),
        (1e-9, {"rtol": 1e-6}, True),
        (1e-3, {"rtol": 1e-6, "max_outliers": 2}, False),
        (1e-3, {"atol": 1.0}, True),
        (1e-3, {"ill_conditioned": ["mean", "norm"]}, True),
    ],
)
def test_another_run_is_compared(
    whole: Path, change: float, options: dict[str, Any], passes: bool
) -> None:
    def trial(seed: SeedSequence) -> list[float]:
        return [x * (1 + change) for x in draw(seed)]

    # A relative change passes if one of the tolerances covers it.
    chosen = [0, 4, 29]
    if passes:
        assert len(studies.check(whole, trial, indices=chosen, **options)) == 30
    else:
        with pytest.raises(AssertionError, match=r"a\.csv: another run(?s:.*)stored"):
            studies.check(whole, trial, indices=chosen, **options)


def test_a_few_trials_may_go_another_way(whole: Path) -> None:
    other = partial(fails_at, (4,))
    studies.check(whole, other, indices=[0, 4, 29], max_outliers=1)
    with pytest.raises(
        AssertionError, match="trial 4: stored a value, now ArithmeticError"
    ):
        studies.check(whole, other, indices=[0, 4, 29])


def test_a_difference_names_another_code(whole: Path) -> None:
    def other(seed: SeedSequence) -> list[float]:
        return [2 * x for x in draw(seed)]

    # The stored fingerprint is found by the function's name.
    other.__qualname__ = draw.__qualname__
    with pytest.raises(AssertionError, match="the source of the trial differs"):
        studies.check(whole, other, indices=[0])
