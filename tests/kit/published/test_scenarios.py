"""Scenario files: what is read, and that every fault is named with its line."""

from __future__ import annotations

import pytest

from bookkit.published import items, read_scenario, root, scenario

from .files import SCRATCH, named, written

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
BAD_TOML = {
    "empty": ("", 1, "empty file"),
    "bad-utf8": (TITLE.encode() + b'[parameters.a]\nunit = "\xff"\n', 3, "UTF-8"),
    "syntax": (TITLE + "[parameters.gain]\nvalue = \n", 3, "well-formed TOML"),
    "cut-off": (TITLE + '[parameters.gain]\nvalue = """x\n', 3, "well-formed TOML"),
    "twice": (TITLE + GAIN + GAIN, 7, "well-formed TOML"),
    "no-title": (GAIN, 1, "needs a title"),
    "no-parameters": (TITLE + A + B, 1, "needs parameters"),
    "flat-parameters": (TITLE + "[parameters]\ngain = 0.05\n", 2, "needs parameters"),
    "agents-table": (TITLE + GAIN + "[agents]\nx = 1\n", 7, "has 'agents', needs title"),
    "loose-entry": (TITLE + "extra = 3\n" + GAIN, 2, "has 'extra', needs title"),
    "flat-notes": (TITLE + GAIN + "[notes]\na = 1\n", 7, "needs notes, each as"),
    "note-and-parameter": (TITLE + GAIN + GAIN.replace("parameters", "notes"), 7, "already"),
    "note-without-unit": (TITLE + GAIN + '[notes.a]\nvalue = 1\n', 7, "needs unit, source"),
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
    "agent-without-unit": (TITLE + GAIN + A + agent("B", "AB", unit=None), 16, "unit: needs"),
    "agent-without-source": (TITLE + GAIN + agent("A", "A", source=None), 7, "source: needs one"),
    "agent-without-name": (TITLE + GAIN + A.replace('name = "A"\n', ""), 7, "name: needs a text"),
    "bad-column": (TITLE + GAIN + agent("A", "A", Mass="2"), 16, "Mass: needs a lower-case"),
    "ragged-column": (TITLE + GAIN + agent("A", "A", mass="[[1], [2, 3]]"), 16, "mass: needs"),
    "negative-noise": (TITLE + GAIN + A + agent("B", "AB", noise="-0.1"), 20, "noise: needs"),
    "range-in-rad": (TITLE + GAIN + agent("A", "A", kind='"range"', unit='"rad"'), 12, "m, km"),
    "angle-in-m": (TITLE + GAIN + agent("A", "A", kind='"angle"'), 12, "one of rad, deg"),
    "kind-number": (TITLE + GAIN + agent("A", "A", kind="3"), 10, "kind: needs a text"),
    "broken-dims": (TITLE + GAIN + agent("A", "A", dims="[0.5]"), 9, "dims: needs an integer"),
    "no-dims": (TITLE + GAIN + agent("A", "A", dims="[]"), 9, "dims: needs at least one"),
    "same-dims": (TITLE + GAIN + agent("A", "A", dims="[1, 1]"), 9, "without repeats"),
    "unknown-neighbour": (TITLE + GAIN + A.replace("'B'", "'Z'"), 13, "got 'Z' beside 'A'"),
    "one-sided": (TITLE + GAIN + A + agent("B", "B"), 13, "'A' names 'B', which does not"),
    "same-agents": (TITLE + GAIN + A + A, 17, "distinct names"),
}  # fmt: skip


def _scenario(name: str) -> object:
    return read_scenario(written(f"{name}.toml", BAD_TOML[name][0]))


_REFUSED = named(
    {
        "read_scenario": [
            ("path", lambda: read_scenario(3)),
            ("path", lambda: read_scenario(SCRATCH / "nowhere.toml")),
            *[("path", lambda name=name: _scenario(name)) for name in BAD_TOML],
        ],
        "scenario": [
            ("paper", lambda: scenario("nobody", "table-2")),
            ("name", lambda: scenario("grange", "table-9")),
            ("name", lambda: scenario("das", "figure-1")),
            ("name", lambda: scenario("grange", "../grange/table-2")),
        ],
    }
)


@pytest.mark.parametrize("name", sorted(_REFUSED))
def test_bad_input_is_named(name):
    for argument, call in _REFUSED[name]:
        with pytest.raises(ValueError, match=rf"^{argument}: "):
            call()


