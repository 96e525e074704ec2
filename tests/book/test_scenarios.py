"""Every parameter of a scenario is read by a study or a chapter, or stands in its notes."""

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
    """The Python of a script or of a chapter's cells."""
    if path.suffix == ".py":
        return path.read_text(encoding="utf-8")
    return "\n".join(
        cell.source for cell in read(path).cells if cell.cell_type == "code"
    )


@functools.cache
def sources() -> list[set[str]]:
    """What each chapter and script has as a text, or takes by a dot."""
    paths = [*chapters(), *sorted((BOOK / "studies").glob("*.py"))]
    return [set(re.findall(r"[\"'.]([\w-]+)", code_of(path))) for path in paths]


def wanted(paper: str, name: str) -> set[str]:
    """The parameters, and the columns of the rows; a network is also taken as `adjacency`."""
    s = scenario(paper, name)
    columns = {
        c for rows in s.tables.values() for row in rows for c in row.value_columns
    }
    return set(s) | columns - {"name", "unit"}


@pytest.mark.parametrize(("paper", "name"), NAMES)
def test_every_parameter_is_read(paper: str, name: str) -> None:
    found = set().union(*(words for words in sources() if {paper, name} <= words))
    found |= {"neighbours"} if "adjacency" in found else set()
    unread = sorted(wanted(paper, name) - found)
    assert not unread, f"{paper}/{name}: read by nothing, so notes: {', '.join(unread)}"


def test_a_change_has_to_be_accepted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(ROOT / "data" / "scenarios", tmp_path / "data" / "scenarios")
    assert tool.main([], tmp_path) == 0
    path = tmp_path / "data" / "scenarios" / "grange" / "table-2.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("value = 200\n", "value = 50\n"), encoding="utf-8")
    assert tool.main([], tmp_path) == 1
    assert "make accept" in capsys.readouterr().err
    assert tool.main(["--accept"], tmp_path) == 0 == tool.main([], tmp_path)
