"""Scripts of long studies are checked before their first trial, not after the last."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
GOOD = """
from distfilt.studies import spawn
NAME, PAPER, columns, parameters = "small", "grange", ["a", "b"], {}
seeds = spawn(1, 2)
def trial(seed):
    return [0.0, 1.0]
"""


@pytest.fixture()
def tool(monkeypatch: pytest.MonkeyPatch) -> object:
    import importlib.util

    monkeypatch.syspath_prepend(str(ROOT / "book" / "tools"))
    path = ROOT / "book" / "tools" / "studies.py"
    spec = importlib.util.spec_from_file_location("study_tool", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "study_tool", module)
    spec.loader.exec_module(module)
    return module


def _script(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "small.py"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_good_script_is_taken(tool: object, tmp_path: Path) -> None:
    assert tool.load_script(_script(tmp_path, GOOD)).NAME == "small"


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('["a", "b"]', '["a b", "c"]', "columns"),
        ('["a", "b"]', '["a", "a"]', "columns"),
        ("def trial", "def try_it", "has to define trial"),
        ('"grange"', '"grunge"', "PAPER"),
        ('"small"', '"Small one"', "NAME"),
    ],
)
def test_a_bad_script_is_refused_before_it_runs(
    tool: object, tmp_path: Path, old: str, new: str, complaint: str
) -> None:
    with pytest.raises(ValueError, match=complaint):
        tool.load_script(_script(tmp_path, GOOD.replace(old, new)))
