"""Write the ledger of reproductions from the verdicts that the stored chapters hold.

    python book/tools/ledger.py [--check]

``data/published/items.csv`` lists what the papers print; a chapter displays a verdict for an item
that it has reproduced. An item without a verdict is "not yet"; two verdicts for one item are an
error. With ``--check`` nothing is written and ``data/published/ledger.csv`` is compared byte for
byte.
"""

from __future__ import annotations

import startup  # noqa: F401

# isort: split
import csv
import io
import re
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nbformat

from bookkit import published
from bookkit.rows import read_rows
from common import ROOT, VERDICT, chapters

ITEMS = ROOT / "data" / "published" / "items.csv"
LEDGER = ROOT / "data" / "published" / "ledger.csv"
COLUMNS = (
    "paper",
    "item",
    "kind",
    "chapter",
    "verdict",
    "ours",
    "null",
    "range",
    "published",
    "why",
)
OPEN = "not yet"
VERDICTS = {kind: (*found, OPEN) for kind, found in published.VERDICTS.items()}
"""What can stand in the ledger for each kind of item."""
WORDS = {
    "parameters": "tables of parameters",
    "results": "tables and figures of results",
}


def verdicts_of(notebook: Path) -> list[dict[str, str]]:
    """Return the verdicts that one stored notebook displays, each with its chapter."""
    stored: Any = nbformat.read(notebook, as_version=4)
    found = [
        output["data"][VERDICT]
        for cell in stored.cells
        for output in cell.get("outputs", [])
        if VERDICT in output.get("data", {})
    ]
    return [{**verdict, "chapter": notebook.stem} for verdict in found]


def ledger(
    items: list[dict[str, str]], verdicts: list[dict[str, str]]
) -> list[dict[str, str]]:
    """Return one row for each item, with the verdict that a chapter computed or "not yet".

    Raises
    ------
    ValueError
        If a verdict names no item, an item has two, or a verdict is not one of its kind's.
    """
    keys = [(item["paper"], item["item"]) for item in items]
    kinds = dict(zip(keys, (item["kind"] for item in items), strict=True))
    given: dict[tuple[str, str], dict[str, str]] = {}
    for verdict in verdicts:
        key = (verdict["paper"], verdict["item"])
        where = f"{verdict['chapter']}: {' '.join(key)}"
        if key not in keys:
            raise ValueError(f"{where}: not an item of {ITEMS.name}")
        if key in given:
            raise ValueError(
                f"{where}: has a verdict already, in {given[key]['chapter']}"
            )
        known = VERDICTS[kinds[key]]
        if verdict["verdict"] not in known:
            raise ValueError(
                f"{where}: verdict {verdict['verdict']!r}, needs one of {known}"
            )
        given[key] = verdict
    blank = dict.fromkeys(COLUMNS, "") | {"verdict": OPEN}
    return [
        {name: (blank | item | given.get(key, {}))[name] for name in COLUMNS}
        for key, item in zip(keys, items, strict=True)
    ]


def text_of(rows: list[dict[str, str]]) -> str:
    """Return the ledger as CSV text."""
    out = io.StringIO()
    writer = csv.DictWriter(out, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return out.getvalue()


def summaries(rows: list[dict[str, str]]) -> dict[str, tuple[int, dict[str, int]]]:
    """Return, for each kind of item, how many there are and how many have each verdict."""
    out = {}
    for kind, known in VERDICTS.items():
        found = Counter(row["verdict"] for row in rows if row["kind"] == kind)
        out[kind] = found.total(), {verdict: found[verdict] for verdict in known}
    return out


@dataclass(frozen=True)
class Judged:
    """One claim of a row as the ledger tells it, for one of the starts that were judged."""

    id: str
    start: str
    holds: bool
    ours: str
    null: str
    range: str


START = r"(?:(?P<start>(?:off|on) the circle): )?"


def parts(text: str, head: str) -> list[tuple[str, re.Match[str], str]]:
    """Split a cell of the ledger at its claims: the start, the head's match, the rest."""
    hits = list(re.finditer(rf"(?:^|; ){START}{head}", text))
    out = []
    start = ""
    ends = [h.start() for h in hits[1:]] + [len(text)] * bool(hits)
    for hit, end in zip(hits, ends, strict=True):
        start = hit["start"] or start
        out.append((start, hit, text[hit.end() : end]))
    return out


def claims_of(row: dict[str, str]) -> list[Judged]:
    """Return the claims of a row of results, each with its null and its range."""
    ours = parts(row["ours"], r"(?P<id>[a-z0-9-]+) (?P<word>holds|fails): ")
    ids = "|".join(dict.fromkeys(hit["id"] for _, hit, _ in ours))
    nulls = {
        (s, hit["id"]): rest for s, hit, rest in parts(row["null"], rf"(?P<id>{ids}), ")
    }
    ranges = {
        (s, hit["id"]): rest for s, hit, rest in parts(row["range"], rf"(?P<id>{ids}) ")
    }
    return [
        Judged(
            hit["id"],
            s,
            hit["word"] == "holds",
            rest,
            nulls.get((s, hit["id"]), ""),
            ranges.get((s, hit["id"]), ""),
        )
        for s, hit, rest in ours
    ]


def powerless_claims(row: dict[str, str]) -> list[str]:
    """Return the claims of a row whose verdict is the same on the null's numbers, or lacks one.

    A claim writes "holds too" behind its null when its rule, asked of the null, holds.
    """
    return [c.id for c in claims_of(row) if not c.null or "(holds too)" in c.null]


def current() -> str:
    """Return the ledger that the stored chapters give now."""
    stored = [chapter.with_suffix(".ipynb") for chapter in chapters()]
    verdicts = [v for path in stored if path.is_file() for v in verdicts_of(path)]
    return text_of(ledger(read_rows(ITEMS), verdicts))


def main() -> int:
    try:
        text = current()
    except ValueError as error:
        sys.exit(f"the ledger cannot be written: {error}")
    if "--check" not in sys.argv[1:]:
        LEDGER.write_text(text, encoding="utf-8")
    elif not LEDGER.is_file() or LEDGER.read_text(encoding="utf-8") != text:
        sys.exit(f"{LEDGER.name} is not what the stored chapters give: make outputs")
    for kind, (total, counts) in summaries(read_rows(LEDGER)).items():
        print(
            f"{total} {WORDS[kind]}: "
            + ", ".join(f"{n} {v}" for v, n in counts.items())
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
