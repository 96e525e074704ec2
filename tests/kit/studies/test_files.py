"""Stored studies: every bit comes back, and a file that is not whole is refused."""

from __future__ import annotations

import hashlib
import os
import threading
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import SeedSequence

from bookkit import studies
from bookkit.studies import Study
from bookkit.studies.files import _write

from .trials import (
    Scores,
    example,
    fails_at,
    number,
    partial_study,
    scores,
    small_study,
    with_failure,
)


def _stored(folder: Path, text: str) -> Path:
    path = folder / "a.csv"
    path.write_text(text, encoding="utf-8", newline="")
    return path


def _store(study: Any = None, path: Any = "unused.csv", **options: Any) -> Path:
    chosen = {"parameters": {}, "columns": ["rmse", "nees"], **options}
    return studies.store(small_study() if study is None else study, path, **chosen)


def _big() -> Study:
    return studies.run(lambda seed: 2**53 + 1, [1], workers=1)


_KEPT = [Path(__file__)]  # any file that is no stored study
_P = "bookkit.studies."
_REFUSED = {
    _P + "store": [
        ("study", lambda: _store([1.0])),
        ("study", lambda: _store(partial_study())),
        ("study", lambda: _store(with_failure("died"))),
        ("study", lambda: _store(with_failure("timeout"))),
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
    _P + "stored": [
        ("name", lambda: studies.stored("grange", "table-9")),
        ("name", lambda: studies.stored("nobody", "table-3")),
        ("name", lambda: studies.stored("grange", "../grange/bound")),
        ("name", lambda: studies.stored(None, 3)),
    ],
    _P + "Stored": [
        ("column", lambda: example().metric("crps")),
        ("index", lambda: example().seed(2)),
    ],
    _P + "check": [
        ("path", lambda: studies.check("no-such-file.csv", scores)),
    ],
}


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


def test_infinity_is_like_infinity_only(tmp_path: Path) -> None:
    def infinite(seed: SeedSequence) -> Scores:
        return scores(seed)._replace(rmse=np.inf)

    def finite(seed: SeedSequence) -> Scores:
        return scores(seed)

    study = studies.run(infinite, studies.spawn(5, 3), workers=1)
    path = _store(study, tmp_path / "a.csv")
    studies.check(path, infinite, rtol=0.1)
    with pytest.raises(AssertionError, match="rmse stored inf"):
        studies.check(path, finite, rtol=0.1)
    study = studies.run(finite, studies.spawn(5, 3), workers=1)
    with pytest.raises(AssertionError, match="now inf"):
        studies.check(_store(study, tmp_path / "b.csv"), infinite, rtol=0.1)


def test_a_rough_metric_stays_within_the_trials_and_others_are_held(tmp_path: Path) -> None:
    path = _store(path=tmp_path / "a.csv")
    values = studies.load(path).columns["rmse"]
    wide = float(np.ptp(values))

    def moved(by: float, seed: SeedSequence) -> Scores:
        found = scores(seed)
        return found._replace(rmse=found.rmse + by)

    near, far = partial(moved, 0.99 * wide), partial(moved, 1.01 * wide)
    studies.check(path, near, rough=["rmse"])
    studies.check(path, near, atol=wide)
    for trial, options in ((far, {"rough": ["rmse"]}), (near, {"rough": ["nees"]}), (near, {})):
        with pytest.raises(AssertionError, match="rmse stored"):
            studies.check(path, trial, **options)


def test_a_few_odd_trials_pass_and_one_more_does_not(tmp_path: Path) -> None:
    path = _store(path=tmp_path / "a.csv")
    last = [studies.load(path).seed(i).spawn_key for i in (4, 5)]

    def trial(seed: SeedSequence) -> Scores:
        found = scores(seed)
        return found._replace(rmse=np.nan, nees=0.5) if seed.spawn_key in last else found

    studies.check(path, trial, odd=2)
    with pytest.raises(AssertionError, match=r"trial 4: rmse(.|\n)*trial 5: nees stored"):
        studies.check(path, trial, odd=1)
    studies.check(path, trial, indices=[3, 4], odd=1)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"indices": []}, "indices"),
        ({"indices": [6]}, "indices"),
        ({"indices": [1, 1]}, "indices"),
        ({"indices": 3}, "indices"),
        ({"rtol": -1.0}, "rtol"),
        ({"atol": -1.0}, "atol"),
        ({"rough": ["speed"]}, "rough"),
        ({"rough": "rmse"}, "rough"),
        ({"odd": -1}, "odd"),
        ({"odd": 2, "indices": [0, 1]}, "odd"),
        ({"workers": 0}, "workers"),
    ],
)
def test_check_refuses(options: dict[str, Any], name: str, tmp_path: Path) -> None:
    path = _store(path=tmp_path / "a.csv")
    with pytest.raises(ValueError, match=name):
        studies.check(path, scores, **options)


