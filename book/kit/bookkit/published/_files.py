"""Where the data lie, how a fault in a file is reported, and how rows become a table to read."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..folders import data_root

__all__: list[str] = []  # used inside this folder only


def shown(path: Path) -> str:
    """The path as an error prints it: without this machine's part for the library's own data."""
    try:
        return path.resolve().relative_to(data_root()).as_posix()
    except ValueError:
        return str(path)


def fault(path: Path, line: int, message: str) -> ValueError:
    """The error for a malformed file."""
    return ValueError(f"path: {shown(path)}, line {line}: {message}")


def read_text(path: Any) -> tuple[Path, str]:
    """The text of a file that has to be UTF-8 and not empty."""
    if not isinstance(path, str | Path):
        raise ValueError(f"path: needs a path, got {type(path).__name__}")
    source = Path(path)
    if not source.is_file():
        raise ValueError(f"path: needs a file, got {shown(source)}")
    raw = source.read_bytes()
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError as error:
        line = raw[: error.start].count(b"\n") + 1
        raise fault(source, line, "needs UTF-8 text") from None
    if not text.strip():
        raise fault(source, 1, "needs content, got an empty file")
    return source, text


def named_file(folder: Path, name: Any, suffix: str) -> Path:
    """The file of that name in a folder, or an error that lists the names there are."""
    there = sorted(p.stem for p in folder.glob(f"*{suffix}"))
    if name not in there:
        raise ValueError(f"name: needs one of {', '.join(there) or 'none yet'}, got {name!r}")
    return folder / f"{name}{suffix}"


_RULE = "border-top:1px solid;border-bottom:1px solid"
_CELL = "text-align:left;vertical-align:top;padding:.1em .8em .1em 0"


def html_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows as an HTML table with three rules."""

    def cells(tag: str, texts: Sequence[str]) -> str:
        return "".join(f'<{tag} style="{_CELL}">{html.escape(t)}</{tag}>' for t in texts)

    body = "\n".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return (
        '<table style="border-collapse:collapse;border-bottom:1px solid">\n'
        f'<thead style="{_RULE}"><tr>{cells("th", columns)}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody>\n</table>"
    )


def markdown_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Rows as a Markdown table."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(
        "| " + " | ".join(t.replace("\\", "\\\\").replace("|", "\\|") for t in line) + " |"
        for line in lines
    )


def text_table(columns: Sequence[str], rows: Sequence[Sequence[str]], *, width: int = 60) -> str:
    """Rows as aligned text with three rules; long cells are wrapped."""
    blocks = [[textwrap.wrap(t, width) or [""] for t in row] for row in rows]
    widths = [
        max([len(name), *(len(line) for block in blocks for line in block[k])])
        for k, name in enumerate(columns)
    ]

    def line(texts: Sequence[str]) -> str:
        return "  ".join(t.ljust(w) for t, w in zip(texts, widths, strict=True)).rstrip()

    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
    out = [rule, line(columns), rule]
    for block in blocks:
        for k in range(max(len(cell) for cell in block)):
            out.append(line([cell[k] if k < len(cell) else "" for cell in block]))
    return "\n".join([*out, rule])
