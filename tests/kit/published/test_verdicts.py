"""Verdicts: their rules, their words, and that a changed study is not compared."""

from __future__ import annotations

import json

import numpy as np
import pytest

from bookkit.published import (
    VERDICTS,
    Claim,
    Value,
    Verdict,
    judge_claims,
    judge_parameters,
    judge_table,
    judge_value,
    root,
    scenario,
    table,
)

from .files import SCRATCH, named, verdict

S = scenario("grange", "table-2")
CHANGED = S.replace(gain=0.1)
VALUE = Value("C1", 0.09, 0.01, 0.0896)
UNSTABLE = Claim("without-pca-unstable", "share", True, "0.4")
STABLE = Claim("pca-stable", "share", True, "0")
FAILED = Claim("pca-stable", "share", False, "0.2")
SMALL = Claim("small-samples", "difference", True, "0.3")
CLAIMS = [UNSTABLE, STABLE, SMALL]
UNLISTED = Claim("smooth", "share", True, "0")
ROWS = table("grange", "table-2").records()
_REFUSED = named(
    {
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
            ("paper", lambda: verdict(paper="nobody")),
            ("item", lambda: verdict(item="Fig. 9")),
            ("verdict", lambda: verdict(verdict="not yet")),
            ("ours", lambda: verdict(ours="")),
            ("published", lambda: verdict(published=3)),
            ("why", lambda: verdict(verdict="differs")),
            ("why", lambda: verdict(verdict="not comparable", why=" ")),
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
            ("claims", lambda: judge_claims("grange", "Fig. 1", [*CLAIMS, UNLISTED])),
            ("why", lambda: judge_claims("grange", "Fig. 1", [UNSTABLE, FAILED, SMALL])),
        ],
        "judge_parameters": [
            ("paper", lambda: judge_parameters("nobody", "Table II", ROWS)),
            ("item", lambda: judge_parameters("grange", "Table 2", ROWS)),
            ("item", lambda: judge_parameters("semeraro", "Table 1", ROWS)),
            ("read", lambda: judge_parameters("grange", "Table II", [])),
            ("read", lambda: judge_parameters("grange", "Table II", ROWS * 2)),
            ("read", lambda: judge_parameters("grange", "Table I", [{"type": "direct"}])),
            ("read", lambda: judge_parameters("grange", "Table I", ["direct"])),
            ("read", lambda: judge_parameters("grange", "Table I", "direct")),
            ("read", lambda: judge_parameters("grange", "Table II", S)),
            ("table", lambda: judge_parameters("grange", "Table II", S.reading(), table="orbits")),
            ("scenario", lambda: judge_parameters("grange", "Table II", ROWS, scenario="mine")),
        ],
    }
)
_NONE = {"bookkit.published.VERDICTS": "a constant"}


@pytest.mark.parametrize("name", sorted(_REFUSED))
def test_bad_input_is_named(name):
    for argument, call in _REFUSED[name]:
        with pytest.raises(ValueError, match=rf"^{argument}: "):
            call()


def test_a_verdict_travels_in_a_notebook():
    found = verdict(verdict="differs", why="because <so>")
    bundle = found._repr_mimebundle_()
    data = bundle["application/vnd.distfilt.verdict+json"]
    assert data == {"paper": "grange", "item": "Fig. 1", "verdict": "differs", "ours": "a",
                    "published": "b", "why": "because <so>"}  # fmt: skip
    assert Verdict(**json.loads(json.dumps(data))) == found
    assert bundle["text/plain"] == (
        "grange Fig. 1: differs\n  ours       a\n  published  b\n  why        because <so>"
    )
    assert "because &lt;so&gt;" in bundle["text/html"]
    for word in VERDICTS:
        item = "Table II" if word == "read" else "Fig. 1"
        assert verdict(item=item, verdict=word, why="x").verdict == word


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
    match = judge_claims("grange", "Fig. 1", [SMALL, STABLE, UNSTABLE])
    assert match.verdict == "match" and "pca-stable holds: share 0" in match.ours
    assert "unstable" in match.published
    fails = Claim("without-pca-unstable", "share", np.bool_(False), "0.01 [0, 0.05]")
    differs = judge_claims("grange", "Fig. 1", [fails, STABLE, SMALL], why="it is an EnKF")
    assert differs.verdict == "differs" and "without-pca-unstable fails" in differs.ours


def test_an_open_criterion_cannot_be_judged(monkeypatch):
    folder = SCRATCH / "published" / "grange"
    folder.mkdir(parents=True)
    (SCRATCH / "published" / "items.csv").write_bytes((root() / "published/items.csv").read_bytes())
    (folder / "figure-2.csv").write_text("id,claim,criterion\nagreement,similar,open: how much\n")
    monkeypatch.setattr("bookkit.published.tables.data_root", lambda: SCRATCH)
    with pytest.raises(ValueError, match=r"^claims: .*open for agreement"):
        judge_claims("grange", "Fig. 2", [Claim("agreement", "ratio", True, "1.1")])


