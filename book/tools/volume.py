"""Write the whole book as one PDF, or as one EPUB, from its built pages.

    python book/tools/volume.py pdf
    python book/tools/volume.py epub

A headless Chromium sets the formulas and the pages, so that only a browser is needed. Sliders are
still pictures, folded code is left out, and the solutions of all exercises are at the end. The API
reference and the gallery are left out. A missing chapter, or anything wider than the paper, is an
error.
"""

from __future__ import annotations

import base64
import datetime
import html
import posixpath
import re
import sys
import tempfile
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import yaml
from bs4 import BeautifulSoup, Tag

import distfilt
import epub
from browser import READY, chromium
from common import ROOT, toc_pages

BUILT = ROOT / "_build" / "html"
TARGET = BUILT / "book"
NAME = "distributed-nonlinear-filtering"
TITLE = "Distributed Nonlinear Filtering"
AUTHOR = "The distfilt authors"
STYLE = Path(__file__).with_name("volume.css")
LEFT_OUT = "book/api", "book/gallery"
"""Pages of the site only: long to print, and made for searching."""
GONE = (
    "script, style, .headerlink, .notebook, .frames-controls, p:has(> a.sd-btn), "
    "details.above-input, details > summary, .pst-copy, button, input"
)
"""Elements that make sense on a screen only."""

# Text that is too wide for the column gets a smaller font, down to six tenths.
FIT = r"""
const shrink = (part, wide) => {
  for (let k = 0, size = 1; k < 8 && size > 0.6; k++) {
    const over = wide();
    if (over <= 1.001) return;
    size = Math.max(0.6, size / over - 0.004);
    part.style.fontSize = `calc(${part.dataset.size} * ${size})`;
  }
};
for (const part of document.querySelectorAll("pre, table, div.math")) {
  part.dataset.size = getComputedStyle(part).fontSize;
  if (part.matches("pre")) shrink(part, () => part.scrollWidth / part.clientWidth);
  else if (part.matches("table"))
    shrink(part, () => part.offsetWidth / part.parentElement.clientWidth);
  else if (part.matches("div.math")) {
    const held = part.querySelector("mjx-container"), inner = part.querySelector("mjx-math");
    if (inner) shrink(part, () => inner.getBoundingClientRect().width / held.clientWidth);
  }
}
"""
# Elements that are wider or higher than the paper, not set, or not drawn.
WRONG = r"""
const body = document.body.getBoundingClientRect(), found = [];
const name = (e) => `${e.tagName.toLowerCase()} in ${e.closest("section.part")?.id}: `
  + (e.closest("div.math, pre, table") || e).textContent.trim().slice(0, 60);
for (const e of document.querySelectorAll("section.part *")) {
  const box = e.getBoundingClientRect();
  if (!box.width || e.closest("svg, mjx-math, mjx-assistive-mml") && !e.matches("svg, mjx-math"))
    continue;
  if (box.right > body.right + 2 || box.left < body.left - 2) found.push("too wide: " + name(e));
}
for (const e of document.querySelectorAll("pre"))
  if (e.scrollWidth > e.clientWidth + 1) found.push("cut: " + name(e));
for (const e of document.querySelectorAll("img")) {
  if (!e.naturalWidth) found.push("not drawn: " + name(e) + e.src);
  if (e.getBoundingClientRect().height > 860) found.push("too high: " + name(e) + e.src);
}
for (const e of document.querySelectorAll(".math"))
  if (!e.querySelector("mjx-container")) found.push("not set: " + name(e));
for (const e of document.querySelectorAll("mjx-merror, [data-mml-node=merror]"))
  found.push("no formula: " + name(e));
return [...new Set(found)];
"""

# The table of contents shows the page of each section.
NUMBER = """
for (const line of document.querySelectorAll(".contents li:has(a)"))
  line.querySelector("b").textContent = arguments[0][line.querySelector("a").hash.slice(1)];
"""


def key(page: str, name: str = "") -> str:
    """Return the id in the whole book of an id of one page."""
    # A page's ids get its name as a prefix, since ids of two pages may be equal.
    stem = page.removeprefix("book/").replace("/", "-")
    return f"p{stem}" + (f"--{re.sub(r'[^A-Za-z0-9_.-]', '-', name)}" if name else "")


def book_pages() -> list[str]:
    """Return the pages of the whole book, in reading order."""
    return [page for page in toc_pages() if not page.startswith(LEFT_OUT)]


