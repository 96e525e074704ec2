"""The verdict on a table of parameters: did the study read what the paper prints?"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from . import tables
from .specs import Reading, Scenario
from .verdicts import Verdict, distinct, judged, known_item

__all__ = ["judge_parameters"]


def judge_parameters(
    paper: str, item: str, read: Reading | Sequence[Mapping[str, Any]], *, table: str = "agents",
    scenario: Scenario | None = None,
) -> Verdict:
    """The verdict on a table of parameters: "read" if the study read every cell as printed.

    Rows are paired by the first printed column, and cells compared as numbers where both are
    numbers, else as text without spaces. A cell that the study did not take counts as not read.

    Parameters
    ----------
    paper, item : str
        One of `items`, of kind "parameters".
    read : Reading or sequence of mappings
        What the study used: the `Reading` from which it took its values, or rows from column to
        value that are made of what ran, such as a sensor's kind and standard deviation.
    table : str
        Which of the reading's tables holds the printed rows.
    scenario : Scenario, optional
        What the study ran, as of `judge_table`; the reading itself without it.

    Examples
    --------
    >>> from bookkit.published import scenario
    >>> study = scenario("grange", "table-2").reading()
    >>> used = [(a.kind, a.dims, a.noise) for a in study.agents]
    >>> judge_parameters("grange", "Table II", study).why
    'row A, neighbours: printed [A,B,C], not read by the study'
    >>> links = study.adjacency
    >>> judge_parameters("grange", "Table II", study).verdict
    'read'
    """
    known = known_item(paper, item)
    if known.kind != "parameters":
        raise ValueError(f"item: needs a table of parameters, got {paper} {item}")
    printed = tables.table(known.paper, known.file)
    if isinstance(read, Scenario):
        if not isinstance(read, Reading):
            raise ValueError("read: needs what the study read: Scenario.reading() notes it")
        rows = list(read.cells(table))
    else:
        rows_of = not isinstance(read, str) and isinstance(read, Iterable)
        if not rows_of or not all(isinstance(row, Mapping) for row in read):
            raise ValueError("read: needs a Reading or rows from column to value")
        rows = [dict(row) for row in read]
    first = printed.columns[0]
    if not all(first in row for row in rows):
        raise ValueError(f"read: needs the column {first} in every row")
    distinct([str(row[first]) for row in rows], "read")
    why = _first_difference(rows, printed)
    study = read if scenario is None and isinstance(read, Scenario) else scenario
    ours, said = f"{len(rows)} rows read", f"{len(printed)} rows printed"
    return judged(known, not why, ours, said, why, study)


def _cell(value: Any) -> str:
    """A value as a paper's table prints it: lists in brackets."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return f"[{','.join(str(v) for v in value)}]"
    return str(value)


def _same(a: str, b: str) -> bool:
    try:
        return float(a) == float(b)
    except ValueError:
        return re.sub(r"\s+", "", a) == re.sub(r"\s+", "", b)


def _first_difference(rows: list[dict[str, Any]], printed: tables.Table) -> str:
    """The first printed cell that was not read, or read otherwise, or nothing."""
    first = printed.columns[0]
    by_key = {str(row[first]): row for row in rows}
    for wanted in printed.records():
        key = wanted[first]
        if key not in by_key:
            return f"row {key} is printed but was not read"
        for column in printed.columns:
            if column not in by_key[key]:
                return f"row {key}, {column}: printed {wanted[column]}, not read by the study"
            got = _cell(by_key[key][column])
            if not _same(got, wanted[column]):
                return f"row {key}, {column}: read {got}, printed {wanted[column]}"
    extra = [key for key in by_key if key not in printed.text(first)]
    return f"row {extra[0]} was read but is not printed" if extra else ""
