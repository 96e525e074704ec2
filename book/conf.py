"""Configuration of Sphinx: the book is built from stored outputs, without a network.

A figure of a chapter needs an alternative text, a caption and a name in the header of its cell:

    ```{code-cell} ipython3
    ---
    mystnb:
      image:
        alt: Two curves; the error of A falls to 0.2 m, that of B stays at 3 m.
      figure:
        caption: Error of agents A and B.
        name: fig-errors
    ---
    fig, ax = plt.subplots()
    ```
"""

from __future__ import annotations

import shutil
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.environment.collectors.toctree import TocTreeCollector
from sphinx.errors import ExtensionError
from sphinx.util.nodes import make_refnode
from sphinx_proof.domain import ProofDomain

sys.path.insert(0, str(Path(__file__).parent / "tools"))

import distfilt
from access import mend
from common import BOOK, ROOT, chapters, missing_pages
from lab import downloadable, write_downloads
from light import lighten
from pages import (
    chapter_label,
    chapter_number,
    code_of,
    drop_widgets,
    escape_stars,
    homes,
    imports_of,
    keep_sliders,
    link_code,
    number_chapters,
    signature,
    simplify_signatures,
    write_generated,
)

project = "Distributed Nonlinear Filtering"
author = "The distfilt authors"
copyright = "2026, The distfilt authors"
language = "en"
version = release = distfilt.__version__

extensions = [
    "myst_nb",
    "sphinx_external_toc",
    "sphinx_design",
    "sphinx_copybutton",
    "sphinx_togglebutton",
    "sphinx_proof",
    "sphinx_exercise",
    "sphinxcontrib.bibtex",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "numpydoc",
]

# Pages are in book/ only. A chapter is read from its notebook, not from its Markdown file.
external_toc_path = "_toc.yml"
external_toc_exclude_missing = False
include_patterns = ["book/**"]
exclude_patterns = [
    "book/_generated/**",
    "book/course/**",
    "book/examples/**",
    "book/tools/**",
    "**/.ipynb_checkpoints",
    *(p.with_suffix(".md").relative_to(ROOT).as_posix() for p in BOOK.glob("*.ipynb")),
]

# The pages show the stored outputs of notebooks; `make outputs` executes them.
nb_execution_mode = "off"
nb_merge_streams = True
nb_number_source_lines = False
nb_ipywidgets_js: dict[str, Any] = {}
nb_mime_priority_overrides = [
    ("html", "application/vnd.jupyter.widget-view+json", None)
]
# A verdict is shown as text or HTML; its JSON form is for the ledger.
suppress_warnings = ["mystnb.unknown_mime_type"]
myst_enable_extensions = [
    "amsmath",
    "attrs_block",
    "attrs_inline",
    "colon_fence",
    "deflist",
    "dollarmath",
    "fieldlist",
]
myst_heading_anchors = 3
myst_dmath_double_inline = True

# Numbers: (4.1) and Fig. 4.1 start with the number in the chapter's file name, and are counted
# through both pages of a chapter that has two. The title of a second page is numbered 1b.
numfig = True
numfig_secnum_depth = 1
numfig_format = {"figure": "Fig. %s", "table": "Table %s", "code-block": "Listing %s"}
math_eqref_format = "({number})"
math_numfig = True

bibtex_bibfiles = ["refs.bib"]
bibtex_reference_style = "author_year"
bibtex_default_style = "plain"

# Every name is documented in the module that defines it, not where it is imported.
viewcode_follow_imported_members = False

autodoc_typehints = "signature"
toc_object_entries_show_parents = "hide"
add_module_names = False
autodoc_member_order = "bysource"
autodoc_type_aliases = {"Array": "Array", "ArrayLike": "ArrayLike"}
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 72
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

