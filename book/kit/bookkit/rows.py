"""Read CSV files as rows, and format rows as tables."""

from __future__ import annotations

import csv
import html
from collections.abc import Sequence
from pathlib import Path

__all__ = ["html_table", "markdown_table", "read_rows"]

Rows = Sequence[Sequence[str]]


def read_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file as texts, by the names in its first line.

    Raises an error that names the file if a row has more or fewer cells than the first line.
    """
    with path.open(encoding="utf-8", newline="") as lines:
        # strict: a stray quote is an error instead of a part of the text.
        reader = csv.DictReader(lines, strict=True)
        rows = list(reader)
    for number, row in enumerate(rows, start=1):
        # DictReader puts cells beyond the header under None, and None for missing ones.
        if None in row or None in row.values():
            raise ValueError(
                f"{path.name}, row {number}: must have as many cells as the first line"
            )
    return rows


_RULE = "border-top:1px solid;border-bottom:1px solid"
_CELL = "text-align:left;vertical-align:top;padding:.1em .8em .1em 0"


def html_table(columns: Sequence[str], rows: Rows) -> str:
    """Return rows as an HTML table with three rules."""

    # Styles stand in the cells, since a notebook outside the book has no style sheet.
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
    """Return rows as a Markdown table."""

    def line(texts: Sequence[str]) -> str:
        # A bar would end the cell.
        escaped = [t.replace("\\", "\\\\").replace("|", "\\|") for t in texts]
        return f"| {' | '.join(escaped)} |"

    rule = ["---"] * len(columns)
    return "\n".join(line(texts) for texts in (columns, rule, *rows))
