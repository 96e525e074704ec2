"""The papers' values as printed: one CSV a table, and the list of everything to reproduce."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from distfilt.checks import Array, array, choice, count, instance

from ..folders import data_root
from ._files import fault, named_file, read_text, shown

__all__ = ["KINDS", "PAPERS", "Item", "Table", "accepted", "items", "read_table", "root", "table"]

PAPERS = ("grange", "das", "semeraro", "zheng")
"""Keys of the papers: triangular maps, constrained transport, mixture fusion, density."""

KINDS = ("parameters", "results")
"""What an item is: a table of parameters, which a study reads, or results, which it reproduces."""

_COLUMN = re.compile(r"[a-z][a-z0-9_]*")
_ITEM = re.compile(r"(Table|Fig\.) (\d+|I{1,3})")
_ITEM_COLUMNS = ("paper", "item", "kind", "title", "chapter")
_ACCEPTED = ("paper", "scenario", "entry", "value")


def root() -> Path:
    """The folder that holds the data: ``published/KEY`` and ``scenarios/KEY`` for each paper.

    It is the working copy's that the process runs in, or the one that the library carries;
    :func:`bookkit.folders.data_root` has the rule.

    >>> (root() / "published" / "items.csv").is_file()
    True
    """
    return data_root()


@dataclass(frozen=True)
class Table:
    """The text of a CSV file, cell by cell as it stands there.

    Parameters
    ----------
    columns : tuple of str
        The header.
    rows : tuple of tuple of str
        One tuple a row, as long as the header.
    path : Path
        Where it was read.
    lines : tuple of int
        The line of the file on which each row begins, for errors.

    Examples
    --------
    >>> printed = table("grange", "table-2")
    >>> printed.text("kind")
    ('direct', 'angle', 'direct')
    >>> printed.numbers("noise")
    array([0.2, 0.2, 0.1])
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    path: Path
    lines: tuple[int, ...]

    def __post_init__(self) -> None:
        if any(len(row) != len(self.columns) for row in self.rows):
            raise ValueError(f"rows: needs {len(self.columns)} cells in every row")
        if len(self.lines) != len(self.rows):
            raise ValueError(f"lines: needs one for each of {len(self.rows)} rows")

    def __len__(self) -> int:
        return len(self.rows)

    def text(self, column: str) -> tuple[str, ...]:
        """The cells of a column as text."""
        k = self.columns.index(choice(column, "column", self.columns))
        return tuple(row[k] for row in self.rows)

    def numbers(self, column: str) -> Array:
        """The cells of a column as finite numbers, (rows,); the error names file and line."""
        out = []
        for cell, line in zip(self.text(column), self.lines, strict=True):
            try:
                out.append(float(cell))
            except ValueError:
                out.append(np.nan)
            if not np.isfinite(out[-1]):
                raise fault(self.path, line, f"{column} needs a number, got {cell!r}")
        return array(out, column)

    def records(self) -> tuple[dict[str, str], ...]:
        """One dictionary a row, from column to cell."""
        return tuple(dict(zip(self.columns, row, strict=True)) for row in self.rows)


def read_table(
    path: str | Path, *, columns: Sequence[str] | None = None, key: int = 1,
    numbers: Sequence[str] = (),
) -> Table:
    """Read a CSV file strictly.

    The first line is the header, in lower case. Every row has as many fields as the header, and
    the first `key` fields tell the rows apart.

    Parameters
    ----------
    path : str or Path
        A UTF-8 file.
    columns : sequence of str, optional
        The header that is needed.
    key : int
        How many leading columns form the key.
    numbers : sequence of str
        Columns that have to hold finite numbers.

    Raises
    ------
    ValueError
        With file and line, if the file is empty, not UTF-8 or has no header, a row has another
        number of fields, a key occurs twice, or a number is none.

    Examples
    --------
    >>> read_table(root() / "published" / "items.csv", key=2).columns
    ('paper', 'item', 'kind', 'title', 'chapter')
    """
    source, text = read_text(path)
    leading, checked = count(key, "key"), _names(numbers, "numbers")
    header = None if columns is None else _names(columns, "columns")
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows, lines = [], []
    line = 1
    try:
        for row in reader:
            rows.append(tuple(row))
            lines.append(line)
            line = reader.line_num + 1
    except csv.Error as error:
        raise fault(source, line, f"needs well-formed CSV: {error}") from None
    _check_header(source, rows[0], header)
    _check_rows(source, rows, lines, leading)
    found = Table(rows[0], tuple(rows[1:]), source, tuple(lines[1:]))
    for name in checked:
        found.numbers(choice(name, "numbers", found.columns))
    return found


