"""Published values, and verdicts on our reproductions by rules that were fixed before."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .folders import data_root, inside
from .rows import html_table, read_rows
from .scenarios import Scenario, read_scenario, scenario

__all__ = [
    "PAPERS",
    "VERDICTS",
    "Claim",
    "Item",
    "Scenario",
    "Verdict",
    "items",
    "judge_claims",
    "judge_parameters",
    "read_scenario",
    "scenario",
    "table",
]

PAPERS = ("grange", "das", "semeraro", "zheng", "together")
"""Keys of the papers, and ``together`` for the comparison of all of them."""

VERDICTS = {
    "parameters": ("read", "differs", "not comparable"),
    "results": ("match", "differs", "not comparable", "fitted"),
}
"""Possible verdicts on each kind of item.

A table of parameters is "read" by a study; results "match" or not. Reading parameters reproduces no
result. Results are "fitted" if our input was chosen to give the printed numbers: their agreement
shows that such an input exists, and no more. An item without a verdict is "not yet" in the ledger.
"""

_MIME = "application/vnd.distfilt.verdict+json"


def table(paper: str, name: str) -> list[dict[str, str]]:
    """Return the rows of a paper's table as printed, from ``published/PAPER/NAME.csv``.

    Parameters
    ----------
    paper, name : str
        One of `PAPERS`, and such as ``table-2``; or ``figure-1``, the claims that a figure's
        caption and text make.

    Examples
    --------
    >>> [row["kind"] for row in table("grange", "table-2")]
    ['direct', 'angle', 'direct']
    """
    return read_rows(inside(data_root() / "published", paper, name, ".csv"))


class Item(NamedTuple):
    """A table or figure to reproduce: ``Table II`` or ``Fig. 1`` of a paper, in a chapter."""

    paper: str
    item: str
    kind: str
    title: str
    chapter: str

    @property
    def file(self) -> str:
        """Name of its file in ``published/PAPER``, without the ending."""
        # "Table II" has a Roman number, "Table 2" and "Fig. 1" have Arabic ones.
        kind, number = self.item.split()
        arabic = len(number) if set(number) == {"I"} else int(number)
        return f"{'table' if kind == 'Table' else 'figure'}-{arabic}"


def items() -> list[Item]:
    """Return the tables and figures of the four papers that the book reproduces.

    >>> len(items()), items()[1].item, items()[1].file
    (21, 'Table II', 'table-2')
    """
    return [Item(**row) for row in read_rows(data_root() / "published" / "items.csv")]


def _find_item(paper: str, item: str) -> Item:
    """Return the item of that paper and name."""
    for candidate in items():
        if candidate[:2] == (paper, item):
            return candidate
    raise ValueError(f"item must be one of items(), got {paper} {item}")


@dataclass(frozen=True)
class Verdict:
    """The result of reproducing one item; a notebook shows it and the ledger collects it.

    Parameters
    ----------
    paper, item : str
        One of `items`.
    verdict : {"read", "match", "differs", "not comparable", "fitted"}
        The finding: "read" only for an item of kind "parameters", "match" and "fitted" only for
        results.
    ours, published : str
        Our result, and the printed one.
    why : str
        The reason, the input that the paper does not give, or the numbers that were fitted;
        required unless the item matches or is read.
    null : str
        The numbers that would result if the claims were false; the rules fail on them.
    control : str
        The numbers of a case in which the claims are true; the rules hold for them.
    range : str
        Values of unprinted parameters for which the verdict holds.

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
    null: str = ""
    range: str = ""
    control: str = ""

    def __post_init__(self) -> None:
        # "match" must not be possible for a table that is only read.
        allowed = VERDICTS[_find_item(self.paper, self.item).kind]
        if self.verdict not in allowed:
            raise ValueError(
                f"verdict must be one of {', '.join(allowed)}, got {self.verdict!r}"
            )
        if self.verdict in allowed[1:] and not self.why.strip():
            raise ValueError(f"why must give a reason for {self.verdict!r}")

    def _fields(self) -> list[tuple[str, str]]:
        names = ("ours", "null", "control", "range", "published", "why")
        return [(name, getattr(self, name)) for name in names if getattr(self, name)]

    def __str__(self) -> str:
        head = f"{self.paper} {self.item}: {self.verdict}"
        return "\n".join(
            [head, *(f"  {name:<9}  {text}" for name, text in self._fields())]
        )

    def _repr_mimebundle_(
        self, include: Any = None, exclude: Any = None
    ) -> dict[str, Any]:
        # Text for comparisons, HTML for the page, JSON for the ledger
        return {
            "text/plain": str(self),
            "text/html": html_table(
                (f"{self.paper} {self.item}", self.verdict), self._fields()
            ),
            _MIME: {
                name: text for name, text in vars(self).items() if text or name == "why"
            },
        }


