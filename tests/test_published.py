"""The papers' values, the scenarios and the verdicts: what is there, and what is refused."""

from __future__ import annotations

import atexit
import csv
import html.parser
import json
import shutil
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from distfilt import published
from distfilt.published import (
    PAPERS,
    VERDICTS,
    AgentSpec,
    Claim,
    Item,
    Parameter,
    Scenario,
    Table,
    UnknownKey,
    Value,
    Verdict,
    items,
    judge_claims,
    judge_parameters,
    judge_table,
    judge_value,
    read_scenario,
    read_table,
    root,
    scenario,
    table,
)

SCRATCH = Path(tempfile.mkdtemp(prefix="published-"))
atexit.register(shutil.rmtree, SCRATCH, ignore_errors=True)


def written(name: str, content: str | bytes) -> Path:
    """A file of that content in a folder of this test run."""
    path = SCRATCH / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


GAIN = '[parameters.gain]\nvalue = 0.05\nunit = "1"\nsource = "assumed"\nreason = "a sweep"\n'


def agent(name: str, neighbours: str, **changes: str) -> str:
    """An agent's block of a scenario file, with some entries changed; None leaves one out."""
    entries = {
        "name": f'"{name}"', "dims": "[0, 1]", "kind": '"direct"', "noise": "0.2", "unit": '"m"',
        "neighbours": f"{list(neighbours)}", "source": '"given"', "where": '"Table II"',
    } | changes  # fmt: skip
    return "[[agents]]\n" + "".join(f"{k} = {v}\n" for k, v in entries.items() if v is not None)


A, B = agent("A", "AB"), agent("B", "AB")
TITLE = 'title = "A study"\n'

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
BAD_TOML = {
    "empty": ("", 1, "empty file"),
    "bad-utf8": (TITLE.encode() + b'[parameters.a]\nunit = "\xff"\n', 3, "UTF-8"),
    "syntax": (TITLE + "[parameters.gain]\nvalue = \n", 3, "well-formed TOML"),
    "cut-off": (TITLE + '[parameters.gain]\nvalue = """x\n', 3, "well-formed TOML"),
    "twice": (TITLE + GAIN + GAIN, 7, "well-formed TOML"),
    "no-title": (GAIN, 1, "needs a title"),
    "no-parameters": (TITLE + A + B, 1, "needs parameters"),
    "flat-parameters": (TITLE + "[parameters]\ngain = 0.05\n", 1, "needs parameters"),
    "agents-table": (TITLE + GAIN + "[agents]\nx = 1\n", 1, "needs agents"),
    "unknown-entry": (TITLE + GAIN + "[extra]\na = 1\n", 7, "unknown entry 'extra'"),
    "no-value": (TITLE + GAIN.replace("value = 0.05\n", ""), 2, "needs value"),
    "no-unit": (TITLE + "\n" + GAIN.replace('unit = "1"\n', ""), 3, "needs unit"),
    "no-source": (TITLE + GAIN.replace('source = "assumed"\n', ""), 2, "needs source"),
    "no-reason": (TITLE + GAIN.replace('reason = "a sweep"\n', ""), 2, "reason: needs a text"),
    "given-without-where": (TITLE + GAIN.replace("assumed", "given"), 2, "where: needs a text"),
    "unknown-source": (TITLE + GAIN.replace("assumed", "guessed"), 5, "one of given, inferred"),
    "unknown-key": (TITLE + GAIN.replace("reason", "reson"), 6, "unknown key 'reson'"),
    "named-twice": (TITLE + GAIN + 'name = "g"\n', 7, "has a name already"),
    "bad-name": (TITLE + GAIN.replace("gain", "Gain"), 2, "name: needs a lower-case name"),
    "not-finite": (TITLE + GAIN.replace("0.05", "nan"), 3, "value: needs a finite number"),
    "mixed-list": (TITLE + GAIN.replace("0.05", '[1, "a"]'), 3, "list of numbers or of texts"),
    "ragged-list": (TITLE + GAIN.replace("0.05", "[[1, 2], [3]]"), 3, "rows of one length"),
    "empty-list": (TITLE + GAIN.replace("0.05", "[]"), 3, "value: needs"),
    "date": (TITLE + GAIN.replace("0.05", "2020-01-01"), 3, "value: needs"),
    "unit-number": (TITLE + GAIN.replace('"1"', "1"), 4, "unit: needs a text"),
    "agent-without-noise": (TITLE + GAIN + A + agent("B", "AB", noise=None), 16, "needs noise"),
    "agent-without-source": (TITLE + GAIN + agent("A", "A", source=None), 7, "needs source"),
    "negative-noise": (TITLE + GAIN + A + agent("B", "AB", noise="-0.1"), 20, "noise: needs"),
    "unknown-kind": (TITLE + GAIN + agent("A", "A", kind='"smell"'), 10, "kind: needs one of"),
    "broken-dims": (TITLE + GAIN + agent("A", "A", dims="[0.5]"), 9, "dims: needs an integer"),
    "no-dims": (TITLE + GAIN + agent("A", "A", dims="[]"), 9, "dims: needs at least one"),
    "same-dims": (TITLE + GAIN + agent("A", "A", dims="[1, 1]"), 9, "without repeats"),
    "unknown-neighbour": (TITLE + GAIN + A.replace("'B'", "'Z'"), 13, "got 'Z' beside 'A'"),
    "one-sided": (TITLE + GAIN + A + agent("B", "B"), 13, "'A' names 'B', which does not"),
    "same-agents": (TITLE + GAIN + A + A, 17, "distinct agents"),
}  # fmt: skip


