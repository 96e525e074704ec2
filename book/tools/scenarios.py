"""Compare the scenarios with the accepted values, or accept them as they are.

    python book/tools/scenarios.py [--update]

``data/scenarios/accepted.csv`` has a line for every value of every scenario. With it a chapter
detects a reader's change and shows the verdict "not comparable: changed scenario". After a change
of the book's own scenarios, run ``make update-scenarios`` and commit the file with the scenario.
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
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(COLUMNS)
    for paper in PAPERS:
        # Sorted, so that the file is the same on every file system.
        for path in sorted((folder / paper).glob("*.toml")):
            scenario = read_scenario(path)
            writer.writerows(
                [paper, scenario.name, key, value]
                for key, value in scenario.entries().items()
            )
    return buffer.getvalue()


def main(arguments: list[str] | None = None, root: Path = ROOT) -> int:
    folder = root / "data" / "scenarios"
    target = folder / "accepted.csv"
    text = text_of(folder)
    if "--update" in (sys.argv[1:] if arguments is None else arguments):
        target.write_text(text, encoding="utf-8", newline="\n")
    elif not target.is_file() or target.read_text(encoding="utf-8") != text:
        print(
            "the scenarios differ from accepted.csv: make update-scenarios",
            file=sys.stderr,
        )
        return 1
    print(f"{len(text.splitlines()) - 1} values of scenarios equal the accepted ones")
    return 0


if __name__ == "__main__":
    sys.exit(main())
