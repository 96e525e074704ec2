"""Open JupyterLab on a working copy of the book, so that the repository stays unchanged.

    python book/tools/lab.py FOLDER [--no-open]

The copy has the chapters as notebooks only, with trusted outputs, the other pages, the scripts, and
the data, which a reader may edit. Citations, numbers of equations and figures, and references to
other chapters are replaced by text, since JupyterLab reads one page at a time. An existing copy is
opened unchanged.
"""

from __future__ import annotations

import startup  # noqa: F401

# isort: split
import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import nbformat
from nbformat.sign import NotebookNotary
from pybtex.database import BibliographyData, parse_file
from pybtex.plugin import find_plugin

from common import BOOK, ROOT, chapters, is_chapter, toc_pages
from pages import chapter_label, chapter_number, reproductions_text

ROLE = re.compile(r"\{([a-z]+(?::[a-z]+)?)\}`([^`]+)`")
MATH = re.compile(r"^(?P<fence>`{3,})\{math\}\n(?P<body>.*?)^(?P=fence)$", re.M | re.S)
DOLLARS = re.compile(r"\$\$(?P<body>[^$]+?)\$\$ *\((?P<label>[\w-]+)\)", re.S)
OPTION = re.compile(r"^:(\w+): *(.*)\n", re.M)
TITLE = re.compile(r"^# +(.+)$", re.M)
ANCHOR = re.compile(r"^\(([\w-]+)\)=\s*\n+#+ +(.+)$", re.M)
GATE = re.compile(
    r"^(?P<fence>`{3,}|:{3,})\{(?P<kind>exercise|solution)-(?P<side>start|end)\} *"
    r"(?P<title>[^\n]*)\n.*?^(?P=fence)$\n?",
    re.M | re.S,
)
"""The start or the end of an exercise or a solution with cells."""
BOX = re.compile(
    r"^(?P<fence>`{3,}|:{3,})\{(?P<kind>exercise|prf:algorithm|admonition)\} *(?P<title>[^\n]*)\n"
    r"(?P<body>.*?)^(?P=fence)$",
    re.M | re.S,
)
BOXES = {"exercise": "Exercise: ", "prf:algorithm": "Algorithm: ", "admonition": ""}
LINK = re.compile(r"\[([^\[\]]+)\]\((?!https?:)[^()\s]+\.(?:ipynb|md)(?:#[^()\s]*)?\)")
"""A link to another page."""
INCLUDE = re.compile(r"^```\{include\} _generated/reproductions\.md\n```$", re.M)
PROGRAM = re.compile(
    r"^```\{literalinclude\} (?P<path>\S+)\n(?P<options>(?::.*\n)*)```$", re.M
)
MADE = re.compile(r"^```\{include\} _generated/\S+\n```$", re.M)
HELP = """# API reference

The reference is a page of the built book (`make book`). In a notebook `help(name)` or `name?` shows
the same text: arguments with shapes and units, errors, and an example.
`book/examples` has a filter of your own in sixty lines.
"""
INSTALL = """This is a page of *Distributed Nonlinear Filtering*, {title}. It needs Python 3.11 or newer, and from a copy of the
book's repository the library and the book's kit, which reads the data there:

```sh
pip install '.[maps,reference]' 'sgp4>=2.23'
pip install -e book/kit
```

Then it runs from any folder."""
HIDDEN = {"hide-input", "remove-input", "remove-cell", "hide-cell"}


@dataclass
class Names:
    """Texts of the labels of all pages: ``(4.2)``, ``Fig. 4.1``, a section's title."""

    words: dict[str, str] = field(default_factory=dict)
    homes: dict[str, str] = field(default_factory=dict)
    equations: dict[str, str] = field(default_factory=dict)
    figures: dict[str, str] = field(default_factory=dict)

    def add(self, label: str, words: str, home: str) -> None:
        self.words[label] = words
        self.homes[label] = home


def labels_of(text: str) -> Iterator[str]:
    """Yield the labels of a text's equations, in order."""
    # Both forms of equation count in one sequence, by their place in the text.
    positions = [
        (m.start(), dict(OPTION.findall(m["body"])).get("label"))
        for m in MATH.finditer(text)
    ]
    positions += [(m.start(), m["label"]) for m in DOLLARS.finditer(text)]
    return (label for _, label in sorted(positions) if label)


