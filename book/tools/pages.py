"""What the build computes: chapter numbers, the API page's list, the page of reproductions."""

from __future__ import annotations

import importlib
import inspect
import re
import types
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import numpy as np
from docutils import nodes
from sphinx.pycode import ModuleAnalyzer

from bookkit.rows import read_rows
from common import ROOT, SLIDER, toc_pages
from ledger import ITEMS, LEDGER, WORDS, summaries

PAPERS = {
    "grange": "Triangular transport maps",
    "das": "Constrained optimal transport",
    "semeraro": "Partial-state fusion",
    "zheng": "Distributed density filter",
}


def chapter_number(page: str) -> int | None:
    """Return the number that a chapter's file name starts with."""
    found = re.match(r"book/(\d+)-", page)
    return int(found.group(1)) if found else None


def drop_widgets(tree: nodes.document) -> None:
    """Remove what is left of a widget without its script: a line that names its parts."""
    for node in list(tree.findall(nodes.literal_block)):
        if node.astext().startswith("interactive(children="):
            node.parent.remove(node)


def keep_sliders(tree: nodes.document) -> None:
    """Show a picture that moves in the place of its first frame, under the figure's caption.

    An output with a slider also holds that frame as a PNG, which the notebook's figure options
    (caption, name, number) are put around. The slider's HTML takes the PNG's place there.
    """
    bundles = [
        node
        for node in tree.findall(nodes.container)
        if node.get("nb_element") == "mime_bundle"
    ]
    for bundle in bundles:
        parts = {part.get("mime_type"): part for part in bundle.children}
        page, picture = parts.get("text/html"), parts.get("image/png")
        if page is None or picture is None:
            continue
        raw = next((n for n in page.findall(nodes.raw) if SLIDER in n.astext()), None)
        image = next(iter(picture.findall(nodes.image)), None)
        if raw is not None and image is not None:
            image.parent.replace(image, raw.deepcopy())
            bundle.remove(page)


def number_chapters(env: Any, number_of: Any) -> None:
    """Give each chapter the number of its file name, whichever chapters exist.

    Sphinx counts the chapters that it finds; then equation (4.1) would be renumbered when
    chapters 2 and 3 appear.
    """
    for page, sections in env.toc_secnumbers.items():
        number = number_of(page)
        if number is None:
            continue
        for anchor, old in sections.items():
            sections[anchor] = (number, *old[1:]) if old else old
        marked = [env.titles[page], *env.tocs[page].findall(nodes.reference)]
        for node in marked:
            if old := node.get("secnumber"):
                node["secnumber"] = [number, *old[1:]]


def modules() -> list[str]:
    """Return every module of the library, the package first."""
    root = ROOT / "distfilt"
    shown = (p for p in root.rglob("*.py") if p.stem == "__init__" or p.stem[0] != "_")
    paths = sorted(shown)
    names = [p.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".") for p in paths]
    return sorted(name.removesuffix(".__init__") for name in names)


def directive(module: Any, name: str) -> list[str]:
    """Return the lines that document one public name of the module that defines it."""
    value = getattr(module, name)
    if get_origin(value) is not None:
        meaning = ModuleAnalyzer.for_module(module.__name__).find_attr_docs().get(("", name), [])
        base, *notes = get_args(value) if get_origin(value) is Annotated else (value,)
        kind = "np.ndarray" if get_origin(base) is np.ndarray else getattr(base, "__name__", base)
        shown = ", ".join(str(getattr(note, "__name__", note)) for note in (kind, *notes))
        text = [f"   {line}" for line in [*meaning, "", f"The type ``{shown}``."]]
        return [f".. py:data:: {name}", "", *text, ""]
    if inspect.isclass(value) and not value.__module__.startswith("distfilt"):
        text = f"Short for ``{value.__module__}.{value.__qualname__}``."
        return [f".. py:data:: {name}", "", f"   {text}", ""]
    if inspect.isclass(value):
        return [f".. autoclass:: {module.__name__}.{name}", "   :members:", ""]
    if inspect.isfunction(value):
        return [f".. autofunction:: {module.__name__}.{name}", ""]
    return [f".. autodata:: {module.__name__}.{name}", "   :no-value:", ""]


def home_of(module: Any, name: str) -> str:
    """Return the module that defines a public name, which packages hand on."""
    value = getattr(module, name)
    if isinstance(value, types.ModuleType):
        return value.__name__
    home = str(getattr(value, "__module__", "") or "")
    own = home.startswith("distfilt") and hasattr(value, "__qualname__")
    if own:
        return home
    # A constant does not know where it is from: the module below that shows the same one.
    below = [n for n in modules() if n.startswith(f"{module.__name__}.")]
    found = (n for n in below if vars(importlib.import_module(n)).get(name) is value)
    shown = (n for n in found if name in importlib.import_module(n).__all__)
    return next(shown, module.__name__)


def plain_types(signature: str | None) -> str | None:
    """Return a signature without the builder's own word around the names of our types."""
    return signature and re.sub(r"TypeAliasForwardRef\('([\w.]+)'\)", r"\1", signature)


