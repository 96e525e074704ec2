"""Computed parts of the book: chapter numbers, API reference, map, gallery, reproductions."""

from __future__ import annotations

import ast
import base64
import functools
import importlib
import inspect
import io
import json
import re
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ForwardRef, Literal, Union, get_args, get_origin

import numpy as np
import yaml
from docutils import nodes
from numpy.typing import ArrayLike
from PIL import Image
from sphinx.pycode import ModuleAnalyzer

from bookkit.rows import read_rows
from common import BOOK, ROOT, SLIDER, chapters, toc_pages
from distfilt.validation import ALLOW_NAN
from ledger import ITEMS, LEDGER, WORDS, LedgerClaim, claims_of, summaries

PAPERS = {
    "grange": "Triangular transport maps",
    "das": "Constrained optimal transport",
    "semeraro": "Partial-state fusion",
    "zheng": "Distributed density filter",
}
CODE = re.compile(
    r"^(`{3,})\{code-cell\}[^\n]*\n(?:---\n.*?^---\n)?(?::\w+:[^\n]*\n)*(.*?)^\1$",
    re.M | re.S,
)
"""A chapter's code cell; its text is the second group."""
BLOCK = re.compile(r'<div class="highlight-ipython3[^>]*>.*?</pre>', re.S)
"""The code of a cell on a built page."""


def chapter_label(page: str) -> str | None:
    """Return the label of a chapter's page: "1", and "1b" for a second page."""
    # The file name has a leading zero, the label has none.
    match = re.match(r"book/0*(\d+[a-z]?)-", page)
    return match.group(1) if match else None


def chapter_number(page: str) -> int | None:
    """Return the number of a page's chapter."""
    match = re.match(r"book/(\d+)[a-z]?-", page)
    return int(match.group(1)) if match else None


def chapter_pages() -> dict[str, str]:
    """Return the pages of all chapters by their labels."""
    pages = {chapter_label(page): page for page in toc_pages()}
    return {label: page for label, page in pages.items() if label}


def drop_widgets(tree: nodes.document) -> None:
    """Remove the text form of widgets, a line with the names of their parts."""
    for node in list(tree.findall(nodes.literal_block)):
        # A widget prints as `interactive(children=(...))`, which tells a reader
        # nothing.
        if node.astext().startswith("interactive(children="):
            node.parent.remove(node)


def keep_sliders(tree: nodes.document) -> None:
    """Put a slider in the place of its first frame, so that it has the figure's caption.

    An output with a slider also has that frame as a PNG, to which the figure options (caption,
    name, number) apply. The slider's HTML replaces the PNG there.
    """
    bundles = [
        node
        for node in tree.findall(nodes.container)
        if node.get("nb_element") == "mime_bundle"
    ]
    for bundle in bundles:
        parts = {part.get("mime_type"): part for part in bundle.children}
        page = parts.get("text/html")
        picture = parts.get("image/png")
        if page is None or picture is None:
            continue
        raw = next((n for n in page.findall(nodes.raw) if SLIDER in n.astext()), None)
        image = next(iter(picture.findall(nodes.image)), None)
        if raw is not None and image is not None:
            image.parent.replace(image, raw.deepcopy())
            bundle.remove(page)


def number_chapters(env: Any, number_of: Any) -> None:
    """Give each chapter the number of its file name.

    Sphinx would count the existing chapters, and would not number the second page of a chapter,
    which is one level deeper.
    """
    for page, title in env.titles.items():
        number = number_of(page)
        if number is None:
            continue
        entries = list(env.tocs[page].findall(nodes.reference))
        # Sections have no number of their own.
        sections = dict.fromkeys([entry["anchorname"] for entry in entries])
        env.toc_secnumbers[page] = {**sections, "": (number,)}
        # The title on the page, and its first entry in the list of contents
        for node in (title, entries[0]):
            node["secnumber"] = [number]


def modules() -> list[str]:
    """Return every module of the library, the package first."""
    root = ROOT / "distfilt"
    # Modules that begin with an underscore are private.
    public = (p for p in root.rglob("*.py") if p.stem == "__init__" or p.stem[0] != "_")
    paths = sorted(public)
    names = [
        p.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".") for p in paths
    ]
    return sorted(name.removesuffix(".__init__") for name in names)