def _read(name: str) -> object:
    return read_table(written(f"{name}.csv", BAD_CSV[name][0]), numbers=["noise"])


def _scenario(name: str) -> object:
    return read_scenario(written(f"{name}.toml", BAD_TOML[name][0]))


def _agent(**changes: object) -> AgentSpec:
    fields = {"name": "A", "dims": (0,), "kind": "direct", "noise": 0.2, "neighbours": ("A",),
              "unit": "m", "source": "given", "where": "Table II"}  # fmt: skip
    return AgentSpec(**(fields | changes))


def _parameter(**changes: object) -> Parameter:
    fields = {"name": "gain", "value": 0.05, "unit": "1", "source": "assumed", "reason": "x"}
    return Parameter(**(fields | changes))


def _verdict(**changes: object) -> Verdict:
    fields = {
        "paper": "grange",
        "item": "Fig. 1",
        "verdict": "match",
        "ours": "a",
        "published": "b",
    }
    return Verdict(**(fields | changes))


S = scenario("grange", "table-2")
VALUE = Value("C1", 0.09, 0.01, 0.0896)
UNSTABLE = Claim("without-pca-unstable", "share", True, "0.4")
STABLE = Claim("pca-stable", "share", True, "0")
FAILED = Claim("pca-stable", "share", False, "0.2")
UNLISTED = Claim("smooth", "share", True, "0")

