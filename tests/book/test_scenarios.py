"""Every parameter of a scenario is read by a study or a chapter, or stands in its notes."""

from __future__ import annotations

import ast
import shutil
from pathlib import Path
from types import ModuleType

import jupytext
import pytest

from bookkit.folders import data_root
from bookkit.published import items, scenario
from common import BOOK, ROOT, chapters

NAMES = sorted((p.parent.name, p.stem) for p in (data_root() / "scenarios").glob("*/*.toml"))


def code_of(path: Path) -> str:
    """The Python of a script or of a chapter's cells."""
    if path.suffix == ".py":
        return path.read_text(encoding="utf-8")
    cells = jupytext.read(path).cells
    return "\n".join(cell.source for cell in cells if cell.cell_type == "code")


def texts(tree: ast.AST) -> set[str]:
    return {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and n.value is not None
            and isinstance(n.value, str)}  # fmt: skip


def listed(node: ast.AST) -> set[str]:
    """The words of a tuple or list of words."""
    parts = node.elts if isinstance(node, ast.Tuple | ast.List) else []
    return {str(p.value) for p in parts if isinstance(p, ast.Constant)}


def looped(tree: ast.AST) -> set[str]:
    """What a loop takes by the words of a list: ``{n: row[n] for n in names}``."""
    named: dict[str, set[str]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            named.setdefault(node.targets[0].id, set()).update(listed(node.value))
    out: set[str] = set()
    for node in ast.walk(tree):
        for loop in getattr(node, "generators", []):
            words = listed(loop.iter) or named.get(getattr(loop.iter, "id", ""), set())
            uses = {
                getattr(n.slice, "id", None) for n in ast.walk(node) if isinstance(n, ast.Subscript)
            }
            if getattr(loop.target, "id", "") in uses:
                out |= words
    return out


def taken(tree: ast.AST) -> set[str]:
    """What is taken by name: ``["gain"]``, ``.noise``, ``row[n] for n in names``."""
    out = looped(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant):
            out.add(str(node.slice.value))
        elif isinstance(node, ast.Attribute):
            out.add(node.attr)
    return out


def sources(paper: str, name: str) -> list[ast.Module]:
    """The chapters and scripts that name the scenario."""
    paths = [*chapters(), *sorted((BOOK / "studies").glob("*.py"))]
    trees = [ast.parse(code_of(path)) for path in paths]
    return [tree for tree in trees if {paper, name} <= texts(tree)]


def wanted(paper: str, name: str) -> set[str]:
    """The parameters, and the columns of the rows; a network is also taken as `adjacency`."""
    s = scenario(paper, name)
    columns = {c for rows in s.tables.values() for row in rows for c in row.value_columns}
    return set(s) | columns - {"name", "unit"}


@pytest.mark.parametrize(("paper", "name"), NAMES)
def test_every_parameter_is_read(paper: str, name: str) -> None:
    homes = {i.chapter for i in items() if i.paper == paper}
    if not any(c.stem in homes for c in chapters()):
        pytest.skip(f"no chapter on {paper} yet")
    found = set().union(*(taken(tree) for tree in sources(paper, name)))
    found |= {"neighbours"} if "adjacency" in found else set()
    unread = sorted(wanted(paper, name) - found)
    assert not unread, f"{paper}/{name}: read by nothing, so notes: {', '.join(unread)}"


def test_a_parameter_that_nothing_takes_is_found() -> None:
    tree = ast.parse('s = scenario("a", "b")\nx = s["gain"] + s.agents[0].noise + f(q="rounds")')
    assert {"gain", "noise", "agents"} <= taken(tree) and "rounds" not in taken(tree)
    assert {"a", "b", "rounds"} <= texts(tree)


@pytest.fixture
def tool() -> ModuleType:
    import scenarios

    return scenarios


def test_the_scenarios_are_as_accepted(tool: ModuleType) -> None:
    assert tool.main([]) == 0


def test_a_change_has_to_be_accepted(
    tool: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(ROOT / "data" / "scenarios", tmp_path / "data" / "scenarios")
    assert tool.main([], tmp_path) == 0
    path = tmp_path / "data" / "scenarios" / "grange" / "table-2.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("value = 200\n", "value = 50\n"), encoding="utf-8")
    assert tool.main([], tmp_path) == 1
    assert "make accept" in capsys.readouterr().err
    assert tool.main(["--accept"], tmp_path) == 0 == tool.main([], tmp_path)
