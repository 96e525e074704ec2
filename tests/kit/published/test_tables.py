"""The papers' values as printed: what is there, and what a malformed file is refused with."""

from __future__ import annotations

import csv
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bookkit import published
from bookkit.published import KINDS, PAPERS, Item, Table, accepted, items, read_table, root, table

from .files import SCRATCH, named, written

# Name of the case: content, line of the fault, and words of the message.
BAD_CSV = {
    "empty": ("", 1, "empty file"),
    "blank": ("\n\n", 1, "empty file"),
    "header-only": ("agent,noise\n", 1, "at least one row"),
    "no-header": ("A,0.2\nB,0.3\n", 1, "needs a header"),
    "unnamed-column": ("agent,\nA,0.2\n", 1, "needs a header"),
    "same-columns": ("agent,agent\nA,0.2\n", 1, "distinct column names"),
    "short-row": ("agent,noise\nA,0.2\nB\n", 3, "needs 2 fields, got 1"),
    "long-row": ('agent,noise\n"A\nA",0.2\nB,1,2\n', 4, "needs 2 fields, got 3"),
    "blank-row": ("agent,noise\nA,0.2\n\nB,0.1\n", 3, "needs 2 fields, got 0"),
    "same-key": ("agent,noise\nA,0.2\nB,0.1\nA,0.3\n", 4, "'A' of line 2 again"),
    "no-number": ("agent,noise\nA,0.2\nB,little\n", 3, "noise needs a number, got 'little'"),
    "not-finite": ("agent,noise\nA,nan\n", 2, "noise needs a number, got 'nan'"),
    "bad-utf8": (b"agent,noise\nA,0.2\n\xff,0.1\n", 3, "UTF-8"),
    "open-quote": ('agent,noise\nA,0.2\n"B,0.1\n', 3, "well-formed CSV"),
    "stray-quote": ('agent,noise\n"A"x,0.2\n', 2, "well-formed CSV"),
    "byte-order-mark": ("\ufeffagent,noise\nA,0.2\n", 1, "needs a header"),
}  # fmt: skip


def _read(name: str) -> object:
    return read_table(written(f"{name}.csv", BAD_CSV[name][0]), numbers=["noise"])


def _item(**changes: str) -> Item:
    fields = {"paper": "grange", "item": "Table I", "kind": "results", "title": "t", "chapter": "c"}
    return Item(**(fields | changes))


_REFUSED = named(
    {
        "Item": [
            ("paper", lambda: _item(paper="nobody")),
            ("item", lambda: _item(item="Table")),
            ("kind", lambda: _item(kind="figure")),
            ("title", lambda: _item(title="")),
            ("chapter", lambda: _item(chapter=" ")),
        ],
        "Table": [
            ("rows", lambda: Table(("a", "b"), (("1",),), SCRATCH, (2,))),
            ("lines", lambda: Table(("a",), (("1",),), SCRATCH, ())),
            ("column", lambda: table("grange", "table-2").text("colour")),
            ("column", lambda: table("grange", "table-2").numbers("colour")),
            ("path", lambda: table("grange", "table-2").numbers("kind")),
        ],
        "read_table": [
            ("path", lambda: read_table(None)),
            ("path", lambda: read_table(SCRATCH / "nowhere.csv")),
            ("path", lambda: read_table(written("a.csv", "a,b\n1,2\n"), columns=("a", "c"))),
            ("key", lambda: read_table(written("a.csv", "a,b\n1,2\n"), key=0)),
            ("numbers", lambda: read_table(written("a.csv", "a,b\n1,2\n"), numbers=["c"])),
            *[("path", lambda name=name: _read(name)) for name in BAD_CSV],
        ],
        "table": [
            ("paper", lambda: table("nobody", "table-1")),
            ("name", lambda: table("grange", "table-9")),
            ("name", lambda: table("grange", None)),
            ("numbers", lambda: table("grange", "table-2", numbers=["colour"])),
        ],
    }
)
_NONE = {
    f"bookkit.published.{name}": reason
    for name, reason in {
        "KINDS": "a constant",
        "PAPERS": "a constant",
        "accepted": "an unknown name gives no entries",
        "items": "takes no input",
        "root": "takes no input",
    }.items()
}


