"""Every parameter of a scenario is read by a study or chapter, or is one of its notes."""

from __future__ import annotations

import functools
import re
import shutil
from pathlib import Path

import pytest

import scenarios as tool
from bookkit.folders import data_root
from bookkit.published import scenario
from common import BOOK, ROOT, chapters
from execute import read

NAMES = sorted(
    (p.parent.name, p.stem) for p in (data_root() / "scenarios").glob("*/*.toml")
)


def code_of(path: Path) -> str:
    """Return the Python of a script or of a chapter's cells."""
    if path.suffix == ".py":
        return path.read_text(encoding="utf-8")
    return "\n".join(
        cell.source for cell in read(path).cells if cell.cell_type == "code"
    )


@functools.cache
def sources() -> dict[str, str]:
    """Return the code of each chapter and script by its name."""
    paths = [*chapters(), *sorted((BOOK / "studies").glob("*.py"))]
    return {path.stem: code_of(path) for path in paths}


def words_of(code: str) -> set[str]:
    """Return the strings and attributes in code."""
    return set(re.findall(r"[\"'.]([\w-]+)", code))


def with_imports(name: str) -> set[str]:
    """Return a source and the scripts that it imports, directly or through others."""
    names = {name}
    # Studies share scripts, so a parameter may be read in one of these.
    for imported in re.findall(r"^(?:from|import) (\w+)", sources()[name], re.M):
        if imported in sources():
            names |= with_imports(imported)
    return names


def mentioned_with(paper: str, name: str) -> set[str]:
    """Return the words of all sources that name a scenario, or import a script that does."""
    words = {source: words_of(code) for source, code in sources().items()}
    mentioned: set[str] = set()
    for source in sources():
        reachable = [words[script] for script in with_imports(source)]
        # The source names paper and scenario, itself or by an import.
        if any({paper, name} <= script_words for script_words in reachable):
            mentioned |= words[source]
    return mentioned


def readable_names(paper: str, name: str) -> set[str]:
    """Return the names of the parameters and the columns of the tables."""
    study = scenario(paper, name)
    columns = {
        c for rows in study.tables.values() for row in rows for c in row.value_columns
    }
    return set(study) | columns - {"name", "unit"}


@pytest.mark.parametrize(("paper", "name"), NAMES)
def test_every_parameter_is_read(paper: str, name: str) -> None:
    mentioned = mentioned_with(paper, name)
    # A study may read the links as a matrix.
    if "adjacency" in mentioned:
        mentioned.add("neighbours")
    unread = sorted(readable_names(paper, name) - mentioned)
    # A parameter that nothing reads would suggest an influence that it does not have.
    assert not unread, f"{paper}/{name}: move to the notes: {', '.join(unread)}"


def test_a_change_has_to_be_accepted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(ROOT / "data" / "scenarios", tmp_path / "data" / "scenarios")
    assert tool.main([], tmp_path) == 0
    path = tmp_path / "data" / "scenarios" / "grange" / "table-2.toml"
    text = path.read_text(encoding="utf-8")
    # Another value is a difference until it is accepted.
    path.write_text(text.replace("value = 200\n", "value = 50\n"), encoding="utf-8")
    assert tool.main([], tmp_path) == 1
    assert "make update-scenarios" in capsys.readouterr().err
    assert tool.main(["--update"], tmp_path) == 0 == tool.main([], tmp_path)
