"""Scripts of long studies are checked before their first trial, not after the last."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

import studies as tool
from bookkit import studies
from bookkit.published import scenario

SCRIPT = """
import numpy as np
from bookkit import studies

NAME, PAPER = "spread", "zheng"
parameters = {"members": 20}
columns = ["mean", "spread"]
seeds = studies.spawn(2023, 12)

def trial(seed):
    x = np.random.default_rng(seed).normal(size=parameters["members"])
    return x.mean(), x.std()
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "book" / "studies"
    folder.mkdir(parents=True)
    return folder


def test_make_studies_stores_and_checks(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Without a script there is nothing to run, which is no error.
    assert tool.main([], tmp_path) == 0
    assert "no script" in capsys.readouterr().out
    script = folder / "spread.py"
    script.write_text(SCRIPT, encoding="utf-8")
    assert tool.main(["--check"], tmp_path) == 1
    assert "not stored yet" in capsys.readouterr().err
    assert tool.main(["--workers", "1"], tmp_path) == 0
    path = tmp_path / "data" / "studies" / "zheng" / "spread.csv"
    stored = studies.load(path)
    assert len(stored) == 12
    assert stored.parameters == {"members": 20}
    assert "trial" in stored.metadata["code"]
    assert tool.main(["spread", "--check", "--workers", "1"], tmp_path) == 0
    assert tool.main(["sprawl"], tmp_path) == 1
    capsys.readouterr()
    # Other numbers, other parameters, and a study that lost its script
    for old, new, word in [
        ("size=para", "loc=1e-12, size=para", "another run"),
        ('"members": 20', '"rule": "mean", "members": 20', "other parameters"),
        ('"spread", "z', '"spreads", "z', "no script in book/studies makes it"),
    ]:
        script.write_text(SCRIPT.replace(old, new), encoding="utf-8")
        os.utime(script, (0, hash(word) % 2**30))  # a new time: python caches by it
        assert tool.main(["--check", "--workers", "1"], tmp_path) == 1
        assert word in capsys.readouterr().err


def test_a_script_s_name_and_columns_are_checked_before_it_runs(folder: Path) -> None:
    for old, new, word in [
        ('"zheng"', '"chang"', "PAPER"),
        ('"spread", "zheng"', '"a/b", "zheng"', "NAME"),
        ('["mean", "spread"]', '["a", "a"]', "columns"),
    ]:
        (folder / "a.py").write_text(SCRIPT.replace(old, new, 1), encoding="utf-8")
        os.utime(folder / "a.py", (0, hash(word) % 2**30))
        # The fault is found while the script loads, before a trial runs.
        with pytest.raises(ValueError, match=word):
            tool.main([], folder.parents[1])


SHARED = """
def shared(seed):
    return [float(seed.spawn_key[0]), 1.0]
"""
USES = """
import _common
from bookkit.published import scenario
from bookkit.studies import spawn
NAME, PAPER, columns, parameters = "table-2", "grange", ["a", "b"], {"gain": 1}
seeds, scenarios = spawn(1, 4), [scenario("grange", "table-2")]
def trial(seed):
    return _common.shared(seed)
"""


def test_scripts_share_a_module_and_store_what_their_scenario_was(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (folder / "_common.py").write_text(SHARED, encoding="utf-8")
    (folder / "two.py").write_text(USES, encoding="utf-8")
    # Loading a script adds its folder to the path; this undoes it.
    monkeypatch.setattr(sys, "path", [*sys.path])
    assert tool.main(["--workers", "1"], tmp_path) == 0
    order = list(sys.modules)  # a ufunc is sent by the name of the first that has it
    assert order.index("_common") < order.index("stored_study_two")
    stored = studies.load(tmp_path / "data" / "studies" / "grange" / "table-2.csv")
    assert stored.metric("a").tolist() == [0.0, 1.0, 2.0, 3.0]
    # The digest shows later whether the scenario was the same.
    digest = scenario("grange", "table-2").digest
    assert stored.parameters == {"gain": 1, "scenario_table_2": digest}
    assert tool.main(["--check", "--workers", "1"], tmp_path) == 0
    # The same script with a changed scenario must neither run nor compare.
    text = USES.replace('"table-2")]', '"table-2").replace(gain=0.2)]')
    (folder / "two.py").write_text(text, encoding="utf-8")
    os.utime(folder / "two.py", (5, 5))
    capsys.readouterr()
    for arguments in ([], ["--check"]):
        assert tool.main(arguments, tmp_path) == 1
        assert "changed scenario: gain: 0.2, not 0.05" in capsys.readouterr().err
    sys.modules.pop("_common", None)


@pytest.mark.slow
def test_every_stored_study_runs_again() -> None:
    assert tool.main(["--check"]) == 0