_CASES = {
    "AgentSpec": [
        ("name", lambda: _agent(name="")),
        ("dims", lambda: _agent(dims=())),
        ("dims", lambda: _agent(dims=(-1,))),
        ("dims", lambda: _agent(dims=3)),
        ("kind", lambda: _agent(kind="smell")),
        ("noise", lambda: _agent(noise=0.0)),
        ("noise", lambda: _agent(noise=np.nan)),
        ("neighbours", lambda: _agent(neighbours=("A", "A"))),
        ("neighbours", lambda: _agent(neighbours=(1,))),
        ("unit", lambda: _agent(unit="")),
        ("source", lambda: _agent(source="guessed")),
        ("where", lambda: _agent(where="")),
        ("reason", lambda: _agent(source="inferred")),
        ("reason", lambda: _agent(reason=None)),
    ],
    "Parameter": [
        ("name", lambda: _parameter(name="A gain")),
        ("value", lambda: _parameter(value=None)),
        ("value", lambda: _parameter(value="")),
        ("value", lambda: _parameter(value=[True, False])),
        ("value", lambda: _parameter(value=[np.inf])),
        ("unit", lambda: _parameter(unit=None)),
        ("source", lambda: _parameter(source="")),
        ("reason", lambda: _parameter(reason=" ")),
        ("where", lambda: _parameter(source="given")),
        ("note", lambda: _parameter(note=3)),
    ],
    "Scenario": [
        ("paper", lambda: Scenario("", "x", "t", ())),
        ("name", lambda: Scenario("grange", "", "t", ())),
        ("title", lambda: Scenario("grange", "x", None, ())),
        ("parameters", lambda: Scenario("grange", "x", "t", (_parameter(), _parameter()))),
        ("agents", lambda: Scenario("grange", "x", "t", (), (_agent(), _agent()))),
        ("agents", lambda: Scenario("grange", "x", "t", (), (_agent(neighbours=("B",)),))),
        ("key", lambda: S["gian"]),
        ("key", lambda: S.unit("gian")),
        ("key", lambda: S.source("gian")),
        ("key", lambda: S.reason("gian")),
        ("key", lambda: S.parameter(3)),
    ],
    "read_scenario": [
        ("path", lambda: read_scenario(3)),
        ("path", lambda: read_scenario(SCRATCH / "nowhere.toml")),
        *[("path", lambda name=name: _scenario(name)) for name in BAD_TOML],
    ],
    "scenario": [
        ("paper", lambda: scenario("nobody", "table-2")),
        ("name", lambda: scenario("grange", "table-9")),
        ("name", lambda: scenario("zheng", "figure-1")),
        ("name", lambda: scenario("grange", "../grange/table-2")),
    ],
    "Item": [
        ("paper", lambda: Item("nobody", "Table I", "t", "c")),
        ("item", lambda: Item("grange", "Table", "t", "c")),
        ("title", lambda: Item("grange", "Table I", "", "c")),
        ("chapter", lambda: Item("grange", "Table I", "t", " ")),
    ],
    "Table": [
        ("rows", lambda: Table(("a", "b"), (("1",),), SCRATCH, (2,))),
        ("lines", lambda: Table(("a",), (("1",),), SCRATCH, ())),
        ("column", lambda: table("grange", "table-2").text("colour")),
        ("column", lambda: table("grange", "table-2").numbers("colour")),
        ("path", lambda: table("grange", "table-2").numbers("type")),
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
    "Claim": [
        ("id", lambda: Claim("", "t", True, "e")),
        ("text", lambda: Claim("i", "", True, "e")),
        ("holds", lambda: Claim("i", "t", 1, "e")),
        ("evidence", lambda: Claim("i", "t", True, None)),
    ],
    "Value": [
        ("id", lambda: Value("", 1.0, 0.1, 1.0)),
        ("ours", lambda: Value("C1", np.nan, 0.1, 1.0)),
        ("error", lambda: Value("C1", 1.0, -0.1, 1.0)),
        ("published", lambda: Value("C1", 1.0, 0.1, "one")),
        ("tolerance", lambda: Value("C1", 1.0, 0.1, 1.0, -1.0)),
    ],
    "Verdict": [
        ("paper", lambda: _verdict(paper="nobody")),
        ("item", lambda: _verdict(item="Fig. 9")),
        ("verdict", lambda: _verdict(verdict="not yet")),
        ("ours", lambda: _verdict(ours="")),
        ("published", lambda: _verdict(published=3)),
        ("why", lambda: _verdict(verdict="differs")),
        ("why", lambda: _verdict(verdict="not comparable", why=" ")),
    ],
    "judge_value": [
        ("ours", lambda: judge_value(np.nan, 0.1, 1.0)),
        ("error", lambda: judge_value(1.0, np.inf, 1.0)),
        ("error", lambda: judge_value(1.0, -0.1, 1.0)),
        ("published", lambda: judge_value(1.0, 0.1, None)),
        ("tolerance", lambda: judge_value(1.0, 0.1, 1.0, tolerance=-0.1)),
    ],
    "judge_table": [
        ("paper", lambda: judge_table("nobody", "Table 1", [VALUE])),
        ("item", lambda: judge_table("semeraro", "Table I", [VALUE])),
        ("values", lambda: judge_table("semeraro", "Table 1", [])),
        ("values", lambda: judge_table("semeraro", "Table 1", [VALUE, VALUE])),
        ("values", lambda: judge_table("semeraro", "Table 1", [0.09])),
        ("why", lambda: judge_table("semeraro", "Table 1", [Value("C1", 1.0, 0.1, 2.0)])),
    ],
    "judge_claims": [
        ("paper", lambda: judge_claims("nobody", "Fig. 1", [STABLE])),
        ("item", lambda: judge_claims("grange", "Fig. 3", [STABLE])),
        ("item", lambda: judge_claims("grange", "Table II", [STABLE])),
        ("claims", lambda: judge_claims("grange", "Fig. 1", [])),
        ("claims", lambda: judge_claims("grange", "Fig. 1", [True])),
        ("claims", lambda: judge_claims("grange", "Fig. 1", [STABLE])),
        ("claims", lambda: judge_claims("grange", "Fig. 1", [STABLE, STABLE])),
        ("claims", lambda: judge_claims("grange", "Fig. 1", [UNSTABLE, STABLE, UNLISTED])),
        ("why", lambda: judge_claims("grange", "Fig. 1", [UNSTABLE, FAILED])),
    ],
    "judge_parameters": [
        ("paper", lambda: judge_parameters("nobody", "Table II", S.agents)),
        ("item", lambda: judge_parameters("grange", "Table 2", S.agents)),
        ("read", lambda: judge_parameters("grange", "Table II", [])),
        ("read", lambda: judge_parameters("grange", "Table II", S.agents * 2)),
        ("read", lambda: judge_parameters("grange", "Table I", S.agents)),
        ("read", lambda: judge_parameters("grange", "Table I", ["direct"])),
    ],
}  # fmt: skip
EXEMPT = {
    f"{module}.{name}": reason
    for name, module, reason in [
        ("PAPERS", "distfilt.published.tables", "a constant"),
        ("VERDICTS", "distfilt.published.verdicts", "a constant"),
        ("UnknownKey", "distfilt.published.specs", "an exception"),
        ("items", "distfilt.published.tables", "takes no input"),
        ("root", "distfilt.published.tables", "takes no input"),
    ]
    for module in (module, "distfilt.published")
}
BAD_INPUT = {
    f"{module}.{name}": cases
    for name, cases in _CASES.items()
    for module in ("distfilt.published", getattr(published, name).__module__)
}


@pytest.mark.parametrize("name", sorted(_CASES))
def test_bad_input_is_named(name):
    for argument, call in _CASES[name]:
        with pytest.raises(ValueError, match=rf"^{argument}: "):
            call()


def test_every_public_name_has_bad_input_or_a_reason():
    names = {f"distfilt.published.{name}" for name in published.__all__}
    assert names <= BAD_INPUT.keys() | EXEMPT.keys()


# --- files with a fault -----------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(BAD_CSV))
def test_malformed_csv_names_file_and_line(name):
    _, line, words = BAD_CSV[name]
    with pytest.raises(ValueError) as caught:
        _read(name)
    assert f"{name}.csv, line {line}: " in str(caught.value)
    assert words in str(caught.value)


@pytest.mark.parametrize("name", sorted(BAD_TOML))
def test_malformed_toml_names_file_and_line(name):
    _, line, words = BAD_TOML[name]
    with pytest.raises(ValueError) as caught:
        _scenario(name)
    assert f"{name}.toml, line {line}: " in str(caught.value)
    assert words in str(caught.value)


def test_the_well_formed_versions_are_read():
    found = read_scenario(written("good.toml", TITLE + GAIN + A + B))
    assert found["gain"] == 0.05 and found.adjacency.tolist() == [[0, 1], [1, 0]]
    good = read_table(written("good.csv", 'agent,noise\r\n"A\nA",0.2\r\nB,1e-3\r\n'))
    assert good.text("agent") == ("A\nA", "B") and good.numbers("noise").tolist() == [0.2, 1e-3]
    assert good.lines == (2, 4) and len(good) == 2


def test_faults_in_the_library_data_show_no_path_of_this_machine():
    with pytest.raises(ValueError, match=r"^path: published/grange/table-2\.csv, line 2: "):
        table("grange", "table-2").numbers("type")


CELLS = st.text(st.characters(codec="utf-8", exclude_characters="\x00\r"), min_size=0, max_size=8)


@given(st.lists(st.tuples(CELLS, CELLS), min_size=1, max_size=6, unique_by=lambda row: row[0]))
def test_csv_round_trip(rows):
    path = SCRATCH / "round-trip.csv"
    with path.open("w", newline="", encoding="utf-8") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["key", "text"])
        writer.writerows(rows)
    assert read_table(path).rows == tuple(rows)


