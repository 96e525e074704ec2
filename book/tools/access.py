"""Pages that everybody can use: what builders leave undone, and rules that a page has to keep."""

from __future__ import annotations

import re
from pathlib import Path

MENDS = (
    # The corner of a table heads nothing.
    ("<th></th>", "<td></td>"),
    ('<th class="head"><p></p></th>', "<td></td>"),
    # A control is called what it shows, and one that shows an arrow alone has a name.
    ('<summary aria-label="Toggle hidden content">', "<summary>"),
    (' title="Search" aria-label="Search" data-bs-placement', " data-bs-placement"),
    ("<summary><span", '<summary aria-label="Pages below"><span'),
    # Columns of the index are no table.
    ('class="indextable', 'role="presentation" class="indextable'),
    # An exercise's text has the same id as the next one's.
    (' id="exercise-content"', ""),
    (' id="solution-content"', ""),
    (' valign="top"', ""),
)
BRAND = re.compile(r'<div class="[^"]*">(?=\s*<a class="navbar-brand logo")')
"""Around the book's name in the bar on the left, which no landmark holds."""

RULES = Path(__file__).with_suffix(".js").read_text(encoding="utf-8")
"""A script that returns what is wrong on an open page."""


def mend(page: Path) -> None:
    """Write a built page again with what its makers left undone."""
    before = page.read_text(encoding="utf-8")
    text = before
    for old, new in MENDS:
        text = text.replace(old, new)
    text = BRAND.sub('<div class="sidebar-primary-item" role="banner">', text)
    if text != before:
        page.write_text(text, encoding="utf-8")
