"""Verdicts: does our number, table or figure say what the paper's says, by a rule fixed before."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..checks import choice, number
from ._files import html_table
from .specs import AgentSpec
from .tables import PAPERS, Item, Table, items, table

__all__ = [
    "VERDICTS",
    "Claim",
    "Value",
    "Verdict",
    "judge_claims",
    "judge_parameters",
    "judge_table",
    "judge_value",
]

VERDICTS = ("match", "differs", "not comparable")
"""What a chapter can find; an item without a verdict is "not yet" in the ledger."""

_MIME = "application/vnd.distfilt.verdict+json"


def _item(paper: Any, item: Any) -> Item:
    found = {i.item: i for i in items() if i.paper == choice(paper, "paper", PAPERS)}
    return found[choice(item, "item", found)]


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"{name}: needs a text, got {value!r}")
    return value


@dataclass(frozen=True)
class Verdict:
    """What came of reproducing one item; a notebook shows it and the ledger collects it.

    Parameters
    ----------
    paper, item : str
        One of `items`.
    verdict : {"match", "differs", "not comparable"}
        The finding.
    ours, published : str
        What we find and what the paper prints.
    why : str
        Needed unless it is a match: the reason why it differs, or the input that the paper does
        not give.

    Examples
    --------
    >>> print(Verdict("grange", "Table I", "match", "4 rows read", "4 rows"))
    grange Table I: match
      ours       4 rows read
      published  4 rows
    """

    paper: str
    item: str
    verdict: str
    ours: str
    published: str
    why: str = ""

    def __post_init__(self) -> None:
        _item(self.paper, self.item)
        choice(self.verdict, "verdict", VERDICTS)
        _text(self.ours, "ours")
        _text(self.published, "published")
        if self.verdict != "match" or self.why != "":
            _text(self.why, "why")

    def _fields(self) -> list[tuple[str, str]]:
        pairs = [("ours", self.ours), ("published", self.published), ("why", self.why)]
        return [(name, text) for name, text in pairs if text]

    def __str__(self) -> str:
        head = f"{self.paper} {self.item}: {self.verdict}"
        return "\n".join([head, *(f"  {name:<9}  {text}" for name, text in self._fields())])

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, Any]:
        head = (f"{self.paper} {self.item}", self.verdict)
        names = ("paper", "item", "verdict", "ours", "published", "why")
        return {
            "text/plain": str(self),
            "text/html": html_table(head, self._fields()),
            _MIME: {name: getattr(self, name) for name in names},
        }


def _judged(item: Item, matches: bool, ours: str, published: str, why: str) -> Verdict:
    """A match or a difference; the reason is only used, and only needed, for a difference."""
    if matches:
        return Verdict(item.paper, item.item, "match", ours, published)
    return Verdict(item.paper, item.item, "differs", ours, published, why)


def judge_value(ours: float, error: float, published: float, *, tolerance: float = 0.0) -> bool:
    r"""Whether our value matches the published one.

    :math:`|\text{ours}-\text{published}|\le\max(2\,\text{error},\text{tolerance})`: the larger of
    two standard errors and a tolerance. The maximum, not the sum, so that neither rule loosens the
    other. The tolerance, such as half a unit of the last printed digit, is fixed in the published
    CSV before our number is known.

    Parameters
    ----------
    ours : float
        Our value.
    error : float
        Its standard error, at least 0.
    published : float
        The value as printed.
    tolerance : float
        At least 0.

    Examples
    --------
    >>> judge_value(1.2, 0.1, 1.0), judge_value(1.3, 0.1, 1.0)
    (True, False)
    """
    gap = abs(number(ours, "ours") - number(published, "published"))
    return gap <= max(
        2 * number(error, "error", at_least=0), number(tolerance, "tolerance", at_least=0)
    )


@dataclass(frozen=True)
class Value:
    """One number of a table beside its reproduction.

    Parameters
    ----------
    id : str
        Its row and column, in words.
    ours, error, published, tolerance : float
        As of `judge_value`.

    Examples
    --------
    >>> print(Value("C1, agent 1", 0.0899, 0.0004, 0.0896))
    C1, agent 1: 0.0899 ± 0.0004 (published 0.0896)
    """

    id: str
    ours: float
    error: float
    published: float
    tolerance: float = 0.0

    def __post_init__(self) -> None:
        _text(self.id, "id")
        judge_value(self.ours, self.error, self.published, tolerance=self.tolerance)

    @property
    def matches(self) -> bool:
        """Whether it matches, by `judge_value`."""
        return judge_value(self.ours, self.error, self.published, tolerance=self.tolerance)

    def __str__(self) -> str:
        return f"{self.id}: {self.ours:.4g} ± {self.error:.1g} (published {self.published:.4g})"


def _distinct(ids: Sequence[str], name: str) -> None:
    if not ids:
        raise ValueError(f"{name}: needs at least one entry, got none")
    if len(set(ids)) != len(ids):
        twice = sorted({i for i in ids if ids.count(i) > 1})
        raise ValueError(f"{name}: needs distinct entries, got {', '.join(twice)} more than once")


def judge_table(paper: str, item: str, values: Sequence[Value], *, why: str = "") -> Verdict:
    """The verdict on a table of numbers: a match if every value matches.

    Parameters
    ----------
    paper, item : str
        One of `items`.
    values : sequence of Value
        Every number of the table.
    why : str
        Why it differs; needed and used only if it does.

    Returns
    -------
    Verdict
        With the number of values that match, and those that do not.

    Examples
    --------
    >>> one = Value("C1", 0.0899, 0.0004, 0.0896)
    >>> judge_table("semeraro", "Table 1", [one]).verdict
    'match'
    """
    known = _item(paper, item)
    if not all(isinstance(v, Value) for v in values):
        raise ValueError("values: needs a sequence of Value")
    _distinct([v.id for v in values], "values")
    missed = [str(v) for v in values if not v.matches]
    ours = f"{len(values) - len(missed)} of {len(values)} values match"
    return _judged(known, not missed, "; ".join([ours, *missed]), f"{len(values)} values", why)


@dataclass(frozen=True)
class Claim:
    """One claim that a figure's caption or text makes, judged by our computation.

    Parameters
    ----------
    id : str
        Its key in ``published/KEY/figure-N.csv``.
    text : str
        What we computed for it, in words.
    holds : bool
        Whether its criterion is met.
    evidence : str
        The numbers, with their interval.

    Examples
    --------
    >>> print(Claim("pca-stable", "share of unstable runs", True, "0 [0, 0.0362]"))
    pca-stable holds: share of unstable runs 0 [0, 0.0362]
    """

    id: str
    text: str
    holds: bool
    evidence: str

    def __post_init__(self) -> None:
        for name in ("id", "text", "evidence"):
            _text(getattr(self, name), name)
        if not isinstance(self.holds, bool | np.bool_):
            raise ValueError(f"holds: needs True or False, got {self.holds!r}")

    def __str__(self) -> str:
        word = "holds" if self.holds else "fails"
        return f"{self.id} {word}: {self.text} {self.evidence}"


def judge_claims(paper: str, item: str, claims: Sequence[Claim], *, why: str = "") -> Verdict:
    """The verdict on a figure: a match if every claim listed for it is judged and holds.

    Parameters
    ----------
    paper, item : str
        One of `items`; its claims are listed in ``published/KEY/figure-N.csv``.
    claims : sequence of Claim
        Every listed claim, once.
    why : str
        Why it differs; needed and used only if a claim fails.

    Returns
    -------
    Verdict

    Raises
    ------
    ValueError
        If a claim is not listed, a listed one is missing, or its criterion is still open.

    Examples
    --------
    >>> judged = [
    ...     Claim("without-pca-unstable", "share of unstable runs", False, "0 [0, 0.0362]"),
    ...     Claim("pca-stable", "share of unstable runs", True, "0.02 [0.00243, 0.0704]"),
    ... ]
    >>> judge_claims("grange", "Fig. 1", judged, why="a run must exceed the prior").verdict
    'differs'
    """
    known = _item(paper, item)
    if not all(isinstance(c, Claim) for c in claims):
        raise ValueError("claims: needs a sequence of Claim")
    _distinct([c.id for c in claims], "claims")
    listed = {r["id"]: r for r in _claims_of(known).records()}
    unknown = [c.id for c in claims if c.id not in listed]
    missing = sorted(listed.keys() - {c.id for c in claims})
    if unknown or missing:
        raise ValueError(
            f"claims: needs those listed for {paper} {item} ({', '.join(listed)}); "
            f"unknown: {', '.join(unknown) or 'none'}; not judged: {', '.join(missing) or 'none'}"
        )
    undecided = [i for i, row in listed.items() if row["criterion"].startswith("open:")]
    if undecided:
        raise ValueError(f"claims: needs a fixed criterion, open for {', '.join(undecided)}")
    ours = "; ".join(str(c) for c in claims)
    said = "; ".join(row["claim"] for row in listed.values())
    return _judged(known, all(c.holds for c in claims), ours, said, why)


def _claims_of(item: Item) -> Table:
    found = table(item.paper, item.file)
    if found.columns != ("id", "claim", "criterion"):
        raise ValueError(f"item: needs one with claims, got {item.paper} {item.item}")
    return found


def judge_parameters(
    paper: str, item: str, read: Sequence[AgentSpec] | Sequence[Mapping[str, str]]
) -> Verdict:
    """The verdict on a table of parameters: a match if the study read the rows as printed.

    Rows are paired by the first column, and cells compared as numbers where both are numbers, else
    as text without spaces.

    Parameters
    ----------
    paper, item : str
        One of `items`.
    read : sequence of AgentSpec or of mappings
        What the study read: a scenario's agents, or rows from column to cell.

    Returns
    -------
    Verdict
        If it differs, the first difference is the reason.

    Examples
    --------
    >>> from distfilt.published import scenario
    >>> judge_parameters("grange", "Table II", scenario("grange", "table-2").agents).verdict
    'match'
    """
    known = _item(paper, item)
    printed = table(paper, known.file)
    rows = [_row(entry) for entry in read]
    for row in rows:
        if row.keys() != set(printed.columns):
            raise ValueError(
                f"read: needs the columns {', '.join(printed.columns)}, got {', '.join(row)}"
            )
    first = printed.columns[0]
    _distinct([row[first] for row in rows], "read")
    why = _first_difference(rows, printed)
    ours, published = f"{len(rows)} rows read", f"{len(printed)} rows printed"
    return _judged(known, not why, ours, published, why)


def _row(entry: Any) -> dict[str, str]:
    if isinstance(entry, Mapping):
        return {str(k): str(v) for k, v in entry.items()}
    if not isinstance(entry, AgentSpec):
        raise ValueError(f"read: needs agents or rows, got {type(entry).__name__}")
    return {
        "agent": entry.name,
        "dimensions": str(list(entry.dims)),
        "type": entry.kind,
        "noise": str(entry.noise),
        "neighbours": f"[{','.join(entry.neighbours)}]",
    }


def _same(a: str, b: str) -> bool:
    try:
        return float(a) == float(b)
    except ValueError:
        return re.sub(r"\s+", "", a) == re.sub(r"\s+", "", b)


def _first_difference(rows: list[dict[str, str]], printed: Table) -> str:
    """The first cell that was read otherwise than printed, or nothing."""
    first = printed.columns[0]
    by_key = {row[first]: row for row in rows}
    for wanted in printed.records():
        key = wanted[first]
        if key not in by_key:
            return f"row {key} is printed but was not read"
        for column in printed.columns:
            got = by_key[key][column]
            if not _same(got, wanted[column]):
                return f"row {key}, {column}: read {got}, printed {wanted[column]}"
    extra = [key for key in by_key if key not in printed.text(first)]
    return f"row {extra[0]} was read but is not printed" if extra else ""
