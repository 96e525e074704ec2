"""Scenarios: how they are read, printed, changed, and what remembers what was read."""

from __future__ import annotations

import html.parser
import pickle

import pytest

from bookkit.published import Parameter, Reading, Scenario, UnknownKey, scenario
from bookkit.published._files import text_table

from .files import named, parameter, row

S = scenario("grange", "table-2")
_REFUSED = named(
    {
        "Scenario": [
            ("paper", lambda: Scenario("", "x", "t", ())),
            ("name", lambda: Scenario("grange", "", "t", ())),
            ("title", lambda: Scenario("grange", "x", None, ())),
            ("parameters", lambda: Scenario("grange", "x", "t", (parameter(), parameter()))),
            ("parameters", lambda: Scenario("g", "x", "t", (parameter(),), notes=(parameter(),))),
            ("agents", lambda: _tabled(row(), row())),
            ("agents", lambda: _tabled(row(neighbours=("B",)))),
            ("agents", lambda: _tabled(row(neighbours=("A", "B")), row(name="B", neighbours=()))),
            ("key", lambda: S["gian"]),
            ("key", lambda: S["solver"]),
            ("key", lambda: S.unit("gian")),
            ("key", lambda: S.source("gian")),
            ("key", lambda: S.parameter(3)),
            ("key", lambda: S.replace(gian=0.1)),
            ("value", lambda: S.replace(gain=None)),
            ("table", lambda: S.rows("mixands")),
            ("name", lambda: S.replace_row("Z", noise=1.0)),
            ("noise", lambda: S.replace_row("A", noise=-1.0)),
            ("unit", lambda: S.replace_row("B", kind="range")),
            ("agents", lambda: S.replace_row("B", neighbours=("B",))),
            ("adjacency", lambda: S.replace_adjacency([[0, 1], [1, 0]])),
            ("adjacency", lambda: S.replace_adjacency([[0, 1, 0], [0, 0, 0], [0, 0, 0]])),
        ],
        "Reading": [
            ("key", lambda: S.reading()["gian"]),
            ("table", lambda: S.reading().rows("mixands")),
        ],
    }
)


def _tabled(*rows):
    return Scenario("grange", "x", "t", (), tables={"agents": rows})


@pytest.mark.parametrize("name", sorted(_REFUSED))
def test_bad_input_is_named(name):
    for argument, call in _REFUSED[name]:
        with pytest.raises(ValueError, match=rf"^{argument}: "):
            call()


def test_values_cannot_be_changed():
    before = S["initial_state"].copy()
    with pytest.raises(ValueError, match="read-only"):
        S["initial_state"][0] = 0.0
    S.adjacency[0, 0] = 5.0  # a fresh copy
    assert S.adjacency[0, 0] == 0 and (S["initial_state"] == before).all()


def test_unknown_key_is_both_errors_and_names_the_nearest():
    with pytest.raises(KeyError) as caught:
        S["members_"]
    assert isinstance(caught.value, UnknownKey) and isinstance(caught.value, ValueError)
    text = str(caught.value)
    assert text.startswith("key: scenario grange/table-2 has no parameter 'members_'; nearest: m")
    assert text.endswith("members")
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
    for p in (*S.parameters, *S.notes):
        assert p.name in parser.cells and p.why in parser.cells
        assert p.name in text and f"| {p.name} |" in markdown and p.source in markdown
    assert "100, 0, 0, 10, 0.1, 0" in parser.cells
    assert "A, B, C" in parser.cells and "A, B, C" in text and "Table II." in parser.cells
    assert "note" in parser.cells and "neighbours" in parser.cells
    assert len({len(line.split("|")) for line in markdown.split("\n\n")[0].splitlines()}) == 1
    assert repr(S) == repr(scenario("grange", "table-2"))
    lines = repr(S).splitlines()
    assert sum(set(line) == {"-"} for line in lines) == 9  # three rules a table


def test_html_and_markdown_are_escaped():
    odd = Scenario("p", "n", "t", (parameter(reason="a < b | c & d"),))
    assert "a &lt; b | c &amp; d" in odd._repr_html_()
    assert r"a < b \| c & d" in odd._repr_markdown_()


# --- changes ----------------------------------------------------------------------------------


