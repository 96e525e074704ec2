"""Write the ledger of reproductions from the verdicts that the stored chapters hold.

    python book/tools/ledger.py [--check]

``data/published/items.csv`` lists the tables and figures of the papers; a chapter displays a
verdict for an item that it has reproduced. An item without a verdict is "not yet"; two verdicts for
one item are an error. With ``--check`` nothing is written and ``data/published/ledger.csv`` is
compared byte for byte.
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
    "control",
    "range",
    "published",
    "why",
)
OPEN = "not yet"
VERDICTS = {kind: (*verdicts, OPEN) for kind, verdicts in published.VERDICTS.items()}
"""Possible verdicts of each kind of item in the ledger."""
WORDS = {
    "parameters": "tables of parameters",
    "results": "tables and figures of results",
}


def verdicts_of(notebook: Path) -> list[dict[str, str]]:
    """Return the verdicts that one stored notebook displays, each with its chapter."""
    stored: Any = nbformat.read(notebook, as_version=4)
    # A chapter displays a verdict in several forms; this one is for machines.
    verdicts = [
        output["data"][VERDICT]
        for cell in stored.cells
        for output in cell.get("outputs", [])
        if VERDICT in output.get("data", {})
    ]
    return [{**verdict, "chapter": notebook.stem} for verdict in verdicts]


def ledger(
    items: list[dict[str, str]], verdicts: list[dict[str, str]]
) -> list[dict[str, str]]:
    """Return one row for each item, with the verdict that a chapter computed or "not yet".

    Raises
    ------
    ValueError
        If a verdict names no item, an item has two, or a verdict is not one of its kind's.
    """
    # A verdict belongs to the item of the same paper and name.
    keys = [(item["paper"], item["item"]) for item in items]
    kinds = dict(zip(keys, (item["kind"] for item in items), strict=True))
    by_item: dict[tuple[str, str], dict[str, str]] = {}
    for verdict in verdicts:
        key = (verdict["paper"], verdict["item"])
        where = f"{verdict['chapter']}: {' '.join(key)}"
        if key not in keys:
            raise ValueError(f"{where}: not an item of {ITEMS.name}")
        if key in by_item:
            raise ValueError(
                f"{where}: has a verdict already, in {by_item[key]['chapter']}"
            )
        allowed = VERDICTS[kinds[key]]
        if verdict["verdict"] not in allowed:
            raise ValueError(
                f"{where}: verdict {verdict['verdict']!r}, needs one of {allowed}"
            )
        by_item[key] = verdict
    # The item's cells, then those of its verdict, replace the blanks.
    blank = dict.fromkeys(COLUMNS, "") | {"verdict": OPEN}
    return [
        {name: (blank | item | by_item.get(key, {}))[name] for name in COLUMNS}
        for key, item in zip(keys, items, strict=True)
    ]


def text_of(rows: list[dict[str, str]]) -> str:
    """Return the ledger as CSV text."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return buffer.getvalue()


def summaries(rows: list[dict[str, str]]) -> dict[str, tuple[int, dict[str, int]]]:
    """Return, for each kind of item, their number and the number with each verdict."""
    summary = {}
    for kind, verdicts in VERDICTS.items():
        counts = Counter(row["verdict"] for row in rows if row["kind"] == kind)
        by_verdict = {verdict: counts[verdict] for verdict in verdicts}
        # All possible verdicts are listed, also those that no item has.
        summary[kind] = (counts.total(), by_verdict)
    return summary


@dataclass(frozen=True)
class LedgerClaim:
    """One claim of a row of the ledger, for one of the starts that were judged."""

    id: str
    start: str
    holds: bool
    ours: str
    null: str
    control: str
    range: str


START = r"(?:(?P<start>(?:off|on) the circle): )?"


def split_claims(text: str, head: str) -> list[tuple[str, re.Match[str], str]]:
    """Split a cell of the ledger at its claims: the start, the match of the head, the text."""
    heads = list(re.finditer(rf"(?:^|; ){START}{head}", text))
    ends = [match.start() for match in heads[1:]] + [len(text)]
    pieces = []
    start = ""
    for match, end in zip(heads, ends, strict=False):
        # A start holds for all claims up to the next start.
        start = match["start"] or start
        pieces.append((start, match, text[match.end() : end]))
    return pieces


def claims_of(row: dict[str, str]) -> list[LedgerClaim]:
    """Return the claims of a row of results, each with its null and its range."""
    # Each cell of the row lists the claims by their ids, in its own form.
    ours = split_claims(row["ours"], r"(?P<id>[a-z0-9-]+) (?P<word>holds|fails): ")
    ids = "|".join(dict.fromkeys(match["id"] for _, match, _ in ours))
    # Nulls, controls and ranges are matched to the claims by start and id.
    evidence: dict[str, dict[tuple[str, str], str]] = {}
    for column, end in (("null", ", "), ("control", ", "), ("range", " ")):
        evidence[column] = {}
        for start, match, text in split_claims(row[column], rf"(?P<id>{ids}){end}"):
            evidence[column][start, match["id"]] = text
    claims = []
    for start, match, text in ours:
        key = (start, match["id"])
        holds = match["word"] == "holds"
        texts = {name: by_claim.get(key, "") for name, by_claim in evidence.items()}
        claims.append(LedgerClaim(match["id"], start, holds, text, **texts))
    return claims


def powerless_claims(row: dict[str, str]) -> list[str]:
    """Return the claims of a row whose rule holds on the null's numbers too, or has no null.

    In the first case the text of the null ends in "(holds too)".
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
        sys.exit(
            f"{LEDGER.name} differs from the verdicts of the stored chapters: make outputs"
        )
    for kind, (total, counts) in summaries(read_rows(LEDGER)).items():
        print(
            f"{total} {WORDS[kind]}: "
            + ", ".join(f"{n} {v}" for v, n in counts.items())
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
