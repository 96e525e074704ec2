"""The whole book as one file: it has every chapter, and nothing is cut at the paper's edge."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
from test_browser import chromium

import volume
from common import chapters

BAD = """<body style="width: 174mm; margin: 0"><section class="part" id="p1"><pre>{}</pre>
<div style="width: 300mm">x</div><img src="nowhere.png" alt=""><p class="math">x</p></section>"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pdf", "epub"])
def test_the_whole_book_is_written(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["volume.py", kind])
    assert volume.main() == 0
    target = volume.TARGET / f"{volume.NAME}.{kind}"
    if kind == "epub":
        # In the EPUB a file, in the PDF a named place for each page of the book
        parts = {Path(name).stem for name in zipfile.ZipFile(target).namelist()}
    else:
        parts = set(volume.pages_of(target.read_bytes()))
    assert parts >= {volume.key(f"book/{source.stem}") for source in chapters()}
    assert target.name in (volume.TARGET / "index.html").read_text(encoding="utf-8")


def test_elements_that_do_not_fit_the_paper_are_rejected(tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    # A line of code, a block, a picture and a formula with one fault each
    page.write_text(BAD.format("x" * 300), encoding="utf-8")
    with chromium(tmp_path / "profile") as driver, pytest.raises(SystemExit) as error:
        volume.open_page(driver, page)
    assert all(
        f"\n{fault}: " in str(error.value)
        for fault in ("too wide", "cut", "not drawn", "not set")
    )