# A broken reference stops the build. These names belong to other packages.
nitpicky = True
OUTSIDE = (
    r"(np|numpy|scipy|xr|xarray|collections|typing|types|functools|pathlib|os|random)\..*",
    r"Any|Array(Like)?|NDArray|Callable|Generator|Hashable|I?ter\w+|Literal|Mapping|Path|Sequence",
    r"S|T|P|R|_OnePrior|Gaussians|ellipsis|AnyState|ShapeNames|Dataset|DataArray|Protocol|PathLike|cs[cr]_array|dtype|module|F|Self|.*\.F|-?\d.*",
)
nitpick_ignore_regex = [("py:.*", "|".join(OUTSIDE))]

# Mathematics without a network: MathJax 3 is copied from a Python package at the end of a build.
mathjax_path = "mathjax/tex-mml-chtml.js"
mathjax3_config = {
    "tex": {"tags": "none"},
    "chtml": {"mtextInheritFont": True},
    "options": {"enableMenu": False},
}

html_theme = "sphinx_book_theme"
html_title = project
html_static_path = ["_static"]
html_css_files = ["book.css"]
html_js_files = ["scroll.js"]
html_favicon = "_static/mark.svg"
html_logo = "_static/mark.svg"
html_search_scorer = str(Path(__file__).parent / "_static" / "search.js")
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_context = {"default_mode": "light"}
WIDE = ("index", "which-filter", "api", "reproductions", "errata", "gallery")
html_theme_options = {
    "logo": {
        "text": project,
        "alt_text": "Distributed Nonlinear Filtering, first page",
    },
    "home_page_in_toc": False,
    "show_navbar_depth": 1,
    "show_toc_level": 2,
    "use_download_button": False,
    "use_fullscreen_button": False,
    "use_issues_button": False,
    "use_repository_button": False,
    "use_source_button": False,
    # Pages of wide tables and long lines have no sidebar on the right.
    "secondary_sidebar_items": {
        "**": ["page-toc"],
        **{f"book/{page}": [] for page in WIDE},
    },
}
pygments_style = "tango"
copybutton_exclude = ".linenos, .gp, .go"
togglebutton_hint = "Show"
togglebutton_hint_hide = "Hide"


def check_toc(app: Sphinx) -> None:
    """Stop the build if a page of the table of contents has no file."""
    # Sphinx alone would only warn, and build a book with a hole.
    missing = missing_pages()
    if missing:
        raise ExtensionError(
            f"_toc.yml names pages that do not exist: {', '.join(missing)}"
        )


def copy_mathjax(app: Sphinx, error: Exception | None) -> None:
    """Copy MathJax, its fonts and its TeX extensions into the built book."""
    if error is not None:
        return
    spec = find_spec("sphinx-mathjax-offline")
    if spec is None or spec.origin is None:
        raise ExtensionError("sphinx-mathjax-offline is not installed: no mathematics")
    # The package is an extension with MathJax beside its code; only the files are used.
    source = Path(spec.origin).parent / "static" / "mathjax"
    target = Path(app.outdir) / "_static" / "mathjax"
    # Only output as CHTML with its fonts, TeX's extensions, and speech for readers who
    # do not see
    for part in (
        "tex-mml-chtml.js",
        "output/chtml/fonts",
        "input/tex/extensions",
        "a11y",
        "sre",
    ):
        if (source / part).is_dir():
            shutil.copytree(source / part, target / part, dirs_exist_ok=True)
        else:
            (target / part).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source / part, target / part)


def find_name(app: Sphinx, env: Any, node: Any, text: Any) -> Any:
    """Resolve a name to its entry: a full path, a path below the package, or the name alone."""
    if node.get("refdomain") != "py":
        return None
    entries = env.domains.python_domain.objects
    target = node["reftarget"].removeprefix("~")
    # A name may be written by any path from which it can be imported.
    entry_of = {**env.distfilt_homes, **{path: path for path in entries}}
    # As written, below the package, beside the page's module, beside its class.
    qualified = f"distfilt.{target}"
    module = node.get("py:module") or ""
    paths = [
        target,
        qualified,
        f"{module}.{target}",
        f"{module}.{node.get('py:class')}.{target}",
    ]
    matches = [entry_of[path] for path in paths if path in entry_of]
    # A method such as Filter.run: the class is found first.
    owner, _, member = target.rpartition(".")
    matches += [
        f"{entry_of[path]}.{member}"
        for path in (owner, f"distfilt.{owner}")
        if path in entry_of
    ]
    # At last the bare name anywhere; sorted, so that every build takes the same one.
    matches += sorted(
        {entry_of[path] for path in entry_of if path.endswith(f".{target}")}
    )
    if not matches or matches[0] not in entries:
        return None
    entry = entries[matches[0]]
    return make_refnode(
        app.builder, node["refdoc"], entry.docname, entry.node_id, text, matches[0]
    )


