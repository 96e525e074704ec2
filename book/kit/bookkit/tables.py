"""Tables of results, rendered on a page and compared as text."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape

import pandas as pd

__all__ = ["ResultTable", "finish_table"]


def finish_table(page: str, caption: str) -> str:
    """Return a table's HTML with a caption before its head, and ``*words*`` in italics.

    >>> finish_table("<table><thead></thead></table>", "Errors in *range*")
    '<table><caption>Errors in <em>range</em></caption>\\n<thead></thead></table>'
    """
    # pandas has no caption; a page expects it before the head.
    head = f"<caption>{escape(caption)}</caption>\n<thead>"
    page = page.replace("<thead>", head, 1)
    return re.sub(r"\*(\w+)\*", r"<em>\1</em>", page)


@dataclass(frozen=True, eq=False, repr=False)
class ResultTable:
    """A table of results: numbers in a given form, the best of a column in bold.

    Parameters
    ----------
    frame : DataFrame
        Its index is the table's first column. Texts are shown as they are.
    form : mapping, optional
        Format specification of each column's numbers, such as ``".2f"``.
    best : mapping, optional
        ``"min"`` or ``"max"`` for each column whose best number is shown in bold.
    caption : str
        Caption, with units.

    Examples
    --------
    >>> rows = pd.DataFrame({"error, m": [0.5234, 0.4]}, index=["alone", "fused"])
    >>> ResultTable(rows, form={"error, m": ".2f"}, best={"error, m": "min"})
          error, m
    alone     0.52
    fused     0.40
    """

    frame: pd.DataFrame
    form: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    best: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    caption: str = field(default="", kw_only=True)

    def _format(self, name: str) -> list[str]:
        """Return the texts of a column."""
        form = self.form.get(name, "")
        return [v if isinstance(v, str) else format(v, form) for v in self.frame[name]]

    def __repr__(self) -> str:
        texts = self.frame.assign(**{name: self._format(name) for name in self.form})
        return "\n".join(filter(None, [self.caption, texts.to_string()]))

    def _repr_html_(self) -> str:
        cells = {}
        for name in self.frame:
            # The smallest or largest number of a column, which is set in bold
            best = self.frame[name].agg(self.best[name]) if name in self.best else None
            # Ties are all bold.
            pairs = zip(self.frame[name], map(escape, self._format(name)), strict=True)
            cells[name] = [f"<b>{t}</b>" if value == best else t for value, t in pairs]
        page = self.frame.assign(**cells).to_html(escape=False, border=0)
        return finish_table(str(page), self.caption)