def directive(module: Any, name: str) -> list[str]:
    """Return the lines that document one public name of the module that defines it."""
    value = getattr(module, name)
    if inspect.isclass(value) and value.__module__.startswith("distfilt"):
        # Sphinx documents classes and functions; other values need a line of their own.
        return [f".. autoclass:: {module.__name__}.{name}", "   :members:", ""]
    if inspect.isfunction(value):
        return [f".. autofunction:: {module.__name__}.{name}", ""]
    # The text below an assignment, which Sphinx takes for the variable's docstring
    meaning = (
        ModuleAnalyzer.for_module(module.__name__).find_attr_docs().get(("", name), [])
    )
    if inspect.isclass(value):
        meaning = [f"Short for ``{value.__module__}.{value.__qualname__}``."]
    elif get_origin(value) is not None:
        # Annotated[base, note, ...] has conditions such as a lower bound as notes.
        base, *notes = get_args(value) if get_origin(value) is Annotated else (value,)
        kind = (
            "np.ndarray"
            if get_origin(base) is np.ndarray
            else getattr(base, "__name__", base)
        )
        words = ", ".join(word_of(note) for note in (kind, *notes))
        meaning = [*meaning, "", f"The type ``{words}``."]
    elif not meaning:
        meaning = [f"A constant, a ``{type(value).__name__}``."]
    text = [f"   {line}" for line in meaning]
    return [f".. py:data:: {name}", "", *text, ""]


def word_of(note: Any) -> str:
    """Return a note of a type in words: ``at_least(1)`` for a condition with its bound."""
    # A condition with its bound is a partial: at_least(1).
    if isinstance(note, functools.partial):
        return f"{word_of(note.func)}({', '.join(map(str, note.args))})"
    return str(getattr(note, "__name__", note)).lstrip("_")


def home_of(module: Any, name: str) -> str:
    """Return the module that defines a name which a package exports."""
    value = getattr(module, name)
    if isinstance(value, types.ModuleType):
        return value.__name__
    home = str(getattr(value, "__module__", "") or "")
    knows_home = home.startswith("distfilt") and hasattr(value, "__qualname__")
    if knows_home:
        return home
    # A constant has no module of its own: find the module below that exports the same object.
    # Equal constants are told apart by identity: the module exports this very object.
    below = [n for n in modules() if n.startswith(f"{module.__name__}.")]
    same_value = (
        n for n in below if vars(importlib.import_module(n)).get(name) is value
    )
    exporting = (n for n in same_value if name in importlib.import_module(n).__all__)
    return next(exporting, module.__name__)


@functools.cache
def type_names() -> list[tuple[Any, str]]:
    """Return the aliases of types, each with its name."""
    kinds = importlib.import_module("distfilt.validation")
    named = [(getattr(kinds, name), name) for name in kinds.__all__]
    return [
        *((value, name) for value, name in named if get_origin(value)),
        (ArrayLike, "ArrayLike"),
    ]


def format_type(kind: Any, names: Mapping[str, Any]) -> str:
    """Return a type as a reader would write it: ``Array['... N d']``, ``PositiveInt | None``."""
    # An annotation inside another one may be a text that is not evaluated yet.
    if isinstance(kind, ForwardRef):
        kind = kind.__forward_arg__
    if isinstance(kind, str):
        try:
            return format_type(eval(kind, dict(names)), names)
        except (NameError, TypeError):
            return kind
    if kind is Ellipsis:
        return "..."
    if kind is None or kind is type(None):
        return "None"
    if isinstance(kind, list):  # the arguments of a Callable
        return f"[{format_types(kind, names, ', ')}]"
    # An alias such as PositiveInt is shown by its name, not by its parts.
    for value, name in type_names():
        if value == kind:
            return name
    if get_origin(kind) is None:
        return getattr(kind, "__name__", str(kind))
    return format_generic(kind, names)


def format_types(kinds: Iterable[Any], names: Mapping[str, Any], separator: str) -> str:
    """Return several types in a row."""
    return separator.join(format_type(kind, names) for kind in kinds)


def format_generic(kind: Any, names: Mapping[str, Any]) -> str:
    """Return a type that has arguments, such as a union or a sequence."""
    origin = get_origin(kind)
    arguments = get_args(kind)
    if origin is Annotated:
        notes = [note for note in arguments[1:] if isinstance(note, str)]
        # Among the notes of an array, a text is its shape, or the mark that it may hold
        # NaN.
        shapes = [note for note in notes if note != ALLOW_NAN]
        shape = f"[{shapes[-1]!r}]" if shapes else ""
        return format_type(arguments[0], names) + shape
    if origin in (Union, types.UnionType):
        return format_types(arguments, names, " | ")
    if origin is Literal:
        return f"Literal[{', '.join(map(repr, arguments))}]"
    if origin is np.ndarray:
        return "NDArray"
    name = getattr(origin, "__name__", str(origin))
    return f"{name}[{format_types(arguments, names, ', ')}]"