def escape_stars(lines: list[str]) -> None:
    """Escape the star of a shape such as ``(*runs, N, d)``, which is no emphasis."""
    for k, line in enumerate(lines):
        if not line.lstrip().startswith((">>>", "...")):
            parts = line.split("``")
            parts[::2] = [re.sub(r"(?<=[(\s])\*(?=\w+[,)])", r"\\*", part) for part in parts[::2]]
            lines[k] = "``".join(parts)


def summary(module: Any) -> str:
    """Return the first sentence of a module's text."""
    first = (inspect.getdoc(module) or "").split("\n\n")[0].replace("\n", " ")
    return cell(first)


FIRST = ("filters", "updates", "network", "sensors", "models", "metrics", "kalman", "triangular")
"""What a reader looks for first; the other parts follow in alphabetical order."""


def parts() -> dict[str, list[str]]:
    """Return the library's parts in the order of the page, each with its modules."""
    found: dict[str, list[str]] = {}
    for name in modules():
        if name != "distfilt":
            found.setdefault(name.split(".")[1], []).append(name)
    order = [*(p for p in FIRST if p in found), *sorted(p for p in found if p not in FIRST)]
    return {part: found[part] for part in order}


def anchor(name: str) -> str:
    """Return the label of a module's section."""
    return "api-" + name.replace(".", "-").replace("_", "-")


def links(module: Any) -> str:
    """Return links to what a part's face offers, in the order of its names."""
    out = []
    for name in module.__all__:
        home, value = home_of(module, name), getattr(module, name)
        if isinstance(value, types.ModuleType):
            out.append(f"[`{name}`](#{anchor(home)})")
        else:
            out.append("{py:obj}`" + f"{name} <{home}.{name}>`")
    return ", ".join(out)


def api_text() -> str:
    """Return the API reference: an index of one screen, then part by part what each module has."""
    index, lines = ["| Part | What it is for | Names |", "|---|---|---|"], []
    for part, names in parts().items():
        face = importlib.import_module(f"distfilt.{part}")
        head = f"distfilt.{part}"
        index += [f"| [`{part}`](#{anchor(head)}) | {summary(face)} | {links(face)} |"]
        lines += [f"({anchor(head)})=", f"## `{head}`", ""]
        for name in names:
            module = importlib.import_module(name)
            own = [n for n in module.__all__ if home_of(module, n) == name]
            if name != head:
                lines += [f"({anchor(name)})=", f"### `{name}`", ""]
            body = [f".. automodule:: {name}", "   :no-members:", ""]
            for public in own:
                body += directive(module, public)
            lines += ["```{eval-rst}", *body, "```", ""]
    return "\n".join([*index, "", *lines])


def cell(text: str) -> str:
    """Return a text that fits a cell of a Markdown table."""
    return text.replace("|", r"\|").replace("\n", " ") or "–"


def chapter_link(chapter: str) -> str:
    """Return a link to a chapter that exists, or its number."""
    page = f"book/{chapter}"
    number = chapter_number(page)
    label = chapter if number is None else str(number)
    return f"[{label}](/{page})" if page in toc_pages() else label


def reproductions_text() -> str:
    """Return the count of verdicts and one table for each paper."""
    titles = {(item["paper"], item["item"]): item["title"] for item in read_rows(ITEMS)}
    rows = read_rows(LEDGER)
    lines = []
    for kind, (total, counts) in summaries(rows).items():
        shown = ", ".join(f"{n} *{verdict}*" for verdict, n in counts.items())
        lines += [f"Of {total} {WORDS[kind]}: {shown}.", ""]
    for paper in dict.fromkeys(row["paper"] for row in rows):
        lines += [f"## {PAPERS.get(paper, paper)} (`{paper}`)", ""]
        lines += ["| Item | Shows | Chapter | Verdict | Ours | Published | Why |"]
        lines += ["|---|---|---|---|---|---|---|"]
        for row in (r for r in rows if r["paper"] == paper):
            cells = [row["item"].replace(" ", "\u00a0"), cell(titles[paper, row["item"]])]
            cells += [chapter_link(row["chapter"])]
            beside = {"ours": "", "null": "<br>*If false:* ", "range": "<br>*Range:* "}
            ours = "".join(f"{word}{cell(row[n])}" for n, word in beside.items() if row[n])
            cells += [row["verdict"], ours or cell(""), cell(row["published"]), cell(row["why"])]
            lines += ["| " + " | ".join(cells) + " |"]
        lines += [""]
    return "\n".join(lines)


def write_generated(folder: Path) -> None:
    """Write the included parts of pages; an unchanged part keeps its date."""
    folder.mkdir(exist_ok=True)
    parts = {"api.md": api_text()}
    if ITEMS.is_file() and LEDGER.is_file():
        parts["reproductions.md"] = reproductions_text()
    for name, text in parts.items():
        target = folder / name
        if not target.is_file() or target.read_text(encoding="utf-8") != text:
            target.write_text(text, encoding="utf-8")
