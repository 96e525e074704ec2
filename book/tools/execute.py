"""Execute chapters and store their outputs beside them, the same bytes every time.

    python book/tools/execute.py [CHAPTER ...] [--check] [--bytes] [--jobs N]
    python book/tools/execute.py [CHAPTER ...] --sources

The Markdown is the source; the notebook is written from it. A chapter that raises, warns, writes to
stderr or stores a path of this machine is rejected, and its stored notebook stays unchanged. With
``--check`` nothing is written: the chapters run again and are compared with the stored notebooks,
texts byte for byte, pictures by their pixels. ``--bytes`` compares the bytes of pictures too: they
are the same on the machine that stored them, while another processor may shade a pixel differently.
With ``--sources`` nothing runs: the stored notebook takes the Markdown's cells and keeps its
outputs, for edits that change no output, such as a new name of an import.
"""

from __future__ import annotations

import startup  # noqa: F401

# isort: split
import argparse
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jupytext
import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

from common import ROOT, chosen, end_with_children, fixed_environment, foreign_text
from pictures import differences, extract_pictures, shrink_pictures
from sockets import AsyncManager

KERNELSPEC = {"display_name": "Python 3", "language": "python", "name": "python3"}
LANGUAGE = {
    "codemirror_mode": {"name": "ipython", "version": 3},
    "file_extension": ".py",
    "mimetype": "text/x-python",
    "name": "python",
    "nbconvert_exporter": "python",
    "pygments_lexer": "ipython3",
}
WIDGET_STATE = "application/vnd.jupyter.widget-state+json"


def read(source: Path) -> Any:
    """Return the Markdown source as a notebook with numbered cells and no version in its header."""
    notebook = jupytext.read(source)
    header = notebook.metadata.get("jupytext", {})
    metadata = {
        k: v for k, v in header.items() if k in ("formats", "notebook_metadata_filter")
    }
    # The format without the versions of jupytext, which would change with each update.
    layout = header.get("text_representation", {})
    metadata["text_representation"] = {
        k: v for k, v in layout.items() if k in ("extension", "format_name")
    }
    notebook.metadata = nbformat.from_dict(
        {"jupytext": metadata, "kernelspec": KERNELSPEC, "language_info": LANGUAGE}
    )
    # Numbered ids, so that executing again gives the same bytes.
    for k, cell in enumerate(notebook.cells):
        cell["id"] = f"{source.stem}-{k:03d}"
    notebook.nbformat = 4
    notebook.nbformat_minor = 5
    return notebook


class Client(NotebookClient):
    """A client that stores the first output of an interactive cell beside its widget.

    The HTML then has a picture in place of the widget, and nbval, which does not know widgets,
    finds the outputs that it receives.
    """

    def __init__(self, notebook: Any, **options: Any) -> None:
        super().__init__(notebook, **options)
        self.widget_registry: dict[str, Any] = {}

    def clear_output(self, outs: Any, msg: Any, cell_index: int) -> None:
        """Keep the outputs: an interactive cell clears those of its widget only."""


def run(notebook: Any, folder: Path) -> None:
    """Execute the notebook in place, in its own folder and the pinned environment."""
    client = Client(
        notebook,
        timeout=900,
        kernel_name="python3",
        kernel_manager_class=AsyncManager,
        record_timing=False,
        coalesce_streams=True,
        extra_arguments=["--log-level=40"],
        resources={"metadata": {"path": str(folder)}},
    )
    client.execute(env=fixed_environment())
    # The kernel writes its version of Python there, which differs between machines.
    notebook.metadata["language_info"] = nbformat.from_dict(LANGUAGE)
    for cell in notebook.cells:
        shrink_pictures(cell.get("outputs", []))


def complaints(notebook: Any) -> list[str]:
    """Return outputs that must not be stored: stderr, and texts that depend on the machine."""
    problems = []
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            where = f"cell {cell['id']}:\n{cell.source}\n"
            # A warning is a fault of the chapter, not part of its result.
            if output.get("name") == "stderr":
                problems.append(
                    f"{where}wrote to stderr (fix the cause):\n{output['text']}"
                )
            elif foreign_text(output):
                text = foreign_text(output)
                problems.append(
                    f"{where}its output holds {text!r}, which another run would not"
                )
    return problems


def dump(notebook: Any) -> str:
    """Return the notebook as text: sorted keys, and widget models numbered in order of creation."""
    # Sorted keys: dictionaries of a kernel have no order that lasts.
    text: str = (
        nbformat.writes(notebook, sort_keys=True, indent=1, ensure_ascii=False) + "\n"
    )
    state = notebook.metadata.get("widgets", {}).get(WIDGET_STATE, {}).get("state", {})
    # Widgets have random ids: replace them by their numbers.
    for k, model in enumerate(state):
        text = text.replace(model, f"{k:032d}")
    # The keys were sorted by their random names: sort again by the new ones.
    return text if not state else _sort_keys(text)