def _judge(
    item: Item,
    good: bool,
    ours: str,
    published: str,
    why: str,
    study: Scenario | None,
    *,
    open_: str = "",
    fitted: str = "",
    **evidence: str,
) -> Verdict:
    """Return the verdict; a changed scenario or an open input makes it "not comparable"."""
    # A changed scenario comes before any other reason.
    if study is not None and study.changes:
        open_ = "changed scenario: " + "; ".join(study.changes)
        fitted = ""
    if fitted:
        # Neither a match nor a difference: the input was chosen for the printed numbers.
        verdict = "fitted"
        reason = fitted
    elif open_:
        verdict = "not comparable"
        reason = open_
    elif good:
        verdict = VERDICTS[item.kind][0]
        reason = ""
    else:
        verdict = "differs"
        reason = why
    return Verdict(item.paper, item.item, verdict, ours, published, reason, **evidence)


class Claim(NamedTuple):
    """One claim that a figure's caption or text makes, judged by our computation.

    Parameters
    ----------
    id : str
        Its key in ``published/PAPER/figure-N.csv``.
    text : str
        The computed quantity, in words.
    holds : bool
        Whether its criterion is met.
    evidence : str
        The numbers, with their interval.
    null : str
        The numbers that would result if the claim were false, and how they were computed.
    has_power : bool
        Whether the criterion fails on the null's numbers, as it must.
    range : str
        Values of an unprinted parameter for which the claim holds.
    control : str
        The numbers of a case in which the claim is true, and how they were computed.
    can_hold : bool
        Whether the criterion holds for the control's numbers, as it must.

    Examples
    --------
    >>> print(Claim("pca-stable", "share of unstable runs", True, "0 [0, 0.0362]"))
    pca-stable holds: share of unstable runs 0 [0, 0.0362]
    """

    id: str
    text: str
    holds: bool
    evidence: str
    null: str = ""
    has_power: bool = True
    range: str = ""
    control: str = ""
    can_hold: bool = True

    @classmethod
    def from_rule(
        cls,
        id: str,
        text: str,
        rule: Callable[[Any], bool],
        ours: Any,
        null: Any,
        against: str,
        *,
        range: str = "",
        shown: Callable[[Any], str] = str,
        control: Any = None,
        control_case: str = "",
    ) -> Claim:
        """Judge a claim by one rule, on our number and on its null, which `against` describes.

        A claim that fails should have a positive `control`: the number of a case, described by
        `control_case`, in which the claim is true.

        Examples
        --------
        >>> print(
        ...     Claim.from_rule(
        ...         "order", "ratio", lambda r: r < 1, 0.8, 1.1, "agents shuffled"
        ...     )
        ... )
        order holds: ratio 0.8
        """
        # The same rule on the null's number: a rule that passes both has no power.
        null_text = f"{against}: {shown(null)}{' (holds too)' if rule(null) else ''}"
        claim = cls(
            id, text, bool(rule(ours)), shown(ours), null_text, not rule(null), range
        )
        if control is None:
            return claim
        # A rule that rejects the control too could never have held.
        accepted = bool(rule(control))
        control_text = (
            f"{control_case}: {shown(control)}{'' if accepted else ' (fails too)'}"
        )
        return claim._replace(control=control_text, can_hold=accepted)

    def __str__(self) -> str:
        return f"{self.id} {'holds' if self.holds else 'fails'}: {self.text} {self.evidence}"


def judge_claims(
    paper: str,
    item: str,
    claims: Sequence[Claim],
    *,
    why: str = "",
    free: str = "",
    fitted: str = "",
    scenario: Scenario | None = None,
) -> Verdict:
    """Return the verdict on a figure: a match if every claim listed for it holds.

    Parameters
    ----------
    paper, item : str
        One of `items`; its claims are listed in ``published/PAPER/figure-N.csv``, or in
        ``table-N-claims.csv``.
    claims : sequence of Claim
        Every listed claim, once.
    why : str
        Why it differs; needed and used only if a claim fails.
    free : str
        An unprinted input on which the verdict depends, so that it is "not comparable"; the claims'
        ranges give the values for which they hold.
    fitted : str
        How many free numbers were fitted to how many printed ones, if our input was chosen to give
        them. The verdict is then "fitted", whether the claims hold or not.
    scenario : Scenario, optional
        The scenario of the study. If it is not the paper's, the verdict is "not comparable" and
        names the changes.

    Notes
    -----
    If all claims hold and a criterion passes on its null too, the verdict is "not comparable"; also
    if a claim fails and its criterion rejects its control too.

    Examples
    --------
    >>> judged = [
    ...     Claim(
    ...         "without-pca-unstable", "share of unstable runs", False, "0 [0, 0.0362]"
    ...     ),
    ...     Claim(
    ...         "pca-stable", "share of unstable runs", True, "0.02 [0.00243, 0.0704]"
    ...     ),
    ...     Claim("small-samples", "difference of shares", False, "0.05 [-0.03, 0.13]"),
    ... ]
    >>> judge_claims(
    ...     "grange", "Fig. 1", judged, why="a run must exceed the prior"
    ... ).verdict
    'differs'
    """
    listed_item = _find_item(paper, item)
    file = (
        # Claims about a table stand beside its printed values, in a file of their own.
        listed_item.file
        if listed_item.file.startswith("figure")
        else f"{listed_item.file}-claims"
    )
    listed = {row["id"]: row for row in table(paper, file)}
    ids = [claim.id for claim in claims]
    # No claim may be left out because it fails.
    if sorted(ids) != sorted(listed):
        raise ValueError(
            f"claims must be those of {paper} {item}, {', '.join(listed)}, each once, "
            f"got {', '.join(ids)}"
        )
    # Texts of the verdict: ours in the order of the caller, the printed ones as listed
    ours = "; ".join(str(c) for c in claims)
    printed = "; ".join(row["claim"] for row in listed.values())
    all_hold = all(c.holds for c in claims)
    powerless = [c.id for c in claims if not c.has_power]
    # A rule that its null passes too shows nothing.
    if all_hold and powerless and not free:
        free = f"the rule of {', '.join(powerless)} holds for its null too"
    # Nor does a failure if the rule rejects a case in which the claim is true.
    unable = [c.id for c in claims if not c.holds and not c.can_hold]
    if unable and not free:
        free = f"the rule of {', '.join(unable)} fails for its control too"
    null = "; ".join(f"{c.id}, {c.null}" for c in claims if c.null)
    control = "; ".join(f"{c.id}, {c.control}" for c in claims if c.control)
    ranges = "; ".join(f"{c.id} {c.range}" for c in claims if c.range)
    return _judge(
        listed_item,
        all_hold,
        ours,
        printed,
        why,
        scenario,
        open_=free,
        fitted=fitted,
        null=null,
        control=control,
        range=ranges,
    )