def _names(value: Sequence[str], name: str) -> tuple[str, ...]:
    """The names of columns, of which a text alone would be its letters."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise ValueError(f"{name}: needs a list of columns, got {value!r}")
    return tuple(instance(v, name, str) for v in value)


def _check_header(path: Path, header: tuple[str, ...], needed: tuple[str, ...] | None) -> None:
    if needed is not None and header != needed:
        raise fault(path, 1, f"needs the header {','.join(needed)}, got {','.join(header)}")
    for name in header:
        if not _COLUMN.fullmatch(name):
            raise fault(path, 1, f"needs a header of lower-case names, got {name!r}")
    if len(set(header)) != len(header):
        raise fault(path, 1, f"needs distinct column names, got {','.join(header)}")


def _check_rows(path: Path, rows: list[tuple[str, ...]], lines: list[int], leading: int) -> None:
    if len(rows) == 1:
        raise fault(path, 1, "needs at least one row under the header")
    seen: dict[tuple[str, ...], int] = {}
    for row, line in zip(rows[1:], lines[1:], strict=True):
        if len(row) != len(rows[0]):
            raise fault(path, line, f"needs {len(rows[0])} fields, got {len(row)}")
        first = row[:leading]
        if first in seen:
            name = ", ".join(first)
            raise fault(path, line, f"has the key {name!r} of line {seen[first]} again")
        seen[first] = line


def table(paper: str, name: str, *, numbers: Sequence[str] = ()) -> Table:
    """A table of a paper as printed, from ``published/KEY/NAME.csv``.

    Parameters
    ----------
    paper : {"grange", "das", "semeraro", "zheng"}
        The paper's key.
    name : str
        Such as ``table-2``; or ``figure-1``, the claims that a figure's caption and text make.
    numbers : sequence of str
        Columns that have to hold finite numbers.

    Examples
    --------
    >>> table("grange", "table-3").text("name")
    ('A', 'B', 'C', 'D', 'E')
    """
    folder = data_root() / "published" / choice(paper, "paper", PAPERS)
    return read_table(named_file(folder, name, ".csv"), numbers=numbers)


@dataclass(frozen=True)
class Item:
    """A table or figure to reproduce.

    Parameters
    ----------
    paper : str
        The paper's key.
    item : str
        Its name as printed: ``Table II``, ``Fig. 1``.
    kind : {"parameters", "results"}
        Whether a study reads it or reproduces it.
    title : str
        What it shows, in our words.
    chapter : str
        The chapter that reproduces it, such as ``04-satellite-network``.

    Examples
    --------
    >>> Item("grange", "Table II", "parameters", "Three agents", "04-satellite-network").file
    'table-2'
    """

    paper: str
    item: str
    kind: str
    title: str
    chapter: str

    def __post_init__(self) -> None:
        choice(self.paper, "paper", PAPERS)
        if not isinstance(self.item, str) or not _ITEM.fullmatch(self.item):
            raise ValueError(f"item: needs a name like 'Table II' or 'Fig. 1', got {self.item!r}")
        choice(self.kind, "kind", KINDS)
        for name in ("title", "chapter"):
            if not instance(getattr(self, name), name, str).strip():
                raise ValueError(f"{name}: needs a text, got {getattr(self, name)!r}")

    @property
    def file(self) -> str:
        """Name of its file in ``published/KEY``, without the ending."""
        kind, number = self.item.split()
        arabic = len(number) if set(number) == {"I"} else int(number)
        return f"{'table' if kind == 'Table' else 'figure'}-{arabic}"


def items() -> tuple[Item, ...]:
    """The tables and figures of the four papers that the book reproduces.

    >>> len(items())
    21
    >>> items()[1].item
    'Table II'
    """
    path = data_root() / "published" / "items.csv"
    found = read_table(path, columns=_ITEM_COLUMNS, key=2)
    out = []
    for row, line in zip(found.rows, found.lines, strict=True):
        try:
            out.append(Item(*row))
        except ValueError as error:
            raise ValueError(f"{shown(path)}, line {line}: {error}") from None
    return tuple(out)


def accepted(paper: str, name: str) -> dict[str, str]:
    """The entries of a scenario that the book stands for; empty if it has no such scenario.

    ``scenarios/accepted.csv`` has a line for every entry of every scenario, by which a change of
    the TOML file is noticed; who changes the book's own study accepts it with
    ``make accept``.

    Parameters
    ----------
    paper, name : str
        The paper's key and the scenario's name.

    Examples
    --------
    >>> accepted("grange", "table-2")["gain"]
    '0.05 1'
    """
    found = read_table(data_root() / "scenarios" / "accepted.csv", columns=_ACCEPTED, key=3)
    return {entry: value for p, n, entry, value in found.rows if (p, n) == (paper, name)}
