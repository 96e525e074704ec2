"""Compare the scenarios with the values that the book stands for, or accept them as they are.

    python book/tools/scenarios.py [--accept]

``data/scenarios/accepted.csv`` has a line for every value of every scenario. By it a chapter
notices a reader's change and says "not comparable: changed scenario". Who changes the book's own
study runs ``make accept`` and commits the file with the scenario.
"""

from __future__ import annotations

import csv
import io
import sys
from pathlib import Path

from bookkit.published import PAPERS, read_scenario
from common import ROOT

COLUMNS = ("paper", "scenario", "entry", "value")


def text_of(folder: Path) -> str:
    """Return the text of ``accepted.csv`` for a folder of scenarios."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    for paper in PAPERS:
        for path in sorted((folder / paper).glob("*.toml")):
            s = read_scenario(path)
            writer.writerows(
                [paper, s.name, key, value] for key, value in s.entries().items()
            )
    return out.getvalue()


def main(arguments: list[str] | None = None, root: Path = ROOT) -> int:
    folder = root / "data" / "scenarios"
    target = folder / "accepted.csv"
    text = text_of(folder)
    if "--accept" in (sys.argv[1:] if arguments is None else arguments):
        target.write_text(text, encoding="utf-8", newline="\n")
    elif not target.is_file() or target.read_text(encoding="utf-8") != text:
        print(
            "the scenarios are not those of accepted.csv: make accept", file=sys.stderr
        )
        return 1
    print(f"{len(text.splitlines()) - 1} values of scenarios, as accepted")
    return 0


if __name__ == "__main__":
    sys.exit(main())