def texts_of(source: Path) -> list[tuple[str, Any]]:
    """Return a page's texts in order, each with the header of the cell that draws a figure."""
    if not is_chapter(source):
        return [(source.read_text(encoding="utf-8"), None)]
    cells = nbformat.read(source.with_suffix(".ipynb"), as_version=4).cells
    return [
        (
            cell.source if cell.cell_type == "markdown" else "",
            cell.metadata.get("mystnb", {}).get("figure"),
        )
        for cell in cells
    ]


def names(sources: list[Path]) -> Names:
    """Return the texts of all labels of the book."""
    all_names = Names()
    previous_number = None
    for source in sources:
        number = chapter_number(f"book/{source.stem}")
        page = chapter_label(f"book/{source.stem}")
        head = "" if number is None else f"{number}."
        if (
            number is None or number != previous_number
        ):  # a chapter's second page counts on
            # The first page of a chapter starts at 1.
            equations = figures = 0
        previous_number = number
        for text, figure in texts_of(source):
            # A reference to a page shows its title.
            title = TITLE.search(text)
            if title:
                chapter = title[1] if number is None else f"Chapter {page}, {title[1]}"
                all_names.add(source.stem, chapter, source.stem)
            for label in labels_of(text):
                equations += 1
                all_names.equations[label] = f"{head}{equations}"
                all_names.add(label, f"({head}{equations})", source.stem)
            for label, section in ANCHOR.findall(text):
                all_names.add(label, section, source.stem)
            if figure:
                figures += 1
                name = str(figure.get("name", f"{source.stem}-{figures}"))
                all_names.figures[name] = f"Fig. {head}{figures}"
                all_names.add(name, f"Fig. {head}{figures}", source.stem)
    return all_names


def cite(key: str, references: BibliographyData) -> tuple[str, str]:
    """Return the authors of an entry, as a citation names them, and its year."""
    entry = references.entries[key]
    people = entry.persons.get("author") or entry.persons.get("editor") or []
    # "van Loan": the prelast name belongs to the surname.
    surnames = [" ".join([*p.prelast_names, *p.last_names]).strip("{}") for p in people]
    # Two authors are named, of more only the first.
    authors = (
        f"{surnames[0]} et al." if len(surnames) > 2 else " and ".join(surnames) or key
    )
    return authors, str(entry.fields.get("year", "n.d."))


def render_role(
    role: str, target: str, page: str, all_names: Names, refs: BibliographyData
) -> str:
    """Return the text that replaces a role."""
    if role.startswith("cite"):
        entries = [cite(key.strip(), refs) for key in target.split(",")]
        # In the text: names, and the year in parentheses. Otherwise all in parentheses.
        if role == "cite:t":
            return "; ".join(
                f"[{who} ({year})](bibliography.md)" for who, year in entries
            )
        return (
            "(["
            + "; ".join(f"{who}, {year}" for who, year in entries)
            + "](bibliography.md))"
        )
    # A role is "target" or "text <target>".
    text, _, reference = target.rpartition("<")
    label = reference.rstrip(">").strip() if text else target
    # A target may be a path of a page, or a label.
    label = label.removeprefix("/").removeprefix("book/").removesuffix(".md")
    words = text.strip() or all_names.words.get(label, label)
    # A name of the library is code, without its path after "~".
    if role.startswith("py:"):
        shown = label.rpartition(".")[2] if label.startswith("~") else label
        return f"`{text.strip() or shown}`"
    home = all_names.homes.get(label, page)
    # A label of the same page needs no link.
    return words if home == page else f"[{words}]({file_of(home)})"


def file_of(stem: str) -> str:
    """Return the name of a page's file in the copy."""
    return f"{stem}.ipynb" if is_chapter(BOOK / f"{stem}.md") else f"{stem}.md"