def article(page: str, pages: list[str]) -> tuple[Tag, list[Tag]]:
    """Return the text of a page for the book, and its solutions."""
    path = BUILT / f"{page}.html"
    if not path.is_file():
        sys.exit(f"{path.relative_to(ROOT)} is not built: make book")
    soup = BeautifulSoup(path.read_text(encoding="utf-8"), "html.parser")
    text = soup.select_one("article.bd-article")
    assert text is not None, page
    for part in text.select(GONE):
        part.decompose()
    # Folded parts are open in print.
    for part in text.select("details"):
        part.unwrap()
    # Ids of all pages are in one document: make them unique by the page's name.
    for node in text.find_all(id=True):
        node["id"] = key(page, str(node["id"]))
    # Links of the site lead to places of the same document.
    for link in text.find_all("a", href=True):
        lead(link, page, pages)
    # Relative addresses mean nothing in the assembled file; lazy loading would print
    # blanks.
    for picture in text.find_all("img"):
        picture["src"] = (path.parent / unquote(str(picture["src"]))).resolve().as_uri()
        del picture["loading"]
    # A long table may be split between pages.
    for table in text.find_all("table"):
        if len(table.find_all("tr")) > 14:
            table["class"] = [*table.get("class", []), "long"]
    # Every page becomes a part that begins on a new sheet.
    text.name = "section"
    text.attrs = {"class": ["part"], "id": key(page)}
    return text, [solution.extract() for solution in text.select(".solution")]


def lead(link: Tag, page: str, pages: list[str]) -> None:
    """Redirect a link to its place in the book; a link to a page that is left out becomes text."""
    where, _, name = str(link["href"]).partition("#")
    # An address outside, such as https:
    if re.match(r"\w+:", where):
        return
    path = posixpath.normpath(posixpath.join(posixpath.dirname(page), where))
    target = path.removesuffix(".html") if where else page
    if target in pages:
        link["href"] = "#" + key(target, unquote(name))
    else:
        link.unwrap()


def assemble() -> tuple[str, list[str]]:
    """Return the whole book as one page, and its chapters' names."""
    pages = book_pages()
    parts = []
    solution_texts = []
    captions = {}
    for group in yaml.safe_load((ROOT / "_toc.yml").read_text(encoding="utf-8"))[
        "parts"
    ]:
        # A group's caption stands before its first chapter.
        captions[group["chapters"][0]["file"]] = group["caption"]
    contents_lines = []
    for page in pages:
        text, solutions = article(page, pages)
        parts.append(str(text))
        if page in captions:
            contents_lines.append(
                f'<li class="group">{html.escape(captions[page])}</li>'
            )
        contents_lines += entries(text)
        if solutions:
            # Solutions are collected at the end, below the titles of their chapters.
            title = text.find("h1").get_text()  # type: ignore[union-attr]
            solution_texts += [
                f'<h2 id="{key(page, "solutions")}">{html.escape(title)}</h2>',
                *map(str, solutions),
            ]
    parts.append(
        f'<section class="part" id="psolutions"><h1>Solutions</h1>{"".join(solution_texts)}</section>'
    )
    contents_lines += entries(BeautifulSoup(parts[-1], "html.parser").section)
    html_text = "".join(
        (BUILT / f"{page}.html").read_text(encoding="utf-8") for page in pages
    )
    # The settings of the pages hold for the whole book.
    # All pages have the same settings of MathJax.
    config = re.search(r"<script>(window\.MathJax = .*?)</script>", html_text)
    assert config is not None, "pages have no mathematics"
    mathjax = (BUILT / "_static" / "mathjax" / "tex-mml-chtml.js").as_uri()
    now = datetime.date.today().isoformat()
    head = f"""<!doctype html><html lang="en" data-theme="light"><head>
<meta charset="utf-8"><title>{TITLE}</title>
<link rel="stylesheet" href="{(BUILT / "_static" / "pygments.css").as_uri()}">
<style>{STYLE.read_text(encoding="utf-8")}</style>
<script>{config[1]}; window.MathJax.options.menuOptions =
  {{settings: {{assistiveMml: false}}}};</script>
<script defer src="{mathjax}"></script></head><body class="tex2jax_ignore mathjax_ignore">"""
    front = f"""<section class="front"><p class="title">{TITLE}</p><p>{AUTHOR}, edition
{distfilt.__version__}, printed {now}.</p><p class="note">Sliders of the pages are still pictures
here. Folded code, the API reference and the gallery are on the pages and in the
notebooks.</p></section>"""
    contents = f'<section class="part contents"><h1>Contents</h1><ol>{"".join(contents_lines)}</ol></section>'
    return "\n".join([head, front, contents, *parts, "</body></html>"]), [
        *pages,
        "solutions",
    ]


def entries(text: Any) -> list[str]:
    """Return the lines of the contents for one part: its title, and its sections."""
    lines = []
    for head in text.find_all(["h1", "h2"]):
        # Sphinx puts the id of a section on the element around its heading.
        place = (
            text["id"]
            if head.name == "h1"
            else (head.get("id") or head.parent.get("id"))
        )
        kind = "chapter" if head.name == "h1" else "below"
        words = head.decode_contents().strip()
        lines.append(
            f'<li class="{kind}"><a href="#{place}">{words}</a><i></i><b></b></li>'
        )
    return lines