def default(value: Any) -> str:
    """Return a default value as code: a function's name, dots if there is no short form."""
    # `<object at 0x...>` is no code and differs in each build.
    text = getattr(value, "__name__", None) or repr(value)
    try:
        ast.parse(text)
    except SyntaxError:
        return "..."
    return text


def signature(kind: str, value: Any) -> tuple[str, str | None] | None:
    """Return a signature with every type as `format_type` writes it; None leaves it as it is."""
    if kind not in ("function", "method", "class"):
        return None
    try:
        # Built-in classes may have no signature.
        signature_ = inspect.signature(value)
    except (TypeError, ValueError):
        return None
    names: dict[str, Any] = {}
    # Annotations are texts; a class inherits fields from modules of its bases.
    for owner in reversed(inspect.getmro(value) if kind == "class" else [value]):
        names |= vars(importlib.import_module(owner.__module__))
    texts = []
    kinds = inspect.Parameter
    last = None
    for k, part in enumerate(signature_.parameters.values()):
        # A caller does not write `self`.
        if k == 0 and part.name == "self":
            continue
        # A bare star stands before the first keyword-only argument, unless *args does.
        if part.kind is kinds.KEYWORD_ONLY and last not in (
            part.kind,
            kinds.VAR_POSITIONAL,
        ):
            texts.append("*")
        last = part.kind
        text = {kinds.VAR_POSITIONAL: "*", kinds.VAR_KEYWORD: "**"}.get(
            last, ""
        ) + part.name
        if part.annotation is not part.empty:
            text += f": {format_type(part.annotation, names)}"
        texts.append(
            text if part.default is part.empty else f"{text} = {default(part.default)}"
        )
    annotation = signature_.return_annotation
    returned = (
        None if annotation is signature_.empty else format_type(annotation, names)
    )
    return f"({', '.join(texts)})", None if kind == "class" else returned


def escape_stars(lines: list[str]) -> None:
    """Escape the star of a shape such as ``(*runs, N, d)``, which is no emphasis."""
    for k, line in enumerate(lines):
        if not line.lstrip().startswith((">>>", "...")):
            # Every second part is literal text, where a star is no emphasis.
            parts = line.split("``")
            parts[::2] = [
                re.sub(r"(?<=[(\s])\*(?=\w+[,)])", r"\\*", part) for part in parts[::2]
            ]
            lines[k] = "``".join(parts)


def summary(module: Any) -> str:
    """Return the first sentence of a module's text."""
    first = (inspect.getdoc(module) or "").split("\n\n")[0].replace("\n", " ")
    return cell(first)


FIRST = (
    "filters",
    "updates",
    "network",
    "sensors",
    "models",
    "metrics",
    "kalman",
    "triangular",
)
"""What a reader looks for first; the other parts follow in alphabetical order."""


def api_parts() -> dict[str, list[str]]:
    """Return the library's parts in the order of the page, each with its modules."""
    parts: dict[str, list[str]] = {}
    for name in modules():
        # A module without public names has no section.
        if name != "distfilt" and importlib.import_module(name).__all__:
            # The part is the subpackage: distfilt.PART.module
            parts.setdefault(name.split(".")[1], []).append(name)
    order = [
        *(p for p in FIRST if p in parts),
        *sorted(p for p in parts if p not in FIRST),
    ]
    return {part: parts[part] for part in order}


FAMILIES = (
    "gaussian",
    "ensemble",
    "particle",
    "mixture",
    "increments",
    "density",
    "sum",
    "grid",
    "consensus",
    "likelihood",
    "tree",
)
"""Modules of `distfilt.filters` on a page of their own, since all of them are long for one."""


def is_family(name: str) -> bool:
    """Whether a module stands on the page of the families of filters."""
    head, _, module = name.rpartition(".")
    return head == "distfilt.filters" and module in FAMILIES


def anchor(name: str) -> str:
    """Return the label of a module's section."""
    return "api-" + name.replace(".", "-").replace("_", "-")


def homes() -> dict[str, str]:
    """Return the entry of each public name, by every path from which it can be imported."""
    entries = {}
    # A package's exports have one entry, in the module that defines them.
    for path in modules():
        module = importlib.import_module(path)
        for name in module.__all__:
            value = getattr(module, name)
            if isinstance(value, types.ModuleType):
                entries[f"{path}.{name}"] = value.__name__
            else:
                entries[f"{path}.{name}"] = f"{home_of(module, name)}.{name}"
    return entries


def code_of(source: Path) -> str:
    """Return all code of a chapter or of a script, without lines for the notebook alone."""
    text = source.read_text(encoding="utf-8")
    if source.suffix == ".md":
        text = "\n".join(body for _, body in CODE.findall(text))
    return re.sub(r"^[%!].*$", "", text, flags=re.MULTILINE)