# --- tables of parameters ---------------------------------------------------------------------


def used(study):
    """Read every printed number of the agents, as a study does."""
    taken = [(a.kind, a.dims, a.noise) for a in study.agents]
    assert len(taken) == len(study.adjacency)
    return study


@pytest.mark.parametrize("item, name", [("Table II", "table-2"), ("Table III", "table-3")])
def test_what_a_study_took_is_read_as_printed(item, name):
    found = judge_parameters("grange", item, used(scenario("grange", name).reading()))
    assert (found.verdict, found.why) == ("read", "")
    rows = table("grange", name).records()
    assert judge_parameters("grange", item, rows[::-1]).verdict == "read"


def test_a_cell_that_no_study_took_is_not_read():
    study = S.reading()
    found = judge_parameters("grange", "Table II", study)
    why = "row A, dims: printed [0, 1], not read by the study"
    assert (found.verdict, found.why) == ("differs", why)
    for agent in study.agents:
        agent.dims, agent.noise, agent.kind  # noqa: B018
    found = judge_parameters("grange", "Table II", study)
    assert found.why == "row A, neighbours: printed [A,B,C], not read by the study"


@pytest.mark.parametrize(
    "change, why",
    [
        ({"noise": 0.3}, "row B, noise: read 0.3, printed 0.2"),
        ({"noise": "0.2"}, ""),
        ({"noise": np.float64(0.2)}, ""),
        ({"dims": (2, 1)}, "row B, dims: read [2,1], printed [1, 2]"),
        ({"dims": np.array([1, 2])}, ""),
        ({"kind": "range"}, "row B, kind: read range, printed angle"),
        ({"neighbours": ["A"]}, "row B, neighbours: read [A], printed [A,B]"),
        ({"name": "Z"}, "row B is printed but was not read"),
    ],
)
def test_rows_of_what_ran_are_judged_to_the_first_difference(change, why):
    read = [ROWS[0], {**ROWS[1], **change}, ROWS[2]]
    found = judge_parameters("grange", "Table II", read)
    assert (found.verdict, found.why) == ("differs" if why else "read", why)
    assert judge_parameters("grange", "Table II", ROWS[:2]).why.startswith("row C is printed")
    extra = judge_parameters("grange", "Table II", [*ROWS, {**ROWS[0], "name": "D"}])
    assert extra.why == "row D was read but is not printed"


def test_formulas_are_compared_without_spaces():
    rows = table("grange", "table-1").records()
    assert judge_parameters("grange", "Table I", rows).verdict == "read"
    spaced = [{**rows[0], "function": "h( x )=x"}, *rows[1:]]
    assert judge_parameters("grange", "Table I", spaced).verdict == "read"
    changed = [{**rows[0], "function": "h(x) = 2x"}, *rows[1:]]
    assert judge_parameters("grange", "Table I", changed).verdict == "differs"


# --- a changed scenario -----------------------------------------------------------------------


def test_a_changed_scenario_is_not_compared():
    why = "changed scenario: gain: 0.1, not 0.05"
    bad = Value("C1", 9.0, 0.01, 0.0896)
    for found in (
        judge_claims("grange", "Fig. 1", CLAIMS, scenario=CHANGED),
        judge_claims("grange", "Fig. 1", [UNSTABLE, FAILED, SMALL], why="x", scenario=CHANGED),
        judge_table("semeraro", "Table 1", [VALUE], scenario=CHANGED),
        judge_table("semeraro", "Table 1", [bad], scenario=CHANGED),
        judge_parameters("grange", "Table II", ROWS, scenario=CHANGED),
        judge_parameters("grange", "Table II", used(CHANGED.reading())),
    ):
        assert (found.verdict, found.why) == ("not comparable", why)
        assert found.ours and found.published
    for study in (None, S, S.reading()):
        assert judge_claims("grange", "Fig. 1", CLAIMS, scenario=study).verdict == "match"


def test_another_sensor_and_another_network_are_not_compared():
    ranged = S.replace_row("B", kind="range", unit="m").reading()
    found = judge_parameters("grange", "Table II", used(ranged))
    assert found.verdict == "not comparable" and "agents.B.kind: range, not angle" in found.why
    links = S.replace_adjacency(np.ones((3, 3)))
    found = judge_claims("grange", "Fig. 1", CLAIMS, scenario=links)
    assert found.verdict == "not comparable" and "agents.B.neighbours" in found.why