def pages_of(pdf: bytes) -> dict[str, int]:
    """Return the page of each place that a link of a PDF by Chromium leads to."""
    # Chromium writes a PDF without compressed objects, so that a pattern finds them.
    objects = dict(
        re.findall(rb"(?:^|\n)(\d+) 0 obj\n(.*?)\nendobj", pdf, flags=re.DOTALL)
    )

    def leaves(number: bytes) -> list[bytes]:
        below = re.search(rb"/Kids\s*\[(.*?)\]", objects[number], flags=re.DOTALL)
        kids = re.findall(rb"(\d+) 0 R", below[1]) if below else []
        return [leaf for kid in kids for leaf in leaves(kid)] if below else [number]

    # The catalog leads to the tree of pages, whose leaves are the pages in order.
    root = next(n for n, text in objects.items() if b"/Type /Catalog" in text)
    top = re.search(rb"/Pages (\d+) 0 R", objects[root])
    assert top is not None, "a PDF without pages"
    order = {number: k + 1 for k, number in enumerate(leaves(top[1]))}
    # Named destinations: /name [page 0 R /XYZ ...]
    places = re.findall(
        rb"/([^\s/\[\]<>()]+)\s*\[(\d+) 0 R\s*/XYZ", b"\n".join(objects.values())
    )
    return {name.decode(): order[number] for name, number in places}


def print_page(driver: Any) -> bytes:
    """Return the open page as a PDF."""
    foot = (
        '<div style="font: 8px sans-serif; width: 100%; text-align: center">'
        '<span class="pageNumber"></span></div>'
    )
    # The size of the sheet comes from the style (@page); the foot has the number.
    answer = driver.execute_cdp_cmd(
        "Page.printToPDF",
        {
            "preferCSSPageSize": True,
            "printBackground": True,
            "displayHeaderFooter": True,
            "headerTemplate": "<span></span>",
            "footerTemplate": foot,
            "generateDocumentOutline": True,
            "generateTaggedPDF": True,
        },
    )
    return base64.b64decode(answer["data"])


def open_page(driver: Any, page: Path) -> None:
    """Open the assembled page and set it; exit if something does not fit."""
    # Setting all formulas of the book takes minutes.
    driver.command_executor.client_config.timeout = 1800
    driver.set_script_timeout(1700)
    driver.set_page_load_timeout(1700)
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    # Wider than the text of a sheet, so that the window does not limit it.
    driver.set_window_size(900, 1000)
    driver.get(page.as_uri())
    # Sizes are final only after formulas and pictures are there.
    driver.execute_async_script(READY)
    driver.execute_script(FIT)
    problems = driver.execute_script(WRONG)
    if problems:
        sys.exit("\n".join(["the book does not fit its paper:", *problems]))


def pdf(driver: Any, parts: list[str]) -> bytes:
    """Return the book as a PDF, printed twice: the first gives the page numbers of the contents."""
    places = pages_of(print_page(driver))
    # Every part must begin on a page of its own, in order.
    starts = [places[part] for part in parts if part in places]
    if len(starts) != len(parts) or starts != sorted(set(starts)):
        sys.exit(
            f"the PDF has not every chapter: {dict(zip(parts, starts, strict=False))}"
        )
    # Numbers stand at the ends of lines, so that the second print has the same pages.
    driver.execute_script(NUMBER, places)
    return print_page(driver)


def main() -> int:
    if len(sys.argv) != 2 or sys.argv[1] not in ("pdf", "epub"):
        sys.exit(__doc__)
    text, names = assemble()
    target = TARGET / f"{NAME}.{sys.argv[1]}"
    with (
        tempfile.TemporaryDirectory() as folder,
        chromium(Path(folder) / "profile") as driver,
    ):
        page = Path(folder) / "book.html"
        page.write_text(text, encoding="utf-8")
        open_page(driver, page)
        parts = [key(name) for name in names]
        if sys.argv[1] == "pdf":
            target.write_bytes(pdf(driver, parts))
        else:
            colours = (BUILT / "_static" / "pygments.css").read_text(encoding="utf-8")
            # A reader's paper is white: only the light colours of code are needed.
            light = re.findall(
                r'^html\[data-theme="light"\] .*', colours, flags=re.MULTILINE
            )
            about = {"title": TITLE, "author": AUTHOR, "version": distfilt.__version__}
            epub.write(driver, target, parts, about, "\n".join(light))
    offer(target)
    print(f"The book: {target}, {target.stat().st_size / 1e6:.1f} MB")
    return 0


def offer(target: Path) -> None:
    """Link the name of a file on the first page to the file."""
    first = TARGET / "index.html"
    name = re.escape(target.name)
    # The first page names the file as code; after this it is a link.
    mention = re.compile(rf'<code[^>]*><span class="pre">{name}</span></code>')
    text = first.read_text(encoding="utf-8")
    first.write_text(
        mention.sub(f'<a href="{target.name}">{target.name}</a>', text),
        encoding="utf-8",
    )


if __name__ == "__main__":
    sys.exit(main())