def link_names(
    app: Sphinx, page: str, template: str, context: dict[str, Any], tree: Any
) -> None:
    """Link the library's names in a chapter's code to their entries."""
    source = ROOT / f"{page}.md"
    if page.startswith("book/api"):
        context["body"] = simplify_signatures(context["body"])
    # Only cells of chapters have code with imports.
    if source not in chapters():
        return
    objects = app.env.domains.python_domain.objects

    def url(path: str) -> str | None:
        entry = objects.get(app.env.distfilt_homes.get(path, path))
        # A link that works from this page, wherever the book is stored.
        address = entry and app.builder.get_relative_uri(page, entry.docname)
        return f"{address}#{entry.node_id}" if entry else None

    offer = (
        f'<p class="notebook"><a href="_notebooks/{source.stem}.ipynb" download>'
        "Download this page as a notebook</a></p>"
    )
    if source in downloadable():
        context["body"] = context["body"].replace("</h1>", f"</h1>\n{offer}", 1)
    names = imports_of(code_of(source), app.env.distfilt_homes)
    context["body"] = link_code(context["body"], names, url)


def write_notebooks(app: Sphinx, error: Exception | None) -> None:
    """Write the notebooks beside their pages, for download."""
    if error is None and app.builder.name == "html":
        write_downloads(Path(app.outdir) / "book" / "_notebooks")


def finish(app: Sphinx, error: Exception | None) -> None:
    """Make the written pages smaller and accessible."""
    if error is None and app.builder.name == "html":
        lighten(Path(app.outdir))
        for page in Path(app.outdir).rglob("*.html"):
            mend(page)


def setup(app: Sphinx) -> None:
    # Sphinx numbers figures by a collector, which has no event to listen to.
    number_figures = TocTreeCollector.assign_figure_numbers

    def with_chapter_numbers(self: Any, env: Any) -> list[str]:
        # Both pages of a chapter count with its number, then get labels such as 1b.
        number_chapters(env, chapter_number)
        renumbered = number_figures(self, env)
        number_chapters(env, chapter_label)
        return renumbered

    TocTreeCollector.assign_figure_numbers = with_chapter_numbers  # type: ignore[method-assign]
    # It counts sections when all pages are read, so pages may be read in parallel; it does not say
    # so itself.
    app.extensions["sphinx_multitoc_numbering"].parallel_read_safe = True
    # Proofs of pages that were read in parallel are merged by an event; the domain has no data.
    ProofDomain.merge_domaindata = lambda self, pages, other: None
    app.connect("builder-inited", check_toc)
    app.connect("builder-inited", lambda app: write_generated(BOOK / "_generated"))
    app.connect(
        "builder-inited", lambda app: setattr(app.env, "distfilt_homes", homes())
    )
    app.connect("missing-reference", find_name)
    app.connect("html-page-context", link_names)
    app.connect("doctree-read", lambda app, tree: drop_widgets(tree))
    app.connect("doctree-read", lambda app, tree: keep_sliders(tree))
    app.connect("autodoc-process-docstring", lambda *event: escape_stars(event[-1]))
    app.connect(
        "autodoc-process-signature", lambda *event: signature(event[1], event[3])
    )
    app.connect("build-finished", copy_mathjax)
    app.connect("build-finished", write_notebooks)
    app.connect("build-finished", finish)
