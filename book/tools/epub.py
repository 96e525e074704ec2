"""Write an EPUB from an open page: a file for each part, formulas as MathML, pictures as PNG."""

from __future__ import annotations

import datetime
import html
import io
import re
import uuid
import zipfile
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from PIL import Image

# Formulas as MathML, which EPUB readers set themselves. Font sizes that fit paper are removed.
MATHML = r"""
for (const item of MathJax.startup.document.math) {
  const text = MathJax.startup.toMML(item.root).replace(/ data-[\w-]+="[^"]*"/g, "");
  const tree = new DOMParser().parseFromString(text, "application/xml").documentElement;
  tree.setAttribute("alttext", item.math.trim());
  item.typesetRoot.replaceWith(document.importNode(tree, true));
}
document.querySelectorAll("body [style]").forEach((e) => e.removeAttribute("style"));
document.querySelectorAll("svg[role]").forEach((e) => e.removeAttribute("role"));
document.querySelectorAll("[data-size]").forEach((e) => e.removeAttribute("data-size"));
"""
# One part as XHTML, with its title and the titles below it, each with its anchor.
PART = """
const part = document.getElementById(arguments[0]);
const place = (e) => (e.tagName === "H1" ? part : e.id ? e : e.closest("[id]")).id;
return [new XMLSerializer().serializeToString(part),
        [...part.querySelectorAll("h1, h2")].map(e => [place(e), e.textContent.trim()])];
"""
CONTAINER = """<?xml version="1.0"?>
<container version="1.0" xmlns="urn:oasis:names:tc:opendocument:xmlns:container"><rootfiles>
<rootfile full-path="OEBPS/book.opf" media-type="application/oebps-package+xml"/>
</rootfiles></container>"""
PAGE = """<?xml version="1.0" encoding="utf-8"?>
<!DOCTYPE html>
<html xmlns="http://www.w3.org/1999/xhtml" xmlns:epub="http://www.idpf.org/2007/ops" lang="en"
xml:lang="en" data-theme="light"><head><title>{title}</title>
<link rel="stylesheet" type="text/css" href="style.css"/></head><body>{text}</body></html>"""
PACKAGE = """<?xml version="1.0" encoding="utf-8"?>
<package xmlns="http://www.idpf.org/2007/opf" version="3.0" unique-identifier="id" xml:lang="en">
<metadata xmlns:dc="http://purl.org/dc/elements/1.1/">
<dc:identifier id="id">urn:uuid:{who}</dc:identifier><dc:title>{title}</dc:title>
<dc:creator>{author}</dc:creator><dc:language>en</dc:language>
<meta property="dcterms:modified">{now}</meta></metadata>
<manifest>{items}</manifest><spine>{spine}</spine></package>"""
STYLE = """
body { line-height: 1.45; }
img, svg { max-width: 100%; height: auto; }
pre { font-size: 0.7em; white-space: pre-wrap; overflow-wrap: anywhere; }
code { overflow-wrap: anywhere; }
table { border-collapse: collapse; font-size: 0.8em; }
th, td { border-bottom: 1px solid #ccc; padding: 0.1em 0.4em; text-align: start; }
div.math { overflow-x: auto; margin: 0.6em 0; }
.eqno { float: right; }
.admonition { border-left: 0.2em solid #27506e; padding-left: 0.8em; margin: 0.8em 0; }
.admonition-title { font-weight: bold; }
figcaption { font-size: 0.9em; }
"""
XHTML = 'media-type="application/xhtml+xml"'


def write(
    driver: Any, target: Path, parts: list[str], about: dict[str, str], style: str
) -> None:
    """Write an EPUB of the parts of the open page with these ids, in that order."""
    driver.execute_script(MATHML)
    texts = {}
    heads = {}
    for part in parts:
        texts[part], heads[part] = driver.execute_script(PART, part)
    # A link "#id" leads into one page of the site, but into one of many files here.
    home = {
        i: part
        for part, text in texts.items()
        for i in re.findall(r' id="([^"]+)"', text)
    }
    pictures: dict[str, str] = {}

    def place(found: re.Match[str]) -> str:
        return f'href="{home[found[1]]}.xhtml#{found[1]}"'

    def picture(found: re.Match[str]) -> str:
        name = pictures.setdefault(found[1], f"images/{len(pictures) + 1:03}.png")
        return f'src="{name}"'

    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as book:
        # The format wants this file first, without compression.
        book.writestr("mimetype", "application/epub+zip", zipfile.ZIP_STORED)
        book.writestr("META-INF/container.xml", CONTAINER)
        for part, text in texts.items():
            # The page's own addresses become those of the files in the archive.
            text = re.sub(r'href="#([^"]+)"', place, text)
            text = re.sub(r'src="(file:[^"]+)"', picture, text)
            title = html.escape(heads[part][0][1])
            book.writestr(f"OEBPS/{part}.xhtml", PAGE.format(title=title, text=text))
        for uri, name in pictures.items():
            content = io.BytesIO()
            with Image.open(unquote(uri.removeprefix("file://"))) as image:
                # Older readers do not show WebP.
                image.convert("RGB").save(content, format="png", optimize=True)
            book.writestr(f"OEBPS/{name}", content.getvalue(), zipfile.ZIP_STORED)
        book.writestr("OEBPS/style.css", STYLE + style)
        book.writestr("OEBPS/nav.xhtml", navigation(heads))
        book.writestr("OEBPS/book.opf", package(texts, list(pictures.values()), about))


def navigation(heads: dict[str, list[tuple[str, str]]]) -> str:
    """Return the table of contents: each part and its sections."""
    lines = []
    for part, titles in heads.items():
        links = []
        # The first link leads to the part, the others to its sections.
        for place, words in titles:
            address = f"{part}.xhtml#{place}"
            links.append(f'<a href="{address}">{html.escape(words)}</a>')
        sections = "".join(f"<li>{link}</li>" for link in links[1:])
        nested = f"<ol>{sections}</ol>" if sections else ""
        lines.append(f"<li>{links[0]}{nested}</li>")
    text = f'<nav epub:type="toc"><h1>Contents</h1><ol>{"".join(lines)}</ol></nav>'
    return PAGE.format(title="Contents", text=text)


def package(texts: dict[str, str], pictures: list[str], about: dict[str, str]) -> str:
    """Return the manifest of the EPUB, with its files in reading order."""
    items = [
        f'<item id="nav" href="nav.xhtml" {XHTML} properties="nav"/>',
        '<item id="style" href="style.css" media-type="text/css"/>',
    ]
    for part, text in texts.items():
        # A reader must be told which files have formulas or drawings.
        properties = [
            word for word, tag in (("mathml", "<math"), ("svg", "<svg")) if tag in text
        ]
        attribute = f' properties="{" ".join(properties)}"' if properties else ""
        items += [f'<item id="{part}" href="{part}.xhtml" {XHTML}{attribute}/>']
    for k, name in enumerate(pictures):
        items += [f'<item id="picture-{k}" href="{name}" media-type="image/png"/>']
    # The spine is the order of reading.
    spine = "".join(f'<itemref idref="{part}"/>' for part in ("nav", *texts))
    now = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    # The same edition gets the same identifier in every build.
    identifier = uuid.uuid5(uuid.NAMESPACE_URL, f"{about['title']} {about['version']}")
    return PACKAGE.format(
        who=identifier, now=now, items="".join(items), spine=spine, **about
    )
