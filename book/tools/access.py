"""Accessible pages: repairs of the built HTML, and rules that each page must satisfy."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

MENDS = (
    # The corner of a table is no header.
    ("<th></th>", "<td></td>"),
    ('<th class="head"><p></p></th>', "<td></td>"),
    # The name of a control is its visible text; one that shows only a picture needs a name. On a
    # narrow screen the search button is one.
    ('<summary aria-label="Toggle hidden content">', "<summary>"),
    (
        ' title="Search" aria-label="Search" data-bs-placement',
        ' aria-label="Search Ctrl+K" data-bs-placement',
    ),
    ("<summary><span", '<summary aria-label="Pages below"><span'),
    # The columns of the index are layout, not a table.
    ('class="indextable', 'role="presentation" class="indextable'),
    # Entries of the bibliography stand in a list; only its items may have the old role.
    ('role="doc-biblioentry"', 'role="listitem"'),
    # All exercises have texts of the same id.
    (' id="exercise-content"', ""),
    (' id="solution-content"', ""),
    (' valign="top"', ""),
)
BRAND = re.compile(r'<div class="[^"]*">(?=\s*<a class="navbar-brand logo")')
"""The box of the book's name in the left sidebar, which is in no landmark."""

RULES = Path(__file__).with_suffix(".js").read_text(encoding="utf-8")
"""A script that returns the violations on an open page, on which axe-core is loaded."""


def read_axe() -> str:
    """Return the script of axe-core, which a Python package has beside its code."""
    spec = find_spec("axe_playwright_python")
    if spec is None or spec.origin is None:
        raise FileNotFoundError("axe-playwright-python is not installed")
    return Path(spec.origin).with_name("axe.min.js").read_text(encoding="utf-8")


def find_violations(driver: Any, theme: str) -> list[str]:
    """Return what breaks a rule on the open page; its formulas become empty boxes."""
    if not driver.execute_script("return typeof axe === 'object'"):
        driver.execute_script(read_axe())
    return list(driver.execute_async_script(RULES, theme))


def mend(page: Path) -> None:
    """Repair a built page in place."""
    before = page.read_text(encoding="utf-8")
    text = before
    for old, new in MENDS:
        text = text.replace(old, new)
    text = BRAND.sub('<div class="sidebar-primary-item" role="banner">', text)
    # An unchanged page keeps its date.
    if text != before:
        page.write_text(text, encoding="utf-8")
