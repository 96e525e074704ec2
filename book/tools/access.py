"""Accessible pages: repairs of the built HTML, and rules that each page must satisfy."""

from __future__ import annotations

import re
from pathlib import Path

MENDS = (
    # The corner of a table is no header.
    ("<th></th>", "<td></td>"),
    ('<th class="head"><p></p></th>', "<td></td>"),
    # The name of a control is its visible text; a control that shows only an arrow needs a name.
    ('<summary aria-label="Toggle hidden content">', "<summary>"),
    (' title="Search" aria-label="Search" data-bs-placement', " data-bs-placement"),
    ("<summary><span", '<summary aria-label="Pages below"><span'),
    # The columns of the index are layout, not a table.
    ('class="indextable', 'role="presentation" class="indextable'),
    # All exercises have texts of the same id.
    (' id="exercise-content"', ""),
    (' id="solution-content"', ""),
    (' valign="top"', ""),
)
BRAND = re.compile(r'<div class="[^"]*">(?=\s*<a class="navbar-brand logo")')
"""The box of the book's name in the left sidebar, which is in no landmark."""

RULES = Path(__file__).with_suffix(".js").read_text(encoding="utf-8")
"""A script that returns the violations on an open page."""


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
