"""The environment is complete or made again: interrupted, moved, copied, an old Python."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import environment
from common import ROOT, chapters, chosen


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """Return a folder with the files that make needs; its name has a space."""
    folder = tmp_path / "a clone"
    for place in ("book/tools", "book/kit"):
        (folder / place).mkdir(parents=True)
    for name in (
        "Makefile",
        "requirements.txt",
        "pyproject.toml",
        "book/tools/environment.py",
        "book/kit/pyproject.toml",
    ):
        shutil.copy(ROOT / name, folder / name)
    return folder


def make(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    # The outer make passes its own options in these variables.
    env = {k: v for k, v in os.environ.items() if not k.startswith("MAKE")}
    return subprocess.run(
        ["make", *arguments], cwd=folder, env=env, capture_output=True, text=True
    )


def pretend(folder: Path, stamp: str | None) -> None:
    """Make an environment with a working Python and that stamp."""
    (folder / ".venv" / "bin").mkdir(parents=True)
    (folder / ".venv" / "bin" / "python").symlink_to(sys.executable)
    if stamp is not None:
        (folder / ".venv" / "stamp").write_text(stamp + "\n")


def makes_environment(folder: Path) -> bool:
    result = make(folder, "-n", "environment")
    assert result.returncode == 0, result.stderr
    # With -n make prints the command if it would run it.
    return "environment.py" in result.stdout


def test_only_a_whole_environment_is_kept(clone: Path) -> None:
    """No environment, an incomplete and a complete one, a newer lock, a missing Python."""
    assert makes_environment(clone)
    # Without a stamp the last make was interrupted.
    pretend(clone, None)
    assert makes_environment(clone)
    stamp = clone / ".venv" / "stamp"
    python = clone / ".venv" / "bin" / "python"
    # A stamp that names this folder, written last
    stamp.write_text(f"{clone}\n")
    assert not makes_environment(clone)
    # A stamp older than the lock: the packages have to be installed again.
    os.utime(stamp, (1, 1))
    assert makes_environment(clone)
    os.utime(stamp)
    assert not makes_environment(clone)
    python.unlink()
    # The system's Python was removed, for example by an update.
    python.symlink_to("/nowhere/python")
    assert makes_environment(clone)


def test_a_moved_or_copied_folder_makes_its_own(clone: Path, tmp_path: Path) -> None:
    pretend(clone, str(clone))
    # The stamp names the old folder, to which the editable install points.
    copied = tmp_path / "copied"
    shutil.copytree(clone, copied, symlinks=True)
    assert makes_environment(copied)
    assert not makes_environment(clone)
    assert makes_environment(clone.rename(tmp_path / "moved"))


def test_an_old_python_or_none_is_named_and_leaves_nothing(
    clone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A refusal must leave no half environment behind.
    before = sorted(clone.rglob("*"))
    result = make(clone, "environment", "PYTHON=")
    assert result.returncode != 0
    assert "Python 3.11 or newer was not found" in result.stdout
    monkeypatch.setattr(sys, "version_info", (3, 10, 4))
    monkeypatch.setattr(sys, "argv", ["environment.py", str(clone / ".venv")])
    with pytest.raises(SystemExit, match="Python 3.11 or newer is needed, got 3.10.4"):
        environment.main()
    assert sorted(clone.rglob("*")) == before


@pytest.fixture
def steps(clone: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the commands of the tool in order; the name in the first entry makes one fail."""
    commands: list[str] = []

    def succeeds(python: str, *arguments: str) -> bool:
        # "-m venv ..." or "-m pip ...": the module
        name = arguments[1]
        if name == "venv":
            pretend(clone, None)
        commands.append(name)
        return commands[0] != f"no {name}"

    monkeypatch.chdir(clone)
    # No package is installed in a test.
    monkeypatch.setattr(environment, "succeeds", succeeds)
    monkeypatch.setattr(sys, "argv", ["environment.py", ".venv"])
    return commands


def test_the_stamp_comes_last_and_names_the_folder(
    clone: Path, steps: list[str]
) -> None:
    environment.main()
    # pip installs uv, and uv the list of packages, the library and the kit.
    assert steps[:5] == ["venv", "pip", "uv", "uv", "uv"]
    assert (clone / ".venv" / "stamp").read_text() == f"{clone}\n"
    assert not makes_environment(clone)
    steps.clear()
    # A complete environment is updated in place: files in it stay.
    (clone / ".venv" / "kept").touch()
    environment.main()
    assert "venv" not in steps
    assert (clone / ".venv" / "kept").exists()


def test_pip_installs_everything_where_uv_cannot(clone: Path, steps: list[str]) -> None:
    steps.append("no uv")
    environment.main()
    assert steps[1:7] == ["venv", "pip", "uv", "pip", "pip", "pip"]
    assert (clone / ".venv" / "stamp").exists()


def test_uv_is_taken_from_the_lock_with_its_hashes(
    clone: Path, steps: list[str]
) -> None:
    environment.main()
    text = (clone / ".venv" / "uv.txt").read_text()
    pin, *hashes = text.replace("\\", "").split()
    assert pin.startswith("uv==")
    assert len(hashes) > 5
    assert all(entry.startswith("--hash=sha256:") for entry in hashes)


def test_an_interrupted_update_leaves_no_stamp(clone: Path, steps: list[str]) -> None:
    environment.main()
    # The update breaks at its first command, after the stamp was removed.
    steps[:] = ["no pip"]
    with pytest.raises(SystemExit):
        environment.main()
    assert not (clone / ".venv" / "stamp").exists()
    assert makes_environment(clone)
    steps.clear()
    (clone / ".venv" / "half").touch()
    environment.main()
    # Without a stamp everything is made again, and the half environment is gone.
    assert steps[0] == "venv"
    assert not (clone / ".venv" / "half").exists()


def test_line_ends_are_fixed_whatever_a_clone_s_settings_are() -> None:
    names = ["a.csv", "a.ipynb", "a.md", "a.py"]
    # git would change line ends by the user's settings, and with them the compared
    # bytes.
    attributes = subprocess.run(
        ["git", "check-attr", "eol", *names],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    assert attributes.split("\n")[:-1] == [f"{name}: eol: lf" for name in names]


def test_every_page_with_code_is_compared() -> None:
    # `make test` names the chapters in parts; together they must be all.
    compared = re.findall(r"regress\.py (\S+)", make(ROOT, "-n", "test").stdout)
    assert sorted(chosen(compared)) == sorted(chapters())


def test_the_list_of_packages_is_whole() -> None:
    """The lock is installed without resolving dependencies, so it must have all of them."""
    result = subprocess.run(
        [sys.executable, "-m", "pip", "check"], capture_output=True, text=True
    )
    # Left out on purpose: `exclude-dependencies` in pyproject.toml
    left_out = (
        r"axe-playwright-python \S+ requires playwright, which is not installed\.\n"
    )
    missing = re.sub(left_out, "", result.stdout)
    assert missing in ("", "No broken requirements found.\n")