def imports_of(code: str, entry_of: dict[str, str]) -> dict[str, str]:
    """Return the names under which code imports parts of the library, each with its entry."""
    entries = {}
    # Only names that are imported one by one are linked.
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
            "distfilt"
        ):
            for name in node.names:
                path = f"{node.module}.{name.name}"
                entries[name.asname or name.name] = entry_of.get(path, path)
    return entries


def names_used(code: str, entry_of: dict[str, str]) -> set[str]:
    """Return the entries of the library that code uses, also by an attribute."""
    names = imports_of(code, entry_of)
    used = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Name) and node.id in names:
            used.add(names[node.id])
        # `filters.EnsembleFilter`, where `filters` was imported
        elif isinstance(node, ast.Attribute):
            owner = getattr(node.value, "id", "")
            if owner not in names:
                continue
            path = f"{names[owner]}.{node.attr}"
            used.add(entry_of.get(path, path))
    return used


def users() -> dict[str, list[str]]:
    """Return, for each name of the library, links to the chapters and scripts that use it."""
    entry_of = homes()
    links = {}
    # Chapters first, since a page is a better example than a script.
    scripts = [*(BOOK / "examples").glob("*.py"), *(BOOK / "studies").glob("*.py")]
    for source in [*chapters(), *sorted(scripts)]:
        if source.suffix == ".md":
            label = chapter_label(f"book/{source.stem}")
            link = f":doc:`{label or 'the first page'} </book/{source.stem}>`"
        else:
            link = f"``{source.relative_to(ROOT).as_posix()}``"
        for name in names_used(code_of(source), entry_of):
            links.setdefault(name, []).append(link)
    return links


def used_in(name: str, by: dict[str, list[str]]) -> list[str]:
    """Return a line with links to the chapters that use a name, or else to scripts."""
    links = by.get(name, [])
    pages = [link for link in links if link.startswith(":doc:")]
    word = "chapter " if pages and "first page" not in pages[0] else ""
    return (
        ["", f"   *Used in* {word}{', '.join(pages or links[:3])}.", ""]
        if links
        else [""]
    )


def link_code(
    body: str, names: dict[str, str], url: Callable[[str], str | None]
) -> str:
    """Return a page whose code cells link the names that its chapter imports to their entries.

    A name is linked where it is used, not where it is an argument's name or another's attribute.
    """

    def link(match: re.Match[str]) -> str:
        path = names[match["name"]] + (f".{match['part']}" if match["part"] else "")
        target = url(path) or url(names[match["name"]])
        return f'<a class="api" href="{target}">{match[0]}</a>' if target else match[0]

    if not names:
        return body
    # Not after a dot (an attribute), and not before "=" (an argument's name)
    one = "|".join(map(re.escape, names))
    name = re.compile(
        rf'(?<!<span class="o">\.</span>)<span class="n">(?P<name>{one})</span>'
        r'(?:<span class="o">\.</span><span class="n">(?P<part>\w+)</span>)?'
        r'(?!<span class="o">=</span>)'
    )
    # Only inside the code of cells: prose may have the same words.
    return BLOCK.sub(lambda block: name.sub(link, block[0]), body)


def simplify_signatures(body: str) -> str:
    """Return a page without the marks inside its signatures, which are half of its weight."""

    def plain(match: re.Match[str]) -> str:
        text = re.sub(r'<span class="(?:pre|[pwko])">([^<]*)</span>', r"\1", match[0])
        text = re.sub(r'<span class="(?:pre|[pwkon])">([^<]*)</span>', r"\1", text)
        # Lines of a long signature are no list of words and meanings.
        text = re.sub(r"<(/?)dl>", r"<\1div>", text).replace("</dd>", "</div>")
        return text.replace("<dd>", '<div class="sig-line">')

    return re.sub(r'<dt class="sig .*?</dt>', plain, body, flags=re.DOTALL)


def is_protocol(value: Any) -> bool:
    """Return whether a public class is a protocol for classes of users."""
    return bool(getattr(value, "_is_protocol", False)) and value.__name__[0] != "_"


def links(module: Any) -> str:
    """Return links to the names that a subpackage exports, in their order."""
    texts = []
    for name in module.__all__:
        home = home_of(module, name)
        value = getattr(module, name)
        if isinstance(value, types.ModuleType):
            texts.append(f"[`{name}`](#{anchor(home)})")
        else:
            texts.append("{py:obj}`" + f"{name} <{home}.{name}>`")
    return ", ".join(texts)