def test_a_change_is_noticed_and_named():
    assert S.changes == () and not S.changed
    other = S.replace(gain=0.1, initial_state=[0.0] * 6).replace_row("B", noise=0.3)
    assert other.changes == (
        "initial_state: [0.0, 0.0, 0.0, 0.0, 0.0, 0.0] m, m/s, "
        "not [100.0, 0.0, 0.0, 10.0, 0.1, 0.0] m, m/s",
        "gain: 0.1, not 0.05",
        "agents.B.noise: 0.3, not 0.2",
    )
    assert other["gain"] == 0.1 and other.agents[1].noise == 0.3 and S["gain"] == 0.05
    assert other.replace(gain=0.05, initial_state=S["initial_state"]).changed
    back = other.replace(gain=0.05, initial_state=S["initial_state"]).replace_row("B", noise=0.2)
    assert back == S and back.digest == S.digest != other.digest


def test_lost_and_new_entries_are_changes():
    fewer = Scenario("grange", "table-2", S.title, S.parameters[1:], tables=S.tables)
    assert fewer.changes == ("orbital_rate: absent, not 0.1 rad/s",)
    extra = (*S.parameters, Parameter("mass", 2.0, "kg", "assumed", reason="ours"))
    more = Scenario("grange", "table-2", S.title, extra, tables=S.tables)
    assert more.changes == ("mass: 2.0 kg, not absent",)
    cut = {"agents": S.agents[:0]}
    assert "agents: [], not [A, B, C]" in Scenario("grange", "table-2", "t", S.parameters,
                                                   tables=cut).changes  # fmt: skip


def test_words_and_notes_are_no_change():
    talk = tuple(Parameter(p.name, p.value, p.unit, "assumed", reason="said otherwise")
                 for p in S.parameters)  # fmt: skip
    other = Scenario("grange", "table-2", "another title", talk, tables=S.tables)
    assert not other.changed and other.digest == S.digest
    assert not S.replace_row("A", where="elsewhere").changed


def test_other_links_go_both_ways_and_keep_everybody_to_itself():
    pair = S.replace_adjacency([[0, 0, 0], [0, 0, 1], [0, 1, 0]])
    assert [a.neighbours for a in pair.agents] == [("A",), ("B", "C"), ("B", "C")]
    assert pair.adjacency.tolist() == [[0, 0, 0], [0, 0, 1], [0, 1, 0]]
    assert S.replace_adjacency(S.adjacency) == S


# --- what was read ----------------------------------------------------------------------------


def test_a_reading_remembers_what_was_taken():
    s = S.reading()
    assert s.used == () and len(s.unread) == len(S.parameters) + 4 * 3
    assert isinstance(s, Reading) and s["gain"] == S["gain"] and "members" in s
    assert s.unit("members") == "1" and s.parameter("members").why and list(s) == list(S)
    repr(s), s._repr_html_(), s._repr_markdown_(), s.digest, s.changes, s.entries()
    assert s.used == ("gain",)
    first = s.agents[0]
    assert first.dims == (0, 1) and first.get("noise") == 0.2 and first.where == "Table II"
    assert s.used == ("gain", "agents.A.dims", "agents.A.noise")
    assert s.cells()[0] == {"name": "A", "dims": (0, 1), "noise": 0.2}
    assert s.cells()[1] == {"name": "B"}
    assert (s.adjacency == S.adjacency).all()
    assert {"agents.A.neighbours", "agents.C.neighbours"} <= set(s.used)
    assert set(s.used) | set(s.unread) == set(s.used + s.unread) and not set(s.used) & set(s.unread)


def test_two_readings_share_nothing_and_a_note_is_not_read():
    one, two = S.reading(), S.reading()
    one["gain"]
    assert two.used == () and one != two or one.used == ("gain",)
    with pytest.raises(UnknownKey, match="among its notes"):
        one["solver"]
    assert one.used == ("gain",)


def test_everything_can_be_read():
    s = S.reading()
    for key in s:
        s[key]
    for agent in s.agents:
        dict(agent)
    assert s.unread == ()


def test_a_reading_travels_and_is_changed_like_a_scenario():
    s = S.reading()
    s["gain"]
    copy = pickle.loads(pickle.dumps(s))
    copy["members"]
    assert copy.used == ("members", "gain") and s.used == ("gain",)
    other = S.replace(gain=0.2).reading()
    assert other["gain"] == 0.2 and other.changed and other.changes == ("gain: 0.2, not 0.05",)


def test_entries_keep_letters_that_are_not_ascii() -> None:
    made = Scenario("das", "x", "Title", (parameter(value=["é", "µ"]),))
    assert made.entries() == {"gain": '["é", "µ"] 1'}


def test_a_text_table_is_ruled_over_all_its_columns() -> None:
    head, *body, last = text_table(["a", "bb", "c", "d"], [["1", "2", "333", "4"]]).splitlines()
    assert head == last == body[1] == "-" * (1 + 2 + 3 + 1 + 3 * 2)
    assert body[0] == "a  bb  c    d" and body[2] == "1  2   333  4"