# --- what is there ----------------------------------------------------------------------------


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
    chapters = {paper: {i.chapter for i in found if i.paper == paper} for paper in PAPERS}
    assert chapters == {
        "grange": {"04-satellite-network"},
        "das": {"06-constrained-pendulum"},
        "semeraro": {"07-partial-state-fusion", "08-tracking-in-orbit"},
        "zheng": {"10-swarm"},
    }


def test_the_data_of_an_installed_wheel_come_first(monkeypatch, tmp_path):
    monkeypatch.setattr("distfilt.published._files._PACKAGE", tmp_path / "distfilt")
    with pytest.raises(FileNotFoundError, match="without its folders"):
        root()
    for folder in ("data", "distfilt/_data"):
        for kind in ("published", "scenarios"):
            (tmp_path / folder / kind).mkdir(parents=True)
        assert root() == tmp_path / folder


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


def test_every_scenario_is_read_and_says_where_from():
    files = sorted((root() / "scenarios").glob("*/*.toml"))
    assert files
    for path in files:
        found = scenario(path.parent.name, path.stem)
        assert {p.source for p in found.parameters} <= {"given", "inferred", "assumed"}
        for key in found:
            assert found.reason(key) and found.unit(key)
        for p in found.parameters:
            assert bool(p.where) == (p.source == "given")
        assert (found.adjacency == found.adjacency.T).all()


