"""The built book: every page exists, and every public name is documented."""

from __future__ import annotations

import html
import importlib
import re
import runpy
from pathlib import Path
from unittest.mock import MagicMock, call

import pytest
from sphinx.environment.collectors.toctree import TocTreeCollector
from sphinx.errors import ExtensionError

import common
from bookkit.rows import read_rows
from common import ROOT, chapters, missing_pages, toc_pages
from ledger import LEDGER, claims_of, summaries
from pages import api_parts, homes, modules

BUILT = ROOT / "_build" / "html"


def page(name: str) -> str:
    path = BUILT / f"{name}.html"
    assert path.is_file(), f"{name} is not built: make book"
    return path.read_text(encoding="utf-8")


def plain(text: str) -> str:
    """Return the text of a page without its tags and with plain spaces."""
    return html.unescape(re.sub(r"<[^>]+>", "", text)).replace("\u00a0", " ")


@pytest.mark.parametrize("name", toc_pages())
def test_page_of_the_contents_is_built(name: str) -> None:
    assert not missing_pages()
    assert "<h1>" in page(name)


@pytest.mark.parametrize("source", chapters(), ids=lambda source: source.stem)
def test_a_chapter_with_its_pictures_is_small(source: Path) -> None:
    # A browser loads the page and the pictures that it names.
    text = page(f"book/{source.stem}")
    pictures = set(re.findall(r"_images/[\w.-]+\.(?:png|webp|svg)", text))
    assert (
        len(text) + sum((BUILT / name).stat().st_size for name in pictures) <= 3_000_000
    )


def test_chapters_import_nothing_from_their_folder() -> None:
    """So a chapter runs from any folder; scripts come by `studies.script`."""
    # A notebook finds modules beside it only if it runs in the book's folder.
    local_names = {path.stem for path in (ROOT / "book").iterdir()}
    for source in chapters():
        text = source.read_text(encoding="utf-8")
        imported = set(
            re.findall(r"^\s*(?:from|import)\s+(\w+)", text, flags=re.MULTILINE)
        )
        assert not imported & local_names, (
            f"{source.stem} imports {imported & local_names}"
        )


def test_api_pages_are_small_and_document_every_public_name_once() -> None:
    texts = [page(f"book/api/{part}") for part in (*api_parts(), "families")]
    # One page for each part, small enough to load on a phone
    assert max(map(len, texts)) <= 500_000
    text = "".join(texts)
    assert "TypeAliasForwardRef" not in text
    assert " at 0x" not in text
    # A name with two entries would have two addresses.
    anchors = re.findall(r'<dt[^>]* id="(distfilt[^"]*)"', text)
    assert len(anchors) == len(set(anchors))
    public = set(homes().values()) - {*modules(), "distfilt.__version__"}
    assert len(public) > 50
    assert public <= set(anchors)


def test_api_page_is_an_index_and_chapters_and_names_lead_to_each_other() -> None:
    linked, used = (
        'class="api" href="api/updates.html#distfilt.updates',
        "Used in</em> chapter",
    )
    assert linked in page("book/03-triangular-maps")
    assert used in page("book/api/updates")
    text = page("book/api")
    index = text[text.index("<tbody") : text.index("</tbody>")]
    rows = re.findall(r"<tr.*?</tr>", index, flags=re.DOTALL)
    # One row for each part, the most needed ones first
    assert len(rows) == len(api_parts()) <= 24
    assert "filters" in plain(rows[0])
    assert "updates" in plain(rows[1])
    for part, row in zip(api_parts(), rows, strict=True):
        face = importlib.import_module(f"distfilt.{part}")
        assert all(name in plain(row) for name in face.__all__)


def test_page_of_reproductions_shows_the_ledger() -> None:
    text = page("book/reproductions")
    rows = read_rows(LEDGER)
    tables = re.findall(r"<table.*?</table>", text, flags=re.DOTALL)
    lines: dict[str, list[str]] = {"Item": [], "Claim": []}
    # Tables of items and tables of claims, each in the ledger's order
    for table in tables:
        head, body = table.split("<tbody>")
        kind = plain(head).split()[0]
        lines[kind] += re.findall(r"<tr.*?</tr>", body, flags=re.DOTALL)
    assert len(lines["Item"]) == len(rows) == 21
    for row, line in zip(rows, lines["Item"], strict=True):
        assert row["item"] in plain(line)
        assert row["verdict"] in plain(line)
    # One row a claim, with its own verdict
    claims = [claim for row in rows for claim in claims_of(row)]
    for claim, line in zip(claims, lines["Claim"], strict=True):
        assert ("holds" if claim.holds else "fails") in plain(line)
    # The sentence above the tables must give the same counts.
    for total, counts in summaries(rows).values():
        counted = ", ".join(f"{n} {verdict}" for verdict, n in counts.items())
        assert f"Of {total} " in plain(text)
        assert counted in plain(text)


def test_build_stops_at_a_missing_page(monkeypatch: pytest.MonkeyPatch) -> None:
    # A table of contents with a page that has no file
    monkeypatch.setattr(common, "toc_pages", lambda: ["book/nowhere"])
    monkeypatch.setattr(
        TocTreeCollector, "assign_figure_numbers", None
    )  # which setup changes
    app = MagicMock()
    conf = runpy.run_path(str(ROOT / "book" / "conf.py"))
    conf["setup"](app)
    assert call("builder-inited", conf["check_toc"]) in app.connect.mock_calls
    with pytest.raises(ExtensionError, match="book/nowhere"):
        conf["check_toc"](app)
