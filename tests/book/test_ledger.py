"""The ledger of reproductions is complete and comes from the stored verdicts."""

from __future__ import annotations

import pytest

from bookkit.rows import read_rows
from ledger import (
    COLUMNS,
    ITEMS,
    LEDGER,
    VERDICTS,
    claims_of,
    ledger,
    powerless_claims,
    summaries,
    text_of,
)
from pages import claims_table

HOME = {"paper": "grange", "item": "Fig. 1", "chapter": "04-satellite-network"}
ITEM = {**HOME, "kind": "results", "title": "Error"}
TABLE = {**ITEM, "item": "Table I", "kind": "parameters"}
VERDICT = {
    **HOME,
    "verdict": "differs",
    "ours": "0.08",
    "published": "unstable",
    "why": "a, b",
}


def test_ledger_has_every_item_once() -> None:
    items = [(row["paper"], row["item"]) for row in read_rows(ITEMS)]
    rows = read_rows(LEDGER)
    assert [(row["paper"], row["item"]) for row in rows] == items
    # The papers have 21 tables and figures; an item twice would count twice.
    assert len(set(items)) == 21
    for row in rows:
        assert row["verdict"] in VERDICTS[row["kind"]]
        # A result without a claim could not be checked.
        assert row["kind"] == "parameters" or claims_of(row)
        assert all(claim.null for claim in claims_of(row))
        # A rule that judges its null's numbers alike shows nothing: no match, no difference.
        assert row["verdict"] == "not comparable" or not powerless_claims(row)
        # A rule that rejects a case in which the claim is true could never hold.
        assert "(fails too)" not in row["control"]
        # Without a null, no claim has power.
        assert len(claims_of(row)) == len(powerless_claims(row | {"null": ""}))


def test_a_verdict_fills_its_row() -> None:
    (row,) = ledger([ITEM], [])
    assert row["verdict"] == "not yet"
    assert row["chapter"] == ITEM["chapter"]
    (row,) = ledger([ITEM], [VERDICT])
    # Cells that the verdict does not give stay empty.
    other_cells = {"kind": "results", "null": "", "control": "", "range": ""}
    assert row == VERDICT | other_cells
    assert tuple(row) == COLUMNS
    assert text_of([row]).splitlines()[1].endswith('"a, b"')


@pytest.mark.parametrize(
    "verdicts",
    [
        [VERDICT, VERDICT],
        [{**VERDICT, "item": "Fig. 9"}],
        [{**VERDICT, "verdict": "read"}],
        [{**VERDICT, "item": "Table I", "verdict": "fitted"}],
    ],
    ids=["twice", "unknown item", "results read", "parameters fitted"],
)
def test_ledger_rejects(verdicts: list[dict[str, str]]) -> None:
    with pytest.raises(
        ValueError, match="has a verdict already|not an item|needs one of"
    ):
        ledger([ITEM, TABLE], verdicts)


def test_tables_that_are_read_are_not_counted_as_matches() -> None:
    # Reading a table of parameters reproduces nothing: it must not add to the matches.
    read = {**VERDICT, "item": "Table I", "verdict": "read"}
    counts = summaries(ledger([ITEM, TABLE], [VERDICT, read]))
    assert counts["parameters"] == (
        1,
        {"read": 1, "differs": 0, "not comparable": 0, "not yet": 0},
    )
    assert counts["results"] == (
        1,
        {"match": 0, "differs": 1, "not comparable": 0, "fitted": 0, "not yet": 0},
    )


def test_a_fitted_result_is_not_counted_as_a_match() -> None:
    # Numbers that our input was chosen to give show nothing about the paper's.
    fitted = {**VERDICT, "verdict": "fitted", "why": "14 numbers fitted to 9"}
    _, counts = summaries(ledger([ITEM], [fitted]))["results"]
    assert counts["fitted"] == 1
    assert counts["match"] == counts["differs"] == 0


def test_claims_have_a_row_each_and_only_the_columns_that_they_need() -> None:
    row = dict.fromkeys(COLUMNS, "") | {
        "ours": "near fails: error 2 | 3 m; far holds: error 3",
        "null": "near, a coin: 2; far, a coin: 9",
    }
    listed = {name: {"claim": f"It is {name}"} for name in ("near", "far")}
    head, _, near, far, end = claims_table(claims_of(row), listed)
    assert head == "| Claim | Verdict | Ours | If false |"
    assert end == ""
    # A bar within a cell must not end it.
    assert near == r"| It is near | fails | error 2 \| 3 m | a coin: 2 |"
    assert far == "| It is far | holds | error 3 | a coin: 9 |"
    with_control = row | {"control": "near, no noise: 0"}
    head, _, near, far, _ = claims_table(claims_of(with_control), listed)
    assert head.endswith("| If true |")
    assert near.endswith("| no noise: 0 |")
    assert far.endswith("| – |")


def test_a_row_gives_its_claims_with_their_evidence() -> None:
    row = dict.fromkeys(COLUMNS, "") | {
        "ours": "near fails: error 2 m; far holds: error 3, 4; 5 m",
        "null": "near, a coin: 2; far, a coin: 9",
        "control": "near, no noise: 0",
        "range": "near for all; far for few",
    }
    near, far = claims_of(row)
    assert (near.id, near.holds, near.ours) == ("near", False, "error 2 m")
    assert (near.null, near.control, near.range) == (
        "a coin: 2",
        "no noise: 0",
        "for all",
    )
    assert (far.id, far.holds, far.ours) == ("far", True, "error 3, 4; 5 m")
    assert (far.null, far.control, far.range) == ("a coin: 9", "", "for few")