# --- scenarios --------------------------------------------------------------------------------


def test_studies_of_the_satellite_have_what_the_paper_gives():
    for name, size, state, observed in (("table-2", 6, 4, 3), ("table-3", 13, 10, 6)):
        s = scenario("grange", name)
        assert s["initial_state"].shape == (size,) and s["initial_state"].dtype == float
        assert s["noisy_components"].dtype.kind == "i"
        assert (s["pca_state"], s["pca_observation"], s["members"]) == (state, observed, 200)
        assert (s["orbital_rate"], s["process_noise"], s["dt_observe"]) == (0.1, 0.2, 0.1)
        seen = [k for a in s.agents for k in a.dims]
        assert set(seen) == set(range(size))
        assert s.adjacency[0].tolist() == [0] + [1] * (len(s.agents) - 1)
        assert s.adjacency.sum() == 2 * (len(s.agents) - 1)  # a star around agent A
    assert scenario("grange", "table-3")["state_order"][9:] == ("q1", "q2", "q3", "q4")


def test_values_cannot_be_changed():
    before = S["initial_state"].copy()
    with pytest.raises(ValueError, match="read-only"):
        S["initial_state"][0] = 0.0
    with pytest.raises(AttributeError):
        S.agents[0].noise = 1.0
    S.adjacency[0, 0] = 5.0  # a fresh copy
    assert S.adjacency[0, 0] == 0 and (S["initial_state"] == before).all()


