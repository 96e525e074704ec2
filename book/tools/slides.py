"""Write the pictures for a lecture: those of all cells with the tag ``slide``.

    python book/tools/slides.py [FOLDER]

The folder (`_build/slides`) then has one PNG for each picture and one page with all of them, in the
order of the book and with their captions.
"""

from __future__ import annotations

import base64
import html
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import nbformat

from common import ROOT, chapters

HEAD = """<!doctype html><html lang="en"><meta charset="utf-8">
<title>Pictures for lectures</title>
<style>figure { page-break-after: always; max-width: 60em; margin: 2em auto; }
img { width: 100%; } figcaption { font: 1.1em sans-serif; }</style>
"""


class Slide(NamedTuple):
    """A picture of a chapter."""

    name: str
    caption: str
    png: bytes


def find_slides(source: Path) -> Iterator[Slide]:
    """Yield the pictures of a chapter's tagged cells, from its stored outputs."""
    notebook = nbformat.read(source.with_suffix(".ipynb"), as_version=4)
    for cell in notebook.cells:
        if "slide" not in cell.metadata.get("tags", ()):
            continue
        figure = cell.metadata.get("mystnb", {}).get("figure", {})
        pictures = [
            output.data["image/png"]
            for output in cell.get("outputs", ())
            if "image/png" in output.get("data", {})
        ]
        if not pictures:
            sys.exit(f"{source.name}: a cell with the tag slide has no picture")
        name = f"{source.stem.split('-')[0]}-{figure.get('name', 'figure')}"
        yield Slide(name, figure.get("caption", ""), base64.b64decode(pictures[0]))


def main() -> int:
    folder = Path(sys.argv[1]) if sys.argv[1:] else ROOT / "_build" / "slides"
    folder.mkdir(parents=True, exist_ok=True)
    page = [HEAD]
    for source in chapters():
        for slide in find_slides(source):
            (folder / f"{slide.name}.png").write_bytes(slide.png)
            caption = html.escape(slide.caption)
            page.append(
                f'<figure><img src="{slide.name}.png" alt="{caption}">'
                f"<figcaption>{caption}</figcaption></figure>\n"
            )
    (folder / "index.html").write_text("".join(page), encoding="utf-8")
    print(f"{len(page) - 1} pictures: {folder / 'index.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