def judge_parameters(
    paper: str,
    item: str,
    read: Scenario | Sequence[Mapping[str, Any]],
    *,
    scenario: Scenario | None = None,
) -> Verdict:
    """Return the verdict on a table of parameters: "read" if the study read every cell as printed.

    Rows are matched by the first printed column. Cells are compared as numbers if both are numbers,
    else as texts without spaces.

    Parameters
    ----------
    paper, item : str
        One of `items`, of kind "parameters".
    read : Scenario or sequence of mappings
        The values that the study used: a scenario with `Scenario.track_reads`, or rows made from
        the objects that ran, such as a sensor's kind and standard deviation.
    scenario : Scenario, optional
        The scenario of the study, as in `judge_claims`; by default `read` itself.

    Examples
    --------
    >>> study = scenario("grange", "table-2").track_reads()
    >>> used = [(a.kind, a.dims, a.noise) for a in study.agents]
    >>> judge_parameters("grange", "Table II", study).why
    'row A, neighbours: printed [A,B,C], not read by the study'
    >>> links = study.adjacency
    >>> judge_parameters("grange", "Table II", study).verdict
    'read'
    """
    listed_item = _find_item(paper, item)
    printed = table(paper, listed_item.file)
    # Of a recorded scenario, only the cells that the study read
    rows = read.cells() if isinstance(read, Scenario) else read
    # Without a scenario, the recorded one says whether it was changed.
    study = read if scenario is None and isinstance(read, Scenario) else scenario
    why = _first_difference(rows, printed)
    count = f"{len(printed)} rows printed"
    return _judge(listed_item, not why, f"{len(rows)} rows read", count, why, study)


def _cell(value: Any) -> str:
    """Return a value as a paper's table prints it: lists in brackets, sensors by its names."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return f"[{','.join(str(v) for v in value)}]"
    return _PRINTED_KINDS.get(str(value), str(value))


_PRINTED_KINDS = {
    "component": "direct",
    "increment": "differential",
    "distance": "range",
    "line_angle": "angle",
}
"""The names that the papers' tables have for the library's kinds of sensors."""


def _same(a: str, b: str) -> bool:
    """Return whether two cells are equal as numbers, or as texts without spaces."""
    try:
        # "0.20" and "0.2" are the same number.
        return float(a) == float(b)
    except ValueError:
        return re.sub(r"\s+", "", a) == re.sub(r"\s+", "", b)


def _first_difference(
    rows: Sequence[Mapping[str, Any]], printed: list[dict[str, str]]
) -> str:
    """Describe the first printed cell that was not read, or read differently; '' if none."""
    first = next(iter(printed[0]))
    # Rows are matched by the first printed column, in any order.
    by_key = {str(row[first]): row for row in rows}
    for printed_row in printed:
        key = printed_row.get(first, "")
        if key not in by_key:
            return f"row {key} is printed but was not read"
        for column, text in printed_row.items():
            if column not in by_key[key]:
                return f"row {key}, {column}: printed {text}, not read by the study"
            value = _cell(by_key[key][column])
            if not _same(value, text):
                return f"row {key}, {column}: read {value}, printed {text}"
    # Rows that the study used and the paper does not print
    extra = by_key.keys() - {printed_row[first] for printed_row in printed}
    return f"row {min(extra)} was read but is not printed" if extra else ""