@pytest.mark.parametrize("name", sorted(BAD_TOML))
def test_malformed_toml_names_file_and_line(name):
    _, line, words = BAD_TOML[name]
    with pytest.raises(ValueError) as caught:
        _scenario(name)
    assert f"{name}.toml, line {line}: " in str(caught.value)
    assert words in str(caught.value)


def test_a_well_formed_file_is_read():
    found = read_scenario(written("good.toml", TITLE + GAIN + A + B))
    assert found["gain"] == 0.05 and found.adjacency.tolist() == [[0, 1], [1, 0]]
    assert found.name == "good"
    assert found.changes == (f"{found.paper}/good is no scenario of the book",)


ORBITS = """
title = "Two satellites see a third"
[parameters.duration]
value = 24.0
unit = "h"
source = "given"
where = "Section V"
[notes.frame]
value = "ECI"
unit = "-"
source = "given"
where = "Table 3"
[[satellites]]
name = "target"
position = [26491.58, 2980.266, -357.176]
velocity = [-0.173028, 2.191596, 3.17845]
unit = "km, km/s"
source = "given"
where = "Table 3"
[[mixands]]
name = "first"
weight = 0.5
mean = [0.0, 1.0]
cov = [[2.0, 0.1], [0.1, 1.0]]
unit = "1"
source = "assumed"
reason = "an example"
"""


def test_other_papers_scenarios_fit():
    found = read_scenario(written("orbits.toml", ORBITS))
    assert found.agents == () and found.adjacency.shape == (0, 0)
    target = found.rows("satellites")[0]
    assert target.position == (26491.58, 2980.266, -357.176) and "kind" not in target
    assert found.rows("mixands")[0]["cov"] == ((2.0, 0.1), (0.1, 1.0))
    assert [p.name for p in found.notes] == ["frame"] and "frame" not in found
    text = " ".join(repr(found).split())
    assert "26491.6, 2980.27, -357.176" in text and "ECI" in text and "(2, 0.1), (0.1, 1)" in text
    assert found.entries()["mixands.first.weight"] == "0.5"
    assert "satellites.target.where" not in found.entries() and "frame" not in found.entries()


def test_every_scenario_is_read_and_says_where_from():
    files = sorted((root() / "scenarios").glob("*/*.toml"))
    assert len(files) >= 3 and {p.parent.name for p in files} <= {i.paper for i in items()}
    for path in files:
        found = scenario(path.parent.name, path.stem)
        for p in (*found.parameters, *found.notes):
            assert p.source in ("given", "inferred", "assumed")
            assert bool(p.where) == (p.source == "given") and p.why and p.unit
        if all("neighbours" in agent for agent in found.agents):
            assert (found.adjacency == found.adjacency.T).all()
        assert not found.changed, found.changes


def test_studies_of_the_satellite_have_what_the_paper_gives():
    for name, size, state, observed in (("table-2", 6, 4, 3), ("table-3", 13, 10, 6)):
        s = scenario("grange", name)
        assert s["initial_state"].shape == (size,) and s["initial_state"].dtype == float
        assert s["first_observation"] == 0.1 and s["consensus_rounds"] == 1
        assert (s["pca_state"], s["pca_observation"], s["members"]) == (state, observed, 200)
        assert (s["orbital_rate"], s["process_noise"], s["dt_observe"]) == (0.1, 0.2, 0.1)
        seen = [k for a in s.agents for k in a.dims]
        assert set(seen) == set(range(size))
        assert s.adjacency[0].tolist() == [0] + [1] * (len(s.agents) - 1)
        assert s.adjacency.sum() == 2 * (len(s.agents) - 1)  # a star around agent A
    assert scenario("grange", "table-3")["state_order"][9:] == ("q1", "q2", "q3", "q4")



def test_the_step_that_the_paper_gives_and_the_one_that_is_run_are_told_apart():
    s = scenario("grange", "table-3")
    assert (s["integration_step"], s.source("integration_step")) == (0.1, "assumed")
    (printed,) = [p for p in s.notes if p.name == "printed_integration_step"]
    assert (printed.value, printed.source) == (0.01, "given")


def test_the_swarm_has_what_its_paper_gives():
    s = scenario("zheng", "swarm")
    names = ("agents", "diffusion", "dt", "radio_range")
    assert [s[name] for name in names] == [100, 0.03, 0.1, 0.25]
    assert [s[f"pi_{name}"] for name in ("alpha", "proportional", "integral")] == [0.2, 0.4, 0.04]
    assert s["cells"].tolist() == [30, 30] and {p.source for p in s.parameters} == {"given"}