def _sort_keys(text: str) -> str:
    # Reading and writing again sorts the keys by their new names.
    notebook = nbformat.reads(text, as_version=4)
    return (
        str(nbformat.writes(notebook, sort_keys=True, indent=1, ensure_ascii=False))
        + "\n"
    )


def unlike(stored: str, fresh: str, compare_bytes: bool) -> str:
    """Describe how another execution differs from the stored notebook; '' if it does not."""
    if stored == fresh:
        return ""
    # Texts must be equal; pictures may differ in a few pixels.
    if compare_bytes or extract_pictures(stored)[0] != extract_pictures(fresh)[0]:
        return "another execution does not give the stored bytes"
    pairs = zip(cells_of(stored), cells_of(fresh), strict=True)
    lines = [
        f"{a['id']}: {text}"
        for a, b in pairs
        for text in differences(a["outputs"], b["outputs"])
    ]
    return "\n".join(lines)


def cells_of(text: str) -> list[Any]:
    """Return the code cells of a notebook's text."""
    cells = nbformat.reads(text, as_version=4).cells
    return [cell for cell in cells if cell.cell_type == "code"]


def execute(source: Path, check: bool = False, compare_bytes: bool = False) -> str:
    """Execute one chapter; return its problems, or ''."""
    # This process starts the kernel, which inherits its environment.
    os.environ.update(fixed_environment())
    started = time.perf_counter()
    notebook = read(source)
    try:
        run(notebook, source.parent)
    except CellExecutionError as error:
        return f"{source.stem}: a cell failed\n{error}"
    problems = complaints(notebook)
    if problems:
        return "\n".join([f"{source.stem}: outputs that cannot be stored", *problems])
    text = dump(notebook)
    target = source.with_suffix(".ipynb")
    if check:
        if not target.is_file():
            return f"{target.name}: not stored yet: make outputs"
        difference = unlike(target.read_text(encoding="utf-8"), text, compare_bytes)
        if difference:
            return f"{target.name}: {difference}"
    else:
        # Line ends are the same on every system.
        target.write_text(text, encoding="utf-8", newline="\n")
    print(f"{source.stem}: {time.perf_counter() - started:.1f} s", flush=True)
    return ""


def copy_sources(source: Path) -> str:
    """Copy the Markdown's cells to the stored notebook, whose outputs stay; return problems."""
    target = source.with_suffix(".ipynb")
    fresh = read(source)
    stored = nbformat.read(target, as_version=4)
    # Outputs can be kept only if they belong to the same cells.
    if [c.cell_type for c in fresh.cells] != [c.cell_type for c in stored.cells]:
        return f"{target.name}: has other cells than the Markdown: make outputs"
    for new, old in zip(fresh.cells, stored.cells, strict=True):
        if new.cell_type == "code":
            # The code may have changed by a name only; the caller knows that.
            new.outputs = old.outputs
            new.execution_count = old.execution_count
            shrink_pictures(new.outputs)
    if "widgets" in stored.metadata:
        fresh.metadata["widgets"] = stored.metadata["widgets"]
    target.write_text(dump(fresh), encoding="utf-8", newline="\n")
    return ""


def main() -> int:
    parser = argparse.ArgumentParser(
        description="Execute chapters and store their outputs."
    )
    parser.add_argument("chapters", nargs="*", help="names or numbers; all without one")
    parser.add_argument("--check", action="store_true", help="compare, write nothing")
    parser.add_argument(
        "--bytes", action="store_true", help="compare the bytes of pictures too"
    )
    parser.add_argument(
        "--sources", action="store_true", help="run nothing, keep the outputs"
    )
    parser.add_argument("--jobs", type=int, default=2, help="chapters at a time")
    options = parser.parse_args()
    sources = chosen(options.chapters)
    if options.sources:
        problems = [copy_sources(source) for source in sources]
    else:
        end_with_children()
        # A kernel is a process of its own, so a thread is enough to wait for it. No process is
        # forked: a fork copies locks that other threads hold, and may wait for them forever.
        with ThreadPoolExecutor(max_workers=options.jobs) as pool:
            n = len(sources)
            compare_bytes = [options.bytes] * n
            problems = list(
                pool.map(
                    execute,
                    sources,
                    [options.check or options.bytes] * n,
                    compare_bytes,
                )
            )
    for problem in filter(None, problems):
        print(problem, file=sys.stderr)
    if not sources:
        print(f"{ROOT.name}: the table of contents has no chapter", file=sys.stderr)
    # No chapter at all is a fault too: nothing was checked.
    return int(any(problems) or not sources)


if __name__ == "__main__":
    sys.exit(main())