def plain(text: str, page: str, all_names: Names, references: BibliographyData) -> str:
    """Return a page's text for JupyterLab, with numbers, titles and authors in place of roles."""

    def equation(match: re.Match[str]) -> str:
        options = dict(OPTION.findall(match["body"]))
        number = all_names.equations.get(options.get("label", ""))
        body = OPTION.sub("", match["body"]).strip()
        return f"$$\n{body}\n" + (f"\\tag{{{number}}}\n$$" if number else "$$")

    def dollars(match: re.Match[str]) -> str:
        return f"$${match['body']}\\tag{{{all_names.equations[match['label']]}}}$$"

    def gate(match: re.Match[str]) -> str:
        # JupyterLab cannot fold a solution: it gets a heading.
        if match["side"] == "end":
            return ""
        if match["kind"] == "solution":
            return "**Solution**\n"
        return f"**{BOXES['exercise']}{match['title']}**\n"

    def box(match: re.Match[str]) -> str:
        head = f"**{BOXES[match['kind']]}{match['title']}**"
        return f"{head}\n\n{OPTION.sub('', match['body']).strip()}\n"

    def program(match: re.Match[str]) -> str:
        code = (BOOK / match["path"]).read_text(encoding="utf-8").strip()
        return f"```python\n{code}\n```"

    # Equations first: their numbers come from labels that are removed here.
    text = MATH.sub(equation, DOLLARS.sub(dollars, text))
    text = BOX.sub(box, text)
    text = GATE.sub(gate, text)
    text = INCLUDE.sub(lambda m: reproductions_text(), text)
    text = PROGRAM.sub(program, text)
    # Parts that the build computes are files of the built book only.
    text = MADE.sub(
        "*The page of the book has a list here that the build computes.*", text
    )
    # Chapters are notebooks in the copy.
    text = re.sub(r"\]\((?:/book/)?(\d\d[a-z]?-[\w-]+)\.md", r"](\1.ipynb", text)
    return ROLE.sub(
        lambda m: render_role(m[1], m[2], page, all_names, references), text
    )


def notebook(source: Path, all_names: Names, references: BibliographyData) -> Any:
    """Return a chapter as a notebook that is not paired with a Markdown file."""
    stored = nbformat.read(source.with_suffix(".ipynb"), as_version=4)
    # Without this, saving in JupyterLab would write the Markdown of the pair.
    stored.metadata.pop("jupytext", None)
    cells = []
    figures = 0
    for cell in stored.cells:
        cells.append(cell)
        if cell.cell_type == "markdown":
            cell.source = plain(cell.source, source.stem, all_names, references)
            continue
        if HIDDEN & set(cell.metadata.get("tags", [])):
            # JupyterLab's own mark for folded code; the book's tags mean nothing to it.
            cell.metadata["jupyter"] = {"source_hidden": True}
        # The caption becomes a cell of text below the figure.
        figure = cell.metadata.get("mystnb", {}).get("figure")
        if figure:
            figures += 1
            name = all_names.figures[
                str(figure.get("name", f"{source.stem}-{figures}"))
            ]
            caption = plain(
                str(figure.get("caption", "")), source.stem, all_names, references
            )
            caption_cell = nbformat.v4.new_markdown_cell(
                f"**{name}** {caption}", id=f"{cell.id}-caption"
            )
            cells.append(caption_cell)
    stored.cells = cells
    return stored


def download(source: Path, all_names: Names, references: BibliographyData) -> Any:
    """Return a chapter as a notebook that is read alone: how to install, and no links to pages."""
    alone = notebook(source, all_names, references)
    for cell in alone.cells:
        if cell.cell_type == "markdown":
            cell.source = LINK.sub(r"\1", cell.source)
    text = INSTALL.format(title=all_names.words[source.stem])
    cell_id = f"{source.stem}-install"
    alone.cells.insert(0, nbformat.v4.new_markdown_cell(text, id=cell_id))
    return alone


def read_references() -> BibliographyData:
    """Return the book's bibliography."""
    return parse_file(str(BOOK / "refs.bib"), bib_format="bibtex")


def downloadable() -> list[Path]:
    """Return the numbered chapters, whose pages offer a notebook."""
    return [source for source in chapters() if chapter_number(f"book/{source.stem}")]


def write_downloads(folder: Path) -> None:
    """Write the notebooks that the pages offer."""
    folder.mkdir(parents=True, exist_ok=True)
    all_names = names([ROOT / f"{page}.md" for page in toc_pages()])
    references = read_references()
    for source in downloadable():
        alone = download(source, all_names, references)
        nbformat.write(alone, folder / f"{source.stem}.ipynb")


