"""CSV files as rows, and rows as tables to read."""

from __future__ import annotations

import csv
import html
from collections.abc import Sequence
from pathlib import Path

__all__ = ["html_table", "markdown_table", "read_rows"]

Rows = Sequence[Sequence[str]]


def read_rows(path: Path) -> list[dict[str, str]]:
    """A CSV file's rows, cell by cell as they stand there, by the names of its first line.

    A row that does not fit the first line is refused by the file's name.
    """
    with path.open(encoding="utf-8", newline="") as lines:
        reader = csv.DictReader(lines, strict=True)
        rows = list(reader)
    for number, row in enumerate(rows, start=1):
        if None in row or None in row.values():
            raise ValueError(
                f"{path.name}, row {number}: has not as many cells as the first line"
            )
    return rows


_RULE = "border-top:1px solid;border-bottom:1px solid"
_CELL = "text-align:left;vertical-align:top;padding:.1em .8em .1em 0"


def html_table(columns: Sequence[str], rows: Rows) -> str:
    """Rows as an HTML table with three rules."""

    def cells(tag: str, texts: Sequence[str]) -> str:
        return "".join(
            f'<{tag} style="{_CELL}">{html.escape(t)}</{tag}>' for t in texts
        )

    body = "\n".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return (
        '<table style="border-collapse:collapse;border-bottom:1px solid">\n'
        f'<thead style="{_RULE}"><tr>{cells("th", columns)}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody>\n</table>"
    )


def markdown_table(columns: Sequence[str], rows: Rows) -> str:
    """Rows as a Markdown table."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(
        "| "
        + " | ".join(t.replace("\\", "\\\\").replace("|", "\\|") for t in line)
        + " |"
        for line in lines
    )