def test_unknown_key_is_both_errors_and_names_the_nearest():
    with pytest.raises(KeyError) as caught:
        S["members_"]
    assert isinstance(caught.value, UnknownKey) and isinstance(caught.value, ValueError)
    text = str(caught.value)
    assert text.startswith("key: scenario grange/table-2 has no parameter 'members_'; nearest: m")
    assert "'members" in text and "members," in text
    assert "gain" in S and "gian" not in S and "gain" in list(S)


class _Cells(html.parser.HTMLParser):
    """The texts of an HTML table's cells."""

    def __init__(self) -> None:
        super().__init__()
        self.cells: list[str] = []
        self.open = False

    def handle_starttag(self, tag, attrs):
        if tag in ("td", "th"):
            self.open = True
            self.cells.append("")

    def handle_endtag(self, tag):
        self.open = self.open and tag not in ("td", "th")

    def handle_data(self, data):
        if self.open:
            self.cells[-1] += data


def test_a_scenario_prints_every_parameter_and_its_reason():
    parser = _Cells()
    parser.feed(S._repr_html_())
    text = " ".join(repr(S).split())
    markdown = S._repr_markdown_()
    for p in S.parameters:
        assert p.name in parser.cells and p.why in parser.cells
        assert p.name in text and f"| {p.name} |" in markdown and p.source in markdown
    assert "100, 0, 0, 10, 0.1, 0" in parser.cells
    assert "A B C" in parser.cells and "A B C" in text
    assert len({len(line.split("|")) for line in markdown.split("\n\n")[0].splitlines()}) == 1
    assert repr(S) == repr(scenario("grange", "table-2"))
    lines = repr(S).splitlines()
    assert sum(set(line) == {"-"} for line in lines) == 6  # three rules a table


def test_html_and_markdown_are_escaped():
    odd = Scenario("p", "n", "t", (_parameter(reason="a < b | c & d"),))
    assert "a &lt; b | c &amp; d" in odd._repr_html_()
    assert r"a < b \| c & d" in odd._repr_markdown_()


# --- verdicts ---------------------------------------------------------------------------------


def test_a_verdict_travels_in_a_notebook():
    verdict = _verdict(verdict="differs", why="because <so>")
    bundle = verdict._repr_mimebundle_()
    data = bundle["application/vnd.distfilt.verdict+json"]
    assert data == {"paper": "grange", "item": "Fig. 1", "verdict": "differs", "ours": "a",
                    "published": "b", "why": "because <so>"}  # fmt: skip
    assert Verdict(**json.loads(json.dumps(data))) == verdict
    assert bundle["text/plain"] == (
        "grange Fig. 1: differs\n  ours       a\n  published  b\n  why        because <so>"
    )
    assert "because &lt;so&gt;" in bundle["text/html"]
    for word in VERDICTS:
        assert _verdict(verdict=word, why="x").verdict == word


@pytest.mark.parametrize("side", [-1, 1])
def test_judge_value_on_both_sides_of_its_thresholds(side):
    # Binary fractions, so that the edge itself is exact.
    assert judge_value(1.0 + side * 0.5, 0.25, 1.0)
    assert not judge_value(1.0 + side * 0.501, 0.25, 1.0)
    assert judge_value(1.0 + side * 0.75, 0.25, 1.0, tolerance=0.75)
    assert not judge_value(1.0 + side * 0.751, 0.25, 1.0, tolerance=0.75)
    assert judge_value(1.0 + side * 0.5, 0.25, 1.0, tolerance=0.125)  # the larger rule, not both
    assert not judge_value(1.0 + side * 0.625, 0.25, 1.0, tolerance=0.125)  # and not their sum
    assert judge_value(1.0, 0.0, 1.0) and not judge_value(1.0 + side * 1e-9, 0.0, 1.0)