def bibliography(references: BibliographyData) -> str:
    """Return the list of references as Markdown."""
    # The style and the order of the book's own bibliography
    style = find_plugin("pybtex.style.formatting", "plain")()
    backend = find_plugin("pybtex.backends", "markdown")()
    entries = sorted(references.entries.values(), key=lambda e: cite(e.key, references))
    lines = [entry.text.render(backend) for entry in style.format_entries(entries)]
    return "# Bibliography\n\n" + "\n".join(f"- {line}" for line in lines) + "\n"


def copy(folder: Path) -> list[Path]:
    """Write the working copy; return its notebooks."""
    pages = [
        ROOT / f"{page}.md" for page in toc_pages() if (ROOT / f"{page}.md").is_file()
    ]
    references = read_references()
    all_names = names(pages)
    book = folder / "book"
    notebooks = []
    book.mkdir(parents=True)
    for source in pages:
        # Pages made by the build are replaced by a text, all others are copied.
        if is_chapter(source):
            target = book / f"{source.stem}.ipynb"
            nbformat.write(notebook(source, all_names, references), target)
            notebooks.append(target)
        elif source.stem == "bibliography":
            (book / source.name).write_text(bibliography(references), encoding="utf-8")
        elif source.stem == "api":
            (book / source.name).write_text(HELP, encoding="utf-8")
        elif source.parent == BOOK:
            text = plain(
                source.read_text(encoding="utf-8"), source.stem, all_names, references
            )
            (book / source.name).write_text(text, encoding="utf-8")
    ignored = shutil.ignore_patterns("__pycache__", ".*")
    # Chapters load these scripts, and the data beside the book.
    for name in ("examples", "studies"):
        shutil.copytree(BOOK / name, book / name, ignore=ignored)
    shutil.copytree(ROOT / "data", folder / "data", ignore=ignored)
    return notebooks


def settings(folder: Path) -> dict[str, str]:
    """Return an environment in which JupyterLab stores its own files in the copy."""
    home = folder / ".jupyter"
    viewers = home / "lab" / "user-settings" / "@jupyterlab" / "docmanager-extension"
    viewers.mkdir(parents=True, exist_ok=True)
    # Pages of text open as text, not as source.
    chosen = {"defaultViewers": {"markdown": "Markdown Preview"}}
    (viewers / "plugin.jupyterlab-settings").write_text(
        json.dumps(chosen), encoding="utf-8"
    )
    return {
        **os.environ,
        "JUPYTER_CONFIG_DIR": str(home / "config"),
        "JUPYTER_DATA_DIR": str(home / "data"),
        "JUPYTERLAB_SETTINGS_DIR": str(home / "lab" / "user-settings"),
        "JUPYTERLAB_WORKSPACES_DIR": str(home / "lab" / "workspaces"),
        "JUPYTER_PREFER_ENV_PATH": "1",
    }


def trust(notebooks: list[Path], environment: dict[str, str]) -> None:
    """Sign the notebooks, so that their sliders work before a cell is run."""
    data = Path(environment["JUPYTER_DATA_DIR"])
    data.mkdir(parents=True, exist_ok=True)
    # JupyterLab sanitises the HTML of an unsigned notebook: sliders would not move.
    notary = NotebookNotary(data_dir=str(data))
    for path in notebooks:
        notary.sign(nbformat.read(path, as_version=4))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description="JupyterLab on a working copy of the book."
    )
    parser.add_argument("folder", type=Path, help="where the copy is, or is made")
    parser.add_argument("--no-open", action="store_true", help="make the copy only")
    options = parser.parse_args(arguments)
    folder = options.folder.resolve()
    # The copy must not replace the repository, or lie within the book.
    if folder in (ROOT, *ROOT.parents) or folder.is_relative_to(BOOK):
        parser.error(f"{options.folder}: would be written over the repository")
    # A folder with a book is an existing copy, and stays as it is.
    environment = settings(folder) if (folder / "book").is_dir() else {}
    if environment:
        print(
            f"The existing working copy: {folder}\nFor a new one: make lab LAB=another/folder"
        )
    elif folder.is_dir() and any(folder.iterdir()):
        parser.error(f"{options.folder}: is not empty and holds no working copy")
    else:
        notebooks = copy(folder)
        environment = settings(folder)
        trust(notebooks, environment)
        print(f"A working copy: {folder}")
    if options.no_open:
        return 0
    command = [sys.executable, "-m", "jupyterlab", f"--notebook-dir={folder / 'book'}"]
    return subprocess.call(command, env=environment)


if __name__ == "__main__":
    sys.exit(main())
