"""Write the ledger of reproductions from the verdicts that the stored chapters hold.

    python book/tools/ledger.py [--check]

``data/published/items.csv`` lists what the papers print; a chapter displays a verdict for an item
that it has reproduced. An item without a verdict is "not yet"; two verdicts for one item are an
error. With ``--check`` nothing is written and ``data/published/ledger.csv`` is compared byte for
byte.
"""

from __future__ import annotations

import csv
import io
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import nbformat

from bookkit import published
from bookkit.rows import read_rows
from common import ROOT, VERDICT, chapters

ITEMS = ROOT / "data" / "published" / "items.csv"
LEDGER = ROOT / "data" / "published" / "ledger.csv"
COLUMNS = ("paper", "item", "kind", "chapter", "verdict", "ours", "null", "range",
           "published", "why")  # fmt: skip
OPEN = "not yet"
VERDICTS = {kind: (*found, OPEN) for kind, found in published.VERDICTS.items()}
"""What can stand in the ledger for each kind of item."""
WORDS = {"parameters": "tables of parameters", "results": "tables and figures of results"}


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


def ledger(items: list[dict[str, str]], verdicts: list[dict[str, str]]) -> list[dict[str, str]]:
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
            raise ValueError(f"{where}: has a verdict already, in {given[key]['chapter']}")
        known = VERDICTS[kinds[key]]
        if verdict["verdict"] not in known:
            raise ValueError(f"{where}: verdict {verdict['verdict']!r}, needs one of {known}")
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
        print(f"{total} {WORDS[kind]}: " + ", ".join(f"{n} {v}" for v, n in counts.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