def test_judge_table_needs_every_value():
    good, bad = Value("C1", 1.5, 0.25, 1.0), Value("C2", 1.501, 0.25, 1.0)
    match = judge_table("semeraro", "Table 1", [good], why="not used")
    assert (match.verdict, match.why, match.ours) == ("match", "", "1 of 1 values match")
    differs = judge_table("semeraro", "Table 1", [good, bad], why="another quadrature")
    assert (differs.verdict, differs.why) == ("differs", "another quadrature")
    assert differs.ours.startswith("1 of 2 values match; C2: 1.501 ± 0.2 (published 1)")


def test_judge_claims_needs_every_claim_to_hold():
    match = judge_claims("grange", "Fig. 1", [STABLE, UNSTABLE])
    assert match.verdict == "match" and "pca-stable holds: share 0" in match.ours
    assert "unstable" in match.published
    fails = Claim("without-pca-unstable", "share", np.bool_(False), "0.01 [0, 0.05]")
    differs = judge_claims("grange", "Fig. 1", [fails, STABLE], why="the affine map is an EnKF")
    assert differs.verdict == "differs" and "without-pca-unstable fails" in differs.ours


def test_an_open_criterion_cannot_be_judged(monkeypatch):
    folder = SCRATCH / "published" / "grange"
    folder.mkdir(parents=True)
    (SCRATCH / "published" / "items.csv").write_bytes((root() / "published/items.csv").read_bytes())
    (folder / "figure-2.csv").write_text("id,claim,criterion\nagreement,similar,open: how much\n")
    monkeypatch.setattr("distfilt.published.tables.data_root", lambda: SCRATCH)
    with pytest.raises(ValueError, match=r"^claims: .*open for agreement"):
        judge_claims("grange", "Fig. 2", [Claim("agreement", "ratio", True, "1.1")])


@pytest.mark.parametrize("item, name", [("Table II", "table-2"), ("Table III", "table-3")])
def test_the_scenarios_read_the_tables_as_printed(item, name):
    agents = scenario("grange", name).agents
    assert judge_parameters("grange", item, agents).verdict == "match"
    assert judge_parameters("grange", item, agents[::-1]).verdict == "match"


@pytest.mark.parametrize(
    "change, why",
    [
        ({"noise": 0.3}, "row B, noise: read 0.3, printed 0.2"),
        ({"dims": (2, 1)}, "row B, dimensions: read [2, 1], printed [1, 2]"),
        ({"kind": "range"}, "row B, type: read range, printed angle"),
        ({"neighbours": ("A",)}, "row B, neighbours: read [A], printed [A,B]"),
        ({"name": "Z"}, "row B is printed but was not read"),
    ],
)
def test_judge_parameters_finds_the_first_difference(change, why):
    fields = {k: getattr(S.agents[1], k) for k in AgentSpec.__dataclass_fields__}
    read = [S.agents[0], AgentSpec(**(fields | change)), S.agents[2]]
    found = judge_parameters("grange", "Table II", read)
    assert (found.verdict, found.why) == ("differs", why)
    assert judge_parameters("grange", "Table II", S.agents[:2]).why.startswith("row C is printed")
    extra = judge_parameters("grange", "Table II", [*S.agents, _agent(name="D")])
    assert extra.why == "row D was read but is not printed"


def test_judge_parameters_takes_plain_rows():
    rows = table("grange", "table-1").records()
    assert judge_parameters("grange", "Table I", rows).verdict == "match"
    spaced = [{**rows[0], "function": "h( x )=x"}, *rows[1:]]
    assert judge_parameters("grange", "Table I", spaced).verdict == "match"
    changed = [{**rows[0], "function": "h(x) = 2x"}, *rows[1:]]
    assert judge_parameters("grange", "Table I", changed).verdict == "differs"