GOOD = (
    '# distfilt study, format 2\n# trials 3\n# version numpy: "2.0.0"\n# parameter gain: 0.5\n'
    "index,entropy,spawn_key,failure,rmse\n0,1,0,,0.5\n1,1,1,ValueError,\n2,1,2 7,,nan\n"
)


@pytest.mark.parametrize(
    ("old", "new", "line", "word"),
    [
        ("format 2", "format 1", 1, "format 2"),
        (": 0.5", " 0.5", 4, "JSON"),
        (": 0.5", ": 0,5", 4, "Extra data"),
        ("# trials 3\n", "", 2, "trials"),
        ("trials 3", "trials three", 2, "trials"),
        ("trials 3", "trials 0", 2, "trials"),
        ("trials 3", "trials 4", 9, "needs 4 trials"),
        ("2,1,2 7,,nan\n", "", 8, "needs 3 trials"),
        ("# parameter gain", "# remark gain", 4, "parameter"),
        ("# version numpy: \"2.0.0\"", "# parameter gain: 1", 4, "already"),
        ("index,", "trial,", 5, "index"),
        (",rmse", "", 5, "columns"),
        (",rmse", ",rmse,rmse", 5, "columns"),
        ("0,1,0,,0.5", "0,1,0,,0.5,0.6", 6, "cells"),
        ("0,1,0,,0.5", "1,1,0,,0.5", 6, "index"),
        ("0,1,0,,0.5", "0,x,0,,0.5", 6, "entropy"),
        ("0,1,0,,0.5", "0,,0,,0.5", 6, "entropy"),
        ("0,1,0,,0.5", "0,1,-1,,0.5", 6, "spawn_key"),
        ("0,1,0,,0.5", "0,1,0,,", 6, "rmse"),
        ("0,1,0,,0.5", "0,1,0,,half", 6, "rmse"),
        ("0,1,0,,0.5", "0,1,0,,0.50", 6, "rmse"),
        ("ValueError,", "ValueError,0.1", 7, "failed"),
        ("ValueError,", "a value,", 7, "failure"),
        ("2,1,2 7", "2,1,1", 8, "different seeds"),
        ("\n2,1", "\n\n2,1", 9, "empty line"),
        ("nan\n", "nan", 8, "end of line"),
        ("0,1,0,,0.5\n1,1,1,ValueError,\n2,1,2 7,,nan\n", "", 6, "at least one trial"),
        ("nan", "n\u00e9", 8, "rmse"),
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
    with pytest.raises(ValueError, match="line 8"):
        studies.load(path)


# Found from any folder.


def test_a_stored_study_is_found_by_paper_and_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("published/items.csv", "scenarios/accepted.csv"):
        (tmp_path / "data" / name).parent.mkdir(parents=True)
        (tmp_path / "data" / name).touch()
    _store(path=tmp_path / "data" / "studies" / "zheng" / "figure-1.csv")
    (tmp_path / "book" / "deep").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "book" / "deep")
    found = studies.stored("zheng", "figure-1")
    assert len(found) == 6 and found.path.is_relative_to(tmp_path)
    assert studies.check(found, scores, indices=[2]) is found
    with pytest.raises(ValueError, match="needs one of zheng/figure-1, got zheng/figure-2"):
        studies.stored("zheng", "figure-2")


# Written whole or not at all.


def test_two_writers_leave_one_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    texts = [letter * 200_000 for letter in "abcd"]
    writers = [threading.Thread(target=_write, args=(path, text)) for text in texts for _ in "123"]
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    assert path.read_text() in texts and list(tmp_path.iterdir()) == [path]


def test_a_writer_that_fails_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _write(tmp_path / "a.csv", "old")
    mode = path.stat().st_mode

    def full(*_: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space"):
        _write(path, "new")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    monkeypatch.undo()
    _write(path, "new")
    assert path.read_text() == "new" and path.stat().st_mode == mode


def test_a_file_cut_anywhere_is_refused(tmp_path: Path) -> None:
    whole = _store(path=tmp_path / "a.csv").read_bytes()
    digest = hashlib.sha256(whole).hexdigest()
    for end in range(len(whole)):
        path = tmp_path / "cut.csv"
        path.write_bytes(whole[:end])
        with pytest.raises(ValueError, match="^path: "):
            studies.load(path)
    assert hashlib.sha256((tmp_path / "a.csv").read_bytes()).hexdigest() == digest