def api_index() -> str:
    """Return the index of the reference: each subpackage, its purpose and its exports."""
    lines = ["| Part | Purpose | Names |", "|---|---|---|"]
    for part in api_parts():
        face = importlib.import_module(f"distfilt.{part}")
        lines += [
            f"| [`{part}`](/book/api/{part}.md) | {summary(face)} | {links(face)} |"
        ]
    return "\n".join(lines)


def api_families(by: dict[str, list[str]]) -> str:
    """Return the reference of the families of filters, which belong to `distfilt.filters`."""
    names = [f"distfilt.filters.{module}" for module in FAMILIES]
    lines = [
        "# Families of filters",
        "",
        "The rest of `distfilt.filters` is on [its own page](/book/api/filters.md).",
        "",
    ]
    return "\n".join([*lines, *api_sections("distfilt.filters", names, by)])


def api_part(part: str, by: dict[str, list[str]]) -> str:
    """Return the reference of one part, module by module."""
    names = [name for name in api_parts()[part] if not is_family(name)]
    return "\n".join(api_sections(f"distfilt.{part}", names, by))


def api_sections(head: str, names: list[str], by: dict[str, list[str]]) -> list[str]:
    """Return the lines of a section for each module."""
    lines = []
    for name in names:
        module = importlib.import_module(name)
        documented = [n for n in module.__all__ if home_of(module, n) == name]
        # Protocols are documented, although users need not import them.
        documented += [
            n
            for n, v in vars(module).items()
            if is_protocol(v) and v.__module__ == name
        ]
        title = f"# `{head}`" if name == head else f"## `{name[len(head) + 1 :]}`"
        lines += [f"({anchor(name)})=", title, ""]
        body = [f".. automodule:: {name}", "   :no-members:", ""]
        # A protocol may be exported too; each name is documented once.
        for public in dict.fromkeys(documented):
            body += [*directive(module, public)[:-1], *used_in(f"{name}.{public}", by)]
        lines += ["```{eval-rst}", *body, "```", ""]
        if name == head and hasattr(module, "__path__"):
            lines += [f"From here a reader imports {links(module)}.", ""]
    return lines


def cell(text: str) -> str:
    """Return a text that fits a cell of a Markdown table."""
    return text.replace("|", r"\|").replace("\n", " ") or "–"


def chapter_link(chapter: str) -> str:
    """Return a link to a chapter that exists, or its number."""
    page = f"book/{chapter}"
    label = chapter_label(page) or chapter
    return f"[{label}](/{page})" if page in toc_pages() else label


def reproductions_text() -> str:
    """Return the count of verdicts and one table for each paper."""
    titles = {(item["paper"], item["item"]): item["title"] for item in read_rows(ITEMS)}
    rows = read_rows(LEDGER)
    lines = []
    for kind, (total, counts) in summaries(rows).items():
        counted = ", ".join(f"{n} *{verdict}*" for verdict, n in counts.items())
        lines += [f"Of {total} {WORDS[kind]}: {counted}.", ""]
    for paper in dict.fromkeys(row["paper"] for row in rows):
        rows_of_paper = [row for row in rows if row["paper"] == paper]
        lines += [f"## {PAPERS.get(paper, paper)} (`{paper}`)", ""]
        lines += ["| Item | Shows | Chapter | Verdict |", "|---|---|---|---|"]
        for row in rows_of_paper:
            # A no-break space keeps "Fig. 1" in one line of a narrow column.
            cells = [
                row["item"].replace(" ", "\u00a0"),
                cell(titles[paper, row["item"]]),
            ]
            cells += [chapter_link(row["chapter"]), row["verdict"]]
            lines += ["| " + " | ".join(cells) + " |"]
        lines += [""]
        # A table of parameters that was read as printed needs no evidence.
        for row in (row for row in rows_of_paper if row["verdict"] != "read"):
            lines += claims_text(row, titles[paper, row["item"]])
    return "\n".join(lines)


def listed_claims(row: dict[str, str]) -> dict[str, dict[str, str]]:
    """Return the claims that are listed for an item of the ledger, by their ids."""
    folder = ROOT / "data" / "published" / row["paper"]
    name = row["item"].lower()
    # "Fig. 1" has its claims in figure-1.csv, "Table 2" in table-2-claims.csv.
    stem = name.replace("fig. ", "figure-").replace("table ", "table-")
    path = folder / f"{stem}{'' if stem.startswith('figure') else '-claims'}.csv"
    return {claim["id"]: claim for claim in read_rows(path)}


CLAIM_COLUMNS = {
    "Claim": "claim",
    "Verdict": "verdict",
    "Ours": "ours",
    "If false": "null",
    "If true": "control",
}
"""Columns of the table of claims, and the fields that they show."""


