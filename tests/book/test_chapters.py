"""Rules for the source of every chapter."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from common import chosen
from execute import read

CHAPTERS = [source for source in chosen([]) if source.stem[0].isdigit()]


def import_lines(source: Path) -> int:
    """Count the lines of imports in the first cell, without those from `bookkit`."""
    cell = next(cell for cell in read(source).cells if cell.cell_type == "code")
    # Only the top level: imports inside functions are not the reader's concern.
    imports = [
        n
        for n in ast.parse(cell.source).body
        if isinstance(n, ast.Import | ast.ImportFrom)
    ]
    counted = [
        n
        for n in imports
        if not (getattr(n, "module", None) or "").startswith("bookkit")
    ]
    # An import in parentheses counts with all its lines.
    return sum((n.end_lineno or n.lineno) - n.lineno + 1 for n in counted)


@pytest.mark.parametrize("source", CHAPTERS, ids=lambda p: p.stem)
def test_import_cell_is_short(source: Path) -> None:
    # A reader sees few names at first, and from few modules.
    assert 1 <= import_lines(source) <= 8