@pytest.mark.parametrize("name", sorted(_REFUSED))
def test_bad_input_is_named(name):
    for argument, call in _REFUSED[name]:
        with pytest.raises(ValueError, match=rf"^{argument}: "):
            call()


@pytest.mark.parametrize("name", sorted(BAD_CSV))
def test_malformed_csv_names_file_and_line(name):
    _, line, words = BAD_CSV[name]
    with pytest.raises(ValueError) as caught:
        _read(name)
    assert f"{name}.csv, line {line}: " in str(caught.value)
    assert words in str(caught.value)


def test_a_well_formed_table_is_read():
    good = read_table(written("good.csv", 'agent,noise\r\n"A\nA",0.2\r\nB,1e-3\r\n'))
    assert good.text("agent") == ("A\nA", "B") and good.numbers("noise").tolist() == [0.2, 1e-3]
    assert good.lines == (2, 4) and len(good) == 2
    assert good.records() == ({"agent": "A\nA", "noise": "0.2"}, {"agent": "B", "noise": "1e-3"})


def test_faults_in_the_library_data_show_no_path_of_this_machine():
    with pytest.raises(ValueError, match=r"^path: published/grange/table-2\.csv, line 2: "):
        table("grange", "table-2").numbers("kind")


CELLS = st.text(st.characters(codec="utf-8", exclude_characters="\x00\r"), min_size=0, max_size=8)


@given(st.lists(st.tuples(CELLS, CELLS), min_size=1, max_size=6, unique_by=lambda row: row[0]))
def test_csv_round_trip(rows):
    path = SCRATCH / "round-trip.csv"
    with path.open("w", newline="", encoding="utf-8") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["key", "text"])
        writer.writerows(rows)
    assert read_table(path).rows == tuple(rows)


def test_items_are_complete():
    found = items()
    assert Counter(i.paper for i in found) == {"grange": 5, "das": 5, "semeraro": 9, "zheng": 2}
    names = {paper: {i.item for i in found if i.paper == paper} for paper in PAPERS}
    assert names["grange"] == {"Table I", "Table II", "Table III", "Fig. 1", "Fig. 2"}
    assert names["das"] == {f"Fig. {k}" for k in range(1, 6)}
    assert names["semeraro"] == {f"Table {k}" for k in (1, 2, 3)} | {
        f"Fig. {k}" for k in range(1, 7)
    }
    assert names["zheng"] == {"Fig. 1", "Fig. 2"}
    assert len({(i.paper, i.file) for i in found}) == 21
    read = {(i.paper, i.item) for i in found if i.kind == "parameters"}
    satellites = {("grange", f"Table {k}") for k in ("I", "II", "III")}
    assert read == {("semeraro", "Table 3")} | satellites
    assert {i.kind for i in found} == set(KINDS)
    chapters = {paper: {i.chapter for i in found if i.paper == paper} for paper in PAPERS}
    assert chapters == {
        "grange": {"04-satellite-network"},
        "das": {"05-optimal-transport", "06-constrained-pendulum"},
        "semeraro": {"07-partial-state-fusion", "08-tracking-in-orbit"},
        "zheng": {"10-swarm-that-knows"},
    }


def test_every_published_file_is_read():
    files = sorted((root() / "published").glob("*/*.csv"))
    assert files
    of_item = {(i.paper, i.file) for i in items()}
    for path in files:
        found = table(path.parent.name, path.stem)
        assert (path.parent.name, path.stem) in of_item
        if path.stem.startswith("figure"):
            assert found.columns == ("id", "claim", "criterion")
            assert all(cell.strip() for row in found.rows for cell in row)


def test_accepted_entries_are_found_by_paper_and_name():
    assert accepted("grange", "table-2")["agents.B.kind"] == '"angle"'
    assert accepted("grange", "table-9") == accepted("das", "table-2") == {}


def test_every_public_name_has_bad_input_or_a_reason():
    from . import test_parts, test_scenarios, test_specs, test_verdicts

    names = set(_REFUSED) | set(_NONE)
    for module in (test_parts, test_scenarios, test_specs, test_verdicts):
        names |= module._REFUSED.keys() | getattr(module, "_NONE", {}).keys()
    assert {f"bookkit.published.{name}" for name in published.__all__} <= names
