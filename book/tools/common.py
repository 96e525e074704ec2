"""Common parts of the book's tools: folders, lists of pages, the environment of a chapter."""

from __future__ import annotations

import os
import re
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import yaml

from pictures import extract_pictures

ROOT = Path(__file__).resolve().parents[2]
BOOK = ROOT / "book"
SLIDER = 'class="frames"'
"""A mark in the HTML of a slider, which has its own alternative text."""
VERDICT = "application/vnd.distfilt.verdict+json"

# Home folders, kernel files, addresses in memory and progress bars differ on the next machine.
_FOREIGN = re.compile(
    r"/home/|/root/|/Users/|/tmp/|site-packages/|ipykernel_\d|\b0x[0-9a-f]{8,}|\[\d\d:\d\d<"
)


def fixed_environment() -> dict[str, str]:
    """Return the environment in which every chapter runs, on every machine.

    One BLAS thread and a fixed hash seed make results reproducible. The user's IPython profile and
    kernels are ignored. Progress bars, whose text depends on time, are off. A failed assertion
    stops the chapter.
    """
    home = ROOT / "_build" / "jupyter"
    (home / "ipython").mkdir(parents=True, exist_ok=True)
    # Later entries replace those of the caller's environment.
    return {
        **os.environ,
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "PYTHONHASHSEED": "0",
        "TQDM_DISABLE": "1",
        "BOOK_STRICT": "1",
        "IPYTHONDIR": str(home / "ipython"),
        "JUPYTER_CONFIG_DIR": str(home / "config"),
        "JUPYTER_PREFER_ENV_PATH": "1",
        "JUPYTER_PLATFORM_DIRS": "1",
        "MPLCONFIGDIR": os.environ.get("MPLCONFIGDIR", str(home / "matplotlib")),
        "PYDEVD_DISABLE_FILE_VALIDATION": "1",
    }


def end_with_children() -> None:
    """Let SIGTERM, such as that of a time limit, end this process with all that it started."""

    def end(number: int, frame: Any) -> None:
        # Kernels lead groups of their own, so a signal to this process's group would miss them.
        for child in psutil.Process().children(recursive=True):
            child.kill()
        os._exit(128 + number)

    signal.signal(signal.SIGTERM, end)


def toc_pages(toc: Path = ROOT / "_toc.yml") -> list[str]:
    """Return every page of the table of contents, without a suffix, in reading order."""

    def walk(node: Any) -> Iterator[str]:
        if isinstance(node, dict):
            for key, value in node.items():
                # Only these keys name pages; all others lead to lists of them.
                if key in ("root", "file"):
                    yield str(value).removesuffix(".md").removesuffix(".ipynb")
                else:
                    yield from walk(value)
        elif isinstance(node, list):
            for item in node:
                yield from walk(item)

    return list(walk(yaml.safe_load(toc.read_text(encoding="utf-8"))))


def missing_pages() -> list[str]:
    """Return the pages of the table of contents that have no file."""
    return [page for page in toc_pages() if not (ROOT / f"{page}.md").is_file()]


def is_chapter(source: Path) -> bool:
    """Return whether a Markdown page is a notebook: its header names a kernel."""
    text = source.read_text(encoding="utf-8")
    # The header of a page stands between two lines of dashes.
    header = text.split("\n---", 1)[0] if text.startswith("---") else ""
    return "kernelspec:" in header


def chapters() -> list[Path]:
    """Return the Markdown sources of the book's notebooks, in reading order."""
    sources = [ROOT / f"{page}.md" for page in toc_pages()]
    return [source for source in sources if source.is_file() and is_chapter(source)]


def chosen(names: list[str]) -> list[Path]:
    """Return the sources that the command line names (all chapters without a name)."""
    if not names:
        return chapters()
    paths = []
    for name in names:
        # A name is that of a chapter, or its beginning up to a hyphen: "04" is 04-…, not 04b-….
        matches = [
            c for c in chapters() if c.stem == name or c.stem.startswith(f"{name}-")
        ]
        # A file outside the table of contents may be given by its path.
        path = matches[0] if matches else Path(name).with_suffix(".md").resolve()
        if not path.is_file():
            sys.exit(
                f"{name}: no such chapter; _toc.yml has {[c.stem for c in chapters()]}"
            )
        paths.append(path)
    return paths


def output_texts(output: Any) -> Iterator[str]:
    """Yield every piece of text that an output stores, pictures left out."""
    yield output.get("text", "")
    yield output.get("evalue", "")
    yield from output.get("traceback", [])
    for mime, value in output.get("data", {}).items():
        # SVG is text, and may hold paths; frames inside HTML are pictures.
        if not mime.startswith("image/") or mime.endswith("svg+xml"):
            yield extract_pictures(value)[0] if isinstance(value, str) else repr(value)


def foreign_text(output: Any) -> str:
    """Return a piece of the output that belongs to one machine or one run, or ''."""
    # An output with a path of this machine would differ on the next one.
    local_paths = [str(ROOT), str(Path.home()), tempfile.gettempdir(), sys.prefix]
    for text in output_texts(output):
        match = _FOREIGN.search(text)
        if match:
            return match.group()
        for path in local_paths:
            # A home folder "/" is in every path.
            if len(path) > 1 and path in text:
                return path
    return ""
