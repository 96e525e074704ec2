"""Which data are read: the working copy's, a named folder's, or those of the library."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from distfilt import folders
from distfilt.folders import data_root
from distfilt.published import scenario

HERE = data_root()
BAD_INPUT: dict[str, list] = {}
EXEMPT = {"distfilt.folders.data_root": "takes no input; a bad DISTFILT_DATA is tested here"}


def folder(path: Path) -> Path:
    """A folder of data that counts."""
    for name in ("published/items.csv", "scenarios/accepted.csv"):
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).touch()
    return path


@pytest.fixture(autouse=True)
def _nothing_named(monkeypatch):
    monkeypatch.delenv("DISTFILT_DATA", raising=False)


def test_the_nearest_working_copy_comes_first(monkeypatch, tmp_path):
    outer, inner = folder(tmp_path / "data"), folder(tmp_path / "lab" / "data")
    (tmp_path / "lab" / "book" / "studies").mkdir(parents=True)
    for here, wanted in (
        (tmp_path, outer),
        (tmp_path / "lab", inner),
        (tmp_path / "lab" / "book" / "studies", inner),
        (inner, inner),
    ):
        monkeypatch.chdir(here)
        assert data_root() == wanted


@pytest.mark.parametrize("lacking", ["published/items.csv", "scenarios/accepted.csv"])
def test_the_data_of_another_project_are_passed_over(monkeypatch, tmp_path, lacking):
    (folder(tmp_path / "data") / lacking).unlink()
    monkeypatch.chdir(tmp_path)
    assert data_root() == HERE


def test_the_named_folder_is_the_only_one(monkeypatch, tmp_path):
    named = folder(tmp_path / "named")
    folder(tmp_path / "data")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DISTFILT_DATA", str(named))
    assert data_root() == named
    monkeypatch.setenv("DISTFILT_DATA", "named")
    assert data_root() == named and data_root().is_absolute()
    monkeypatch.setenv("DISTFILT_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(FileNotFoundError, match="^DISTFILT_DATA: needs a folder with .*nowhere"):
        data_root()
    monkeypatch.setenv("DISTFILT_DATA", "")
    assert data_root() == tmp_path / "data"


def test_away_from_a_copy_the_library_s_own_are_read(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(folders, "_PACKAGE", tmp_path / "installed" / "distfilt")
    with pytest.raises(FileNotFoundError, match="without its folders"):
        data_root()
    carried = folder(tmp_path / "installed" / "distfilt" / "_data")
    assert data_root() == carried
    assert data_root() != folder(tmp_path / "installed" / "data") == data_root()


def test_an_edit_of_the_working_copy_is_read_by_a_library_from_elsewhere(monkeypatch, tmp_path):
    shutil.copytree(HERE / "published", tmp_path / "data" / "published")
    shutil.copytree(HERE / "scenarios", tmp_path / "data" / "scenarios")
    path = tmp_path / "data" / "scenarios" / "grange" / "table-2.toml"
    text = path.read_text(encoding="utf-8")
    assert text.count("value = 200\n") == 1
    path.write_text(text.replace("value = 200\n", "value = 50\n"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert scenario("grange", "table-2").changes == ("members: 50, not 200",)


def test_a_deleted_folder_does_no_harm(tmp_path):
    code = (
        "import os, sys; from distfilt.folders import data_root; os.mkdir('gone'); "
        "os.chdir('gone'); os.rmdir('../gone'); print(data_root().name)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env={"PYTHONPATH": str(HERE.parent)},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.stdout.strip() == "data", done.stderr
