"""Compare each chapter's Markdown with its stored notebook, and find outputs that must not be
stored.

    python book/tools/pairs.py [CHAPTER ...]

nbval accepts a notebook whose outputs and execution counts were both cleared, so that these are
checked here too.
"""

from __future__ import annotations

import startup  # noqa: F401

# isort: split
import re
import sys
from pathlib import Path
from typing import Any

import nbformat
from jupytext.compare import compare_cells

from common import (
    BOOK,
    ROOT,
    SLIDER,
    chosen,
    foreign_text,
    is_chapter,
    missing_pages,
    toc_pages,
)
from execute import read

WIDTH = 79
"""Longest line of code and of printed text: it fits the page at 1200 pixels, and paper."""


def differences(source: Path, stored: Any) -> list[str]:
    """Describe the differences between the cells of the Markdown and of the notebook."""
    fresh = read(source)
    # Outputs and execution counts are the notebook's own.
    cells, keys = compare_cells(
        stored.cells,
        fresh.cells,
        raise_on_first_difference=False,
        compare_outputs=False,
    )
    differs = "differs between the Markdown and the notebook"
    problems = [f"{key} of a cell {differs}" for key in sorted(keys)]
    if cells:
        numbers = ", ".join(map(str, sorted(cells)))
        problems.append(f"a cell's source, type or id {differs}, in {numbers}")
    # The state of widgets is an output, so it is the notebook's own.
    if fresh.metadata != {k: v for k, v in stored.metadata.items() if k != "widgets"}:
        problems.append("the headers of the Markdown and of the notebook differ")
    return problems


def code_faults(cell: Any, count: int) -> list[str]:
    """Return the faults of one stored code cell, the `count`-th of its chapter."""
    if not cell.source.strip():
        return ["an empty code cell"]
    faults = []
    # Counts of 1, 2, 3 … show that the cells ran once, in order.
    if cell.execution_count != count:
        wrong = f"execution count {cell.execution_count}, needs {count}"
        faults.append(f"{wrong}: make outputs")
    for line in cell.source.splitlines():
        if len(line) > WIDTH:
            start = f"{line.strip()[:40]}…"
            faults.append(f"a line of {len(line)} characters, at most {WIDTH}: {start}")
    for output in cell.outputs:
        faults += output_faults(output)
    return faults + figure_faults(cell)


def output_faults(output: Any) -> list[str]:
    """Return the faults of one stored output."""
    faults = []
    if output.output_type == "error":
        faults.append(f"a stored error: {output.ename}")
    if output.get("name") == "stderr":
        faults.append("stored stderr")
    for line in text_of(output).splitlines():
        if len(line) > WIDTH:
            length = f"{len(line)} characters printed, at most {WIDTH}"
            faults.append(f"a line of {length}: {line}")
    foreign = foreign_text(output)
    if foreign:
        faults.append(f"an output holds {foreign!r}, which belongs to one machine")
    return faults


def text_of(output: Any) -> str:
    """Return the text that a page shows of an output; '' where it shows a picture or a table."""
    data = output.get("data", {})
    return str(output.get("text", data.get("text/plain", ""))) if len(data) < 2 else ""


def figure_faults(cell: Any) -> list[str]:
    """Return the faults of a figure's cell: picture, alternative text, caption, digest."""
    pictures = [
        output["data"]
        for output in cell.outputs
        if any(mime.startswith("image/") for mime in output.get("data", {}))
    ]
    options = cell.metadata.get("mystnb", {})
    if not pictures and not options.get("figure"):
        return []
    faults = []
    if len(pictures) != 1:
        faults.append(f"a figure's cell with {len(pictures)} pictures, needs one")
    for data in pictures:
        if data.get("text/plain", "<").startswith("<"):
            faults.append(
                "a picture without the digest of its axes: plotting.use_style()"
            )
    # A slider has its alternative text in its HTML.
    moving = [data for data in pictures if SLIDER in data.get("text/html", "")]
    if not moving and not str(options.get("image", {}).get("alt", "")).strip():
        faults.append("a figure without mystnb.image.alt in its header")
    if not str(options.get("figure", {}).get("caption", "")).strip():
        faults.append("a figure without mystnb.figure.caption in its header")
    return faults


def check(source: Path) -> list[str]:
    """Return the problems of one pair."""
    target = source.with_suffix(".ipynb")
    if not target.is_file():
        return [f"{source.stem}: no stored notebook: make outputs"]
    stored = nbformat.read(target, as_version=4)
    problems = differences(source, stored)
    # Text cells have neither outputs nor counts.
    code = [cell for cell in stored.cells if cell.cell_type == "code"]
    for count, cell in enumerate(code, start=1):
        problems += [f"{cell.get('id')}: {fault}" for fault in code_faults(cell, count)]
    return [f"{source.stem}: {problem}" for problem in problems]


def strays() -> list[str]:
    """Return pages without a file, files without a page, and code outside notebooks."""
    problems = [f"_toc.yml names {page}, which has no file" for page in missing_pages()]
    # A file that the table of contents does not name is not built.
    pages = set(toc_pages())
    for path in sorted([*BOOK.glob("*.md"), *BOOK.glob("*.ipynb")]):
        page = path.relative_to(ROOT).with_suffix("").as_posix()
        if page not in pages:
            problems.append(f"{path.name} is not in _toc.yml")
        if path.suffix == ".ipynb" and not path.with_suffix(".md").is_file():
            problems.append(f"{path.name} has no Markdown source")
        # Code on a page that is no notebook would never run.
        if path.suffix == ".md" and not is_chapter(path):
            text = path.read_text(encoding="utf-8")
            if re.search(r"^(`{3,}|:{3,})\{code-cell\}", text, flags=re.MULTILINE):
                problems.append(f"{path.name} has a code cell but no notebook header")
    return problems


def main() -> int:
    names = sys.argv[1:]
    sources = chosen(names)
    problems = [problem for source in sources for problem in check(source)]
    problems += [] if names else strays()
    for problem in problems:
        print(problem, file=sys.stderr)
    print(f"{len(sources)} pairs of Markdown and notebook, {len(problems)} problems")
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