def claims_table(
    claims: list[LedgerClaim], listed: dict[str, dict[str, str]]
) -> list[str]:
    """Return a Markdown table with one row a claim."""
    rows = []
    for claim in claims:
        start = f" ({claim.start})" if claim.start else ""
        rows.append(
            {
                "claim": listed[claim.id]["claim"] + start,
                "verdict": "holds" if claim.holds else "fails",
                "ours": claim.ours,
                "null": claim.null,
                "control": claim.control,
            }
        )
    # A column without an entry is left out.
    shown = {
        head: name
        for head, name in CLAIM_COLUMNS.items()
        if any(row[name] for row in rows)
    }
    lines = [f"| {' | '.join(shown)} |", "|---" * len(shown) + "|"]
    for row in rows:
        lines += [f"| {' | '.join(cell(row[name]) for name in shown.values())} |"]
    return [*lines, ""]


def claims_text(row: dict[str, str], title: str) -> list[str]:
    """Return the evidence of one verdict: a table with one row a claim, then rules and ranges."""
    lines = [f"### {row['item']}: {title}", "", f"Verdict: **{row['verdict']}**."]
    if row["why"]:
        lines[-1] += f" Why: {row['why']}."
    lines += [""]
    claims = claims_of(row)
    if not claims:
        return [
            *lines,
            f"Ours: {row['ours'] or '–'}. Published: {row['published'] or '–'}.",
            "",
        ]
    listed = listed_claims(row)
    lines += claims_table(claims, listed)
    # Claims of two starts share a rule, which is shown once.
    for k in dict.fromkeys(claim.id for claim in claims):
        lines += [listed[k]["claim"], f": *Rule:* {listed[k]['criterion']}"]
        for claim in (c for c in claims if c.id == k and c.range):
            start = f", {claim.start}" if claim.start else ""
            lines += ["", f": *Range{start}:* {claim.range}"]
        lines += [""]
    return lines


def needs() -> dict[int, set[int]]:
    """Return the chapters that each chapter builds on, as its pages say: *You should know ...*."""
    needed: dict[int, set[int]] = {}
    for page in chapter_pages().values():
        text = " ".join((ROOT / f"{page}.md").read_text(encoding="utf-8").split())
        # Links become their texts, so that "chapters 1, 2 and 3" can be read.
        text = re.sub(r"\[([^]]*)\]\(\d[^)]*\)", r"\1", text)
        # The sentence ends at a full stop before a capital letter, not at "Fig. 1".
        sentence = re.search(r"You should know .*?\.(?= [A-Z`:|#]|$)", text)
        number = chapter_number(page) or 0
        chapters = needed.setdefault(number, set())
        lists = r"[Cc]hapters? ((?:\d+(?:, and |, | and | to )?)+)"
        for part in re.findall(lists, sentence[0] if sentence else ""):
            # "chapters 1 to 4" is a range, "1, 2 and 4" a list.
            listed = [int(n) for n in re.findall(r"\d+", part)]
            chapters |= set(
                range(listed[0], listed[-1] + 1) if " to " in part else listed
            )
        # A second page builds on its own chapter's first page, which is no arrow.
        chapters -= {number}
    return needed


MAP_WIDTH = 1060
BOX = (258, 52)
"""Width and height of a chapter's box on the map."""
BOX_STEP = 262
ROW_GAP = 53


def all_needed(n: int, needed: dict[int, set[int]]) -> set[int]:
    """Return all chapters that one builds on, directly or through others."""
    return needed[n].union(*(all_needed(k, needed) for k in needed[n]))


def map_places(
    needed: dict[int, set[int]], stacks: dict[int, list[str]]
) -> tuple[dict[int, tuple[float, int]], int]:
    """Return the middle of each chapter's first box, and the height of the map.

    A chapter lies one row below the lowest one that it builds on; rows are centred.
    """
    rows: dict[int, int] = {}
    for n in needed:
        # Chapters come in order, so that those needed have their rows already.
        rows[n] = 1 + max((rows[k] for k in needed[n]), default=-1)
    places = {}
    top = 40
    for row in range(max(rows.values()) + 1):
        in_row = [k for k in rows if rows[k] == row]
        for position, n in enumerate(in_row):
            # Places of a row are symmetric about the middle of the map.
            offset = position - (len(in_row) - 1) / 2
            places[n] = (MAP_WIDTH / 2 + BOX_STEP * offset, top)
        # A row is as high as its chapter with the most pages.
        top += ROW_GAP + BOX[1] * max(len(stacks[n]) for n in in_row)
    return places, top - 65


