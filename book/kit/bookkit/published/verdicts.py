"""Verdicts: does our number, table or figure say what the paper's says, by a rule fixed before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from distfilt.checks import choice, instance, nonblank, number

from ._files import html_table
from .specs import Scenario
from .tables import PAPERS, Item, Table, items, table

__all__ = [  # fmt: skip
    "VERDICTS", "Claim", "Value", "Verdict", "judge_claims", "judge_table", "judge_value",
]

VERDICTS = ("read", "match", "differs", "not comparable")
"""What a chapter can find; an item without a verdict is "not yet" in the ledger.

``"read"`` is for a table of parameters, ``"match"`` for results: a study that read its parameters
has reproduced nothing yet.
"""

_MIME = "application/vnd.distfilt.verdict+json"


def known_item(paper: Any, item: Any) -> Item:
    found = {i.item: i for i in items() if i.paper == choice(paper, "paper", PAPERS)}
    return found[choice(item, "item", found)]


@dataclass(frozen=True)
class Verdict:
    """What came of reproducing one item; a notebook shows it and the ledger collects it.

    Parameters
    ----------
    paper, item : str
        One of `items`.
    verdict : {"read", "match", "differs", "not comparable"}
        The finding: "read" only for an item of kind "parameters", "match" only for results.
    ours, published : str
        What we find and what the paper prints.
    why : str
        Needed if it differs or is not comparable: the reason, or the input that the paper does
        not give.

    Examples
    --------
    >>> print(Verdict("grange", "Table I", "read", "4 rows read", "4 rows"))
    grange Table I: read
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
        kind = known_item(self.paper, self.item).kind
        other = "match" if kind == "parameters" else "read"
        choice(self.verdict, "verdict", [v for v in VERDICTS if v != other])
        nonblank(self.ours, "ours")
        nonblank(self.published, "published")
        if self.verdict in ("differs", "not comparable") or self.why != "":
            nonblank(self.why, "why")

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


def judged(item: Item, good: bool, ours: str, published: str, why: str, study: Any) -> Verdict:
    """What was found, unless the study was another one; the reason is needed for a difference."""
    named = (item.paper, item.item)
    instance(why, "why", str)
    if study is not None and not isinstance(study, Scenario):
        raise ValueError(f"scenario: needs a Scenario, got {type(study).__name__}")
    if study is not None and study.changed:
        reason = "changed scenario: " + "; ".join(study.changes)
        return Verdict(*named, "not comparable", ours, published, reason)
    if good:
        word = "read" if item.kind == "parameters" else "match"
        return Verdict(*named, word, ours, published)
    return Verdict(*named, "differs", ours, published, why)


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
        nonblank(self.id, "id")
        judge_value(self.ours, self.error, self.published, tolerance=self.tolerance)

    @property
    def matches(self) -> bool:
        """Whether it matches, by `judge_value`."""
        return judge_value(self.ours, self.error, self.published, tolerance=self.tolerance)

    def __str__(self) -> str:
        return f"{self.id}: {self.ours:.4g} ± {self.error:.1g} (published {self.published:.4g})"


def distinct(ids: Sequence[str], name: str) -> None:
    if not ids:
        raise ValueError(f"{name}: needs at least one entry, got none")
    if len(set(ids)) != len(ids):
        twice = sorted({i for i in ids if ids.count(i) > 1})
        raise ValueError(f"{name}: needs distinct entries, got {', '.join(twice)} more than once")


def judge_table(
    paper: str, item: str, values: Sequence[Value], *, why: str = "",
    scenario: Scenario | None = None,
) -> Verdict:
    """The verdict on a table of numbers: a match if every value matches; it lists the others.

    Parameters
    ----------
    paper, item : str
        One of `items`.
    values : sequence of Value
        Every number of the table.
    why : str
        Why it differs; needed and used only if it does.
    scenario : Scenario, optional
        What the study ran; if it is not the paper's, the verdict is "not comparable" and names
        what was changed.

    Examples
    --------
    >>> one = Value("C1", 0.0899, 0.0004, 0.0896)
    >>> judge_table("semeraro", "Table 1", [one]).verdict
    'match'
    """
    known = known_item(paper, item)
    if not np.iterable(values) or not all(isinstance(v, Value) for v in values):
        raise ValueError("values: needs a sequence of Value")
    distinct([v.id for v in values], "values")
    missed = [str(v) for v in values if not v.matches]
    ours = f"{len(values) - len(missed)} of {len(values)} values match"
    shown, said = "; ".join([ours, *missed]), f"{len(values)} values"
    return judged(known, not missed, shown, said, why, scenario)


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
            nonblank(getattr(self, name), name)
        if not isinstance(self.holds, bool | np.bool_):
            raise ValueError(f"holds: needs True or False, got {self.holds!r}")

    def __str__(self) -> str:
        word = "holds" if self.holds else "fails"
        return f"{self.id} {word}: {self.text} {self.evidence}"


def judge_claims(
    paper: str, item: str, claims: Sequence[Claim], *, why: str = "",
    scenario: Scenario | None = None,
) -> Verdict:
    """The verdict on a figure: a match if every claim listed for it is judged and holds.

    Parameters
    ----------
    paper, item : str
        One of `items`; its claims are listed in ``published/KEY/figure-N.csv``.
    claims : sequence of Claim
        Every listed claim, once; none may have its criterion open.
    why : str
        Why it differs; needed and used only if a claim fails.
    scenario : Scenario, optional
        What the study ran, as of `judge_table`.

    Examples
    --------
    >>> judged = [
    ...     Claim("without-pca-unstable", "share of unstable runs", False, "0 [0, 0.0362]"),
    ...     Claim("pca-stable", "share of unstable runs", True, "0.02 [0.00243, 0.0704]"),
    ...     Claim("small-samples", "difference of shares", False, "0.05 [-0.03, 0.13]"),
    ... ]
    >>> judge_claims("grange", "Fig. 1", judged, why="a run must exceed the prior").verdict
    'differs'
    """
    known = known_item(paper, item)
    if not np.iterable(claims) or not all(isinstance(c, Claim) for c in claims):
        raise ValueError("claims: needs a sequence of Claim")
    distinct([c.id for c in claims], "claims")
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
    return judged(known, all(c.holds for c in claims), ours, said, why, scenario)


def _claims_of(item: Item) -> Table:
    found = table(item.paper, item.file)
    if found.columns != ("id", "claim", "criterion"):
        raise ValueError(f"item: needs one with claims, got {item.paper} {item.item}")
    return found