def map_arrows(
    needed: dict[int, set[int]],
    stacks: dict[int, list[str]],
    places: dict[int, tuple[float, int]],
) -> list[str]:
    """Return an arrow from each chapter to those that build on it, implied ones left out."""
    lines = []
    for n, (x, y) in places.items():
        # If 3 needs 2 and 2 needs 1, the arrow from 1 to 3 says nothing more.
        implied = {i for j in needed[n] for i in all_needed(j, needed)}
        for k in needed[n] - implied:
            a, b = places[k]
            # The arrow starts below the chapter's last page.
            b += BOX[1] * (len(stacks[k]) - 1)
            # A cubic Bézier curve that leaves and enters vertically
            curve = f"M{a:g},{b + 26} C{a:g},{b + 66} {x:g},{y - 66} {x:g},{y - 27}"
            lines.append(f'<path d="{curve}"/>')
    return lines


def map_boxes(
    stacks: dict[int, list[str]],
    places: dict[int, tuple[float, int]],
    pages: dict[str, str],
) -> list[str]:
    """Return a linked box with number and title for each page of a chapter."""
    width, height = BOX
    lines = []
    for n, (x, y) in places.items():
        for k, label in enumerate(stacks[n]):
            title = chapter_title(pages[label])
            link = pages[label].removeprefix("book/")
            # Pages of a chapter are stacked without a gap.
            middle = y + height * k
            box = (
                f'<rect x="{x - width / 2:g}" y="{middle - 26}" width="{width}" '
                f'height="{height}" rx="8"/>'
            )
            text = f'<text x="{x:g}" y="{middle + 6}">{label}. {title}</text>'
            hover = f"<title>{title}</title>"
            lines.append(f'<a href="{link}.html">{box}{text}{hover}</a>')
    return lines


def map_list(
    needed: dict[int, set[int]], stacks: dict[int, list[str]], pages: dict[str, str]
) -> list[str]:
    """Return the map as a list, for readers who do not see it."""
    lines = []
    for n, labels in stacks.items():
        links = [f"[chapter {k}](/{pages[str(k)]}.md)" for k in sorted(needed[n])]
        # "1, 2 and 3": the last comma becomes "and".
        enumeration = " and ".join(", ".join(links).rsplit(", ", 1))
        titles = []
        for label in labels:
            page = pages[label]
            titles.append(f"**{label}** [{chapter_title(page)}](/{page}.md)")
        builds_on = enumeration or "nothing of the book"
        lines.append(f"- {' with '.join(titles)}: {builds_on}")
    return lines


def map_text() -> str:
    """Return a drawing of the chapters that each chapter builds on, and the same as a list."""
    needed = needs()
    pages = chapter_pages()
    stacks: dict[int, list[str]] = {n: [] for n in needed}
    for label, page in pages.items():
        stacks[chapter_number(page) or 0].append(label)
    places, height = map_places(needed, stacks)
    head = (
        f'<svg class="map" viewBox="0 0 {MAP_WIDTH} {height}" role="group" '
        'aria-label="Arrows from each chapter to those that build on it">'
    )
    arrows = map_arrows(needed, stacks, places)
    boxes = map_boxes(stacks, places, pages)
    drawing = ["```{raw} html", head, *arrows, *boxes, "</svg>", "```", ""]
    return "\n".join([*drawing, *map_list(needed, stacks, pages)])


def chapter_title(page: str) -> str:
    """Return the title of a page."""
    text = (ROOT / f"{page}.md").read_text(encoding="utf-8")
    return re.search(r"^# +(.+)$", text, flags=re.MULTILINE)[1]  # type: ignore[index]


def figures(source: Path) -> Iterator[tuple[str, str, str, bytes]]:
    """Yield a chapter's numbered figures: label, caption, text for who does not see it, picture."""
    for cell in json.loads(source.with_suffix(".ipynb").read_text(encoding="utf-8"))[
        "cells"
    ]:
        options = cell["metadata"].get("mystnb", {})
        name = options.get("figure", {}).get("name")
        bundles = [output.get("data", {}) for output in cell.get("outputs", ())]
        # A figure has one picture; numbered ones have a name.
        pictures = [data["image/png"] for data in bundles if "image/png" in data]
        if name and pictures:
            caption = options["figure"].get("caption", "")
            alt = options.get("image", {}).get("alt")
            yield name, caption, alt or caption, base64.b64decode("".join(pictures[0]))


def gallery_text(folder: Path) -> str:
    """Return a card for each figure of the book, and write its small picture."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = []
    for source in chapters():
        label = chapter_label(f"book/{source.stem}")
        if label is None:
            continue
        lines += [f"## {label}. {chapter_title(f'book/{source.stem}')}", ""]
        lines += ["::::{grid} 2 2 3 4", ":gutter: 2", ""]
        for name, caption, alt, picture in figures(source):
            target = folder / f"{name}.png"
            # Draw a small picture again only if the notebook is newer.
            modified = target.stat().st_mtime if target.is_file() else 0.0
            if modified < source.with_suffix(".ipynb").stat().st_mtime:
                small = Image.open(io.BytesIO(picture)).convert("RGB")
                small.thumbnail((480, 480), reducing_gap=2.0)
                small.quantize(64).save(target)
            # The caption's first sentence, with the texts of its roles
            words = (
                re.sub(r"\{[\w:]+\}`([^`<]*)[^`]*`", r"\1", caption)
                .split(". ")[0]
                .rstrip(".")
            )
            alt = " ".join(alt.split())
            lines += [
                ":::{grid-item-card}",
                f":link: {name}",
                ":link-type: ref",
                f":img-top: /book/_generated/gallery/{name}.png",
                f":img-alt: {alt}",
                ":class-card: picture",
                "",
                words,
                ":::",
            ]
        lines += ["::::", ""]
    return "\n".join(lines)


def errata_text() -> str:
    """Return the papers' errata, as each paper's page of printed values lists them."""
    lines = []
    for paper, title in PAPERS.items():
        text = (ROOT / "data" / "published" / paper / "README.md").read_text(
            encoding="utf-8"
        )
        # The table of the section Errata, up to the next section
        table = text.split("## Errata", 1)[1].split("\n## ", 1)[0]
        rows = [line for line in table.splitlines() if line.startswith("|")]
        lines += [f"### {title} (`{paper}`)", "", *map(with_links, rows), ""]
    return "\n".join(lines)


def with_links(row: str) -> str:
    """Return a row of a table whose chapters are links."""
    pages = chapter_pages()

    def link(match: re.Match[str]) -> str:
        page = pages.get(match[2])
        return f"[{match[1]}{match[2]}](/{page}.md)" if page else match[0]

    # In a table of errata chapters are named as "chapter 4", "chapters 4 and 5".
    for place in (
        r"(?<=chapter )()(\d+\w?)",
        r"(?<= and )()(\d+\w?)(?= \|$)",
        r"(?<=chapters )()(\d+\w?)",
    ):
        row = re.sub(place, link, row)
    return row


def cite_text() -> str:
    """Return how to cite the book, from the file that says it for machines."""
    facts = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    who = " and ".join(author["name"] for author in facts["authors"])
    # BibTeX keeps a name in braces together.
    fields = {
        "title": facts["title"],
        "author": "{" + who + "}",
        "version": facts["version"],
        "year": str(facts["date-released"])[:4],
    }
    body = ",\n".join(f"  {name:<8}= {{{value}}}" for name, value in fields.items())
    return f"```bibtex\n@software{{distfilt,\n{body}\n}}\n```"


def comparison_text() -> str:
    """Return the best filters of chapter 11's stored study: a row a problem, a column a budget."""
    from bookkit import studies

    read = studies.script("_together_read")
    lines = [
        "| Problem | Silent | At most 2 numbers | At most 5 numbers | At most 20 numbers |",
        "|---|---|---|---|---|",
    ]
    for name in read.FOUR:
        cells = [f"*{name}*: {read.together.problem(name).scenario.title}"]
        for budget in (0, 2, 5, 20):
            # Among filters within the budget, only consistent ones compete.
            if not read.admissible(name, budget):
                cells += ["no filter with a consistent covariance"]
                continue
            best = read.best(name, budget)
            # Errors are relative to the reference of the problem.
            error = read.ratio(best, read.results(name)["reference"]).estimate
            cell = read.CELLS[best.cell]
            cells += [f"{error:.2f}: {cell.family}; {cell.exchange}"]
        lines += ["| " + " | ".join(cells) + " |"]
    return "\n".join(lines)


def write_generated(folder: Path) -> None:
    """Write the included parts of pages; an unchanged part keeps its date."""
    by = users()
    parts = {f"api/{part}.md": api_part(part, by) for part in api_parts()}
    parts["api/families.md"] = api_families(by)
    parts["api.md"] = api_index()
    parts["map.md"] = map_text()
    parts["errata.md"] = errata_text()
    parts["measured.md"] = comparison_text()
    parts["gallery.md"] = gallery_text(folder / "gallery")
    parts["cite.md"] = cite_text()
    if ITEMS.is_file() and LEDGER.is_file():
        parts["reproductions.md"] = reproductions_text()
    for name, text in parts.items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        # Sphinx reads a page again if a file that it includes has a newer date.
        if not target.is_file() or target.read_text(encoding="utf-8") != text:
            target.write_text(text, encoding="utf-8")
