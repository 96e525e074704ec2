"""Published values, scenarios, and verdicts that can fail."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bookkit.folders import data_root
from bookkit.published import (
    Claim,
    Scenario,
    Verdict,
    items,
    judge_claims,
    judge_parameters,
    read_scenario,
    scenario,
    table,
)
from bookkit.rows import markdown_table

S = scenario("grange", "table-2")
CHANGED = S.replace(gain=0.1)
ROWS = [
    {
        "name": a.name,
        "dims": a.dims,
        "kind": a.kind,
        "noise": a.noise,
        "neighbours": a.neighbours,
    }
    for a in S.agents
]
CLAIMS = [
    Claim("without-pca-unstable", "share", True, "0.4 [0.3, 0.5]"),
    Claim("pca-stable", "share", True, "0 [0, 0.04]"),
    Claim("small-samples", "difference", True, "0.3 [0.2, 0.4]"),
]
DENIED = [CLAIMS[0], CLAIMS[1]._replace(holds=False), CLAIMS[2]]


# Files.


def test_every_published_file_is_of_an_item_and_lists_its_claims() -> None:
    files = sorted((data_root() / "published").glob("*/*.csv"))
    of_item = {(i.paper, i.file) for i in items()}
    assert files
    for path in files:
        # A figure has claims; a table has values, and claims in a second file.
        rows = table(path.parent.name, path.stem)
        claims = path.stem.startswith("figure") or path.stem.endswith("-claims")
        assert rows
        assert (path.parent.name, path.stem.removesuffix("-claims")) in of_item
        if claims:
            assert list(rows[0]) == ["id", "claim", "criterion"]
            assert all(cell.strip() for row in rows for cell in row.values())


def test_a_table_is_kept_cell_by_cell() -> None:
    rows = table("grange", "table-2")
    assert rows[1] == {
        "name": "B",
        "dims": "[1, 2]",
        "kind": "angle",
        "noise": "0.2",
        "neighbours": "[A,B]",
    }


def test_the_data_are_those_of_the_working_copy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    repository_data = data_root()
    deep = tmp_path / "book" / "deep"
    for folder in (tmp_path / "data" / "published", deep):
        folder.mkdir(parents=True)
    # A chapter may run in any folder below the data.
    monkeypatch.chdir(deep)
    assert data_root() == repository_data  # another project's data is passed over
    (tmp_path / "data" / "published" / "items.csv").touch()
    assert data_root() == tmp_path / "data"


# Scenarios.

GAIN = '[parameters.gain]\nvalue = 0.05\nunit = "1"\nsource = "assumed"\nreason = "a sweep"\n'


AGENT = (
    '[[agents]]\nname = "{}"\nkind = "component"\nunit = "m"\nsource = "given"\n'
    "where = \"Table II\"\nneighbours = ['A', 'B']\n"
)
GOOD = 'title = "A study"\n' + GAIN + AGENT.format("A") + AGENT.format("B")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("value = 0.05", "value =", r"its form: .*line 3"),
        ("assumed", "given", r"\[parameters.gain\]: where must be a text"),
        (
            "neighbours = ['A', 'B']",
            "neighbours = ['A']",
            r"agents: neighbours must be mutual, got 'A' for 'B' only",
        ),
    ],
)
def test_a_fault_is_named_with_the_file(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    (tmp_path / "some").mkdir()
    path = tmp_path / "some" / "study.toml"
    path.write_text(GOOD)
    study = read_scenario(path)
    # Without the fault the file is read.
    assert study["gain"] == 0.05
    assert study.changes == ("some/study is no scenario of the book",)
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(ValueError, match=f"^some/study.toml: (?s:.*){words}"):
        read_scenario(path)


def test_values_are_the_file_s_and_cannot_be_changed() -> None:
    assert S["gain"] == 0.05
    assert S["members"] == 200
    assert "gain" in S
    assert "gian" not in S
    assert S["initial_state"].tolist() == [100.0, 0.0, 0.0, 10.0, 0.1, 0.0]
    # A study that changed its input would no longer be the one that is described.
    with pytest.raises(ValueError, match="read-only"):
        S["initial_state"][0] = 0.0
    assert S.agents[1].dims == (1, 2)
    assert S.agents[1]["noise"] == 0.2
    assert S.adjacency.tolist() == [[0, 1, 1], [1, 0, 0], [1, 0, 0]]


def test_a_change_is_noticed_and_named() -> None:
    assert S.changes == ()
    other = S.replace(gain=0.1, initial_state=[0.0] * 6)
    assert other.changes == (
        "initial_state: [0.0, 0.0, 0.0, 0.0, 0.0, 0.0] m, m/s, "
        "not [100.0, 0.0, 0.0, 10.0, 0.1, 0.0] m, m/s",
        "gain: 0.1, not 0.05",
    )
    # The digest depends on the values only, not on how they were set.
    back = other.replace(gain=0.05, initial_state=S["initial_state"])
    assert not back.changes
    assert back.digest == S.digest != other.digest


@pytest.mark.parametrize(
    ("old", "new", "changes"),
    [
        (
            'kind = "line_angle"\nnoise = 0.2\nunit = "rad"',
            'kind = "distance"\nnoise = 0.3\nunit = "m"',
            (
                "agents.B.kind: distance, not line_angle",
                "agents.B.noise: 0.3, not 0.2",
                "agents.B.unit: m, not rad",
            ),
        ),
        ('where = "Section V.B, (18)"', 'where = "elsewhere"', ()),
        (
            "[parameters.orbital_rate]",
            "[notes.orbital_rate]",
            ("orbital_rate: absent, not 0.1 rad/s",),
        ),
    ],
)
def test_a_changed_file_is_noticed_by_its_values(
    tmp_path: Path, old: str, new: str, changes: tuple[str, ...]
) -> None:
    text = (data_root() / "scenarios" / "grange" / "table-2.toml").read_text(
        encoding="utf-8"
    )
    path = tmp_path / "grange" / "table-2.toml"
    path.parent.mkdir()
    # Values count, texts such as the place in the paper do not.
    path.write_text(text.replace(old, new))
    other = read_scenario(path)
    assert old in text
    assert other.changes == changes
    assert (other.digest == S.digest) == (not changes)


def test_a_scenario_prints_every_parameter_and_its_reason() -> None:
    text = " ".join(repr(S).split())
    page = S._repr_html_()
    markdown = S._repr_markdown_()
    # Each form of the table has every parameter with its source and reason.
    for p in (*S.parameters.values(), *S.notes.values()):
        assert p.name in text
        assert f">{p.name}<" in page
        assert f"| {p.name} |" in markdown
        assert p.source in markdown
        assert p.why.replace("|", r"\|") in markdown
    assert ">100, 0, 0, 10, 0.1, 0<" in page
    assert ">A, B, C<" in page
    assert "A, B, C" in text
    assert (
        len({len(line.split("|")) for line in markdown.split("\n\n")[0].splitlines()})
        == 1
    )
    assert markdown_table(["a"], [["x | \\y"]]).endswith(r"| x \| \\y |")


# Recorded reads.


def test_reads_of_agents_are_recorded() -> None:
    # Two recordings of one scenario are independent.
    one = S.track_reads()
    two = S.track_reads()
    # Showing a scenario, or asking for changes, reads no cell for the study.
    repr(one), one._repr_html_(), one.digest, one.changes
    first = one.agents[0]
    assert first.dims == (0, 1)
    assert first.get("noise") == 0.2
    assert first.where == "Table II"
    # A worker of a study gets a copy, with the cells read so far.
    travelled = pickle.loads(pickle.dumps(one))
    # Rows are matched by name, in any order.
    assert (
        one.cells()
        == [{"name": "A", "dims": (0, 1), "noise": 0.2}, {"name": "B"}, {"name": "C"}]
        == travelled.cells()
    )
    assert two.cells()[0] == {"name": "A"}
    assert (one.adjacency == S.adjacency).all()
    assert "neighbours" in one.cells()[2]


def use_all(study: Scenario) -> Scenario:
    """Read every printed number of the agents, as a study does."""
    values = [(a.kind, a.dims, a.noise) for a in study.agents]
    assert len(values) == len(study.adjacency)
    return study


@pytest.mark.parametrize(
    ("item", "name"), [("Table II", "table-2"), ("Table III", "table-3")]
)
def test_used_values_are_read_as_printed(item: str, name: str) -> None:
    verdict = judge_parameters(
        "grange", item, use_all(scenario("grange", name).track_reads())
    )
    assert (verdict.verdict, verdict.why) == ("read", "")
    assert (
        judge_parameters("grange", item, table("grange", name)[::-1]).verdict == "read"
    )


def test_an_unused_cell_is_not_read() -> None:
    study = S.track_reads()
    for a in study.agents:
        # All cells but the neighbours are read.
        a.dims, a.noise, a.kind  # noqa: B018
    verdict = judge_parameters("grange", "Table II", study)
    why = "row A, neighbours: printed [A,B,C], not read by the study"
    assert (verdict.verdict, verdict.why) == ("differs", why)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"noise": 0.3}, "row B, noise: read 0.3, printed 0.2"),
        ({"noise": np.float64(0.2)}, ""),
        ({"dims": (2, 1)}, "row B, dims: read [2,1], printed [1, 2]"),
        ({"dims": np.array([1, 2])}, ""),
        ({"neighbours": ["A"]}, "row B, neighbours: read [A], printed [A,B]"),
        ({"name": "Z"}, "row B is printed but was not read"),
    ],
)
def test_rows_are_judged_to_the_first_difference(
    change: dict[str, Any], why: str
) -> None:
    verdict = judge_parameters(
        "grange", "Table II", [ROWS[0], {**ROWS[1], **change}, ROWS[2]]
    )
    assert (verdict.verdict, verdict.why) == ("differs" if why else "read", why)
    # A row too few or too many is a difference as well.
    assert judge_parameters("grange", "Table II", ROWS[:2]).why.startswith(
        "row C is printed"
    )
    extra = judge_parameters("grange", "Table II", [*ROWS, {**ROWS[0], "name": "D"}])
    assert extra.why == "row D was read but is not printed"


def test_formulas_are_compared_without_spaces() -> None:
    first, *others = table("grange", "table-1")
    for function, verdict in (("h( x )=x", "read"), ("h(x) = 2x", "differs")):
        changed = [{**first, "function": function}, *others]
        assert judge_parameters("grange", "Table I", changed).verdict == verdict


# Verdicts.


def test_every_claim_has_to_hold() -> None:
    # The order of the claims does not matter.
    match = judge_claims("grange", "Fig. 1", CLAIMS[::-1])
    assert match.verdict == "match"
    assert "pca-stable holds: share 0" in match.ours
    assert "unstable" in match.published
    assert match.why == ""
    differs = judge_claims("grange", "Fig. 1", DENIED, why="it is an EnKF")
    assert (differs.verdict, differs.why) == ("differs", "it is an EnKF")
    # A difference needs a reason, a match has none.
    assert "pca-stable fails" in differs.ours
    with pytest.raises(ValueError, match="^why must give a reason"):
        judge_claims("grange", "Fig. 1", DENIED)
    # A claim left out, one twice, and one that is not listed
    for claims in (
        CLAIMS[:2],
        [*CLAIMS, CLAIMS[2]],
        [*CLAIMS[:2], CLAIMS[2]._replace(id="other")],
    ):
        with pytest.raises(ValueError, match="^claims must be those of grange Fig. 1"):
            judge_claims("grange", "Fig. 1", claims)


def test_a_rule_that_its_null_passes_too_shows_nothing() -> None:
    def below(limit: float) -> Claim:
        return Claim.from_rule(
            "pca-stable", "share", lambda s: s < limit, 0.02, 0.3, "a coin"
        )

    # Limit 0.1: only ours passes. 0.5: the null passes too. 0.01: ours fails.
    verdicts = [
        judge_claims("grange", "Fig. 1", [CLAIMS[0], below(x), CLAIMS[2]], why="high")
        for x in (0.1, 0.5, 0.01)
    ]
    assert [v.verdict for v in verdicts] == ["match", "not comparable", "differs"]
    assert ["holds too" in v.null for v in verdicts] == [False, True, False]
    assert verdicts[1].why == "the rule of pca-stable holds for its null too"
    swept = below(0.1)._replace(range="for gains from .1 on")
    verdict = judge_claims("grange", "Fig. 1", [CLAIMS[0], swept, CLAIMS[2]])
    assert verdict.range == "pca-stable for gains from .1 on"
    hangs = judge_claims(
        "grange", "Fig. 1", [CLAIMS[0], swept, CLAIMS[2]], free="no gain printed"
    )
    assert (hangs.verdict, hangs.why) == ("not comparable", "no gain printed")


def test_a_failure_that_its_control_shares_shows_nothing() -> None:
    def below(limit: float) -> Claim:
        return Claim.from_rule(
            "pca-stable",
            "share",
            lambda s: s < limit,
            0.2,
            0.3,
            "a coin",
            control=0.05,
            control_case="exact gains",
        )

    # Limit 0.1: the rule accepts the control, and ours fails. 0.01: it rejects both.
    verdicts = [
        judge_claims("grange", "Fig. 1", [CLAIMS[0], below(x), CLAIMS[2]], why="high")
        for x in (0.1, 0.01)
    ]
    assert [v.verdict for v in verdicts] == ["differs", "not comparable"]
    assert verdicts[0].control == "pca-stable, exact gains: 0.05"
    assert verdicts[1].control == "pca-stable, exact gains: 0.05 (fails too)"
    assert verdicts[1].why == "the rule of pca-stable fails for its control too"


def test_a_fitted_input_gives_neither_match_nor_difference() -> None:
    why = "14 numbers fitted to 9"
    for claims in (CLAIMS, DENIED):
        verdict = judge_claims("grange", "Fig. 1", claims, fitted=why, free="no gain")
        assert (verdict.verdict, verdict.why) == ("fitted", why)
    # A reader's own scenario is not the fitted one.
    changed = judge_claims("grange", "Fig. 1", CLAIMS, fitted=why, scenario=CHANGED)
    assert changed.verdict == "not comparable"
    # A table of parameters cannot be fitted, and the reason is required.
    for item, reason in (("Table II", why), ("Fig. 1", "")):
        with pytest.raises(ValueError, match="^(verdict must|why must)"):
            Verdict("grange", item, "fitted", "a", "b", reason)


def test_a_verdict_is_stored_in_a_notebook() -> None:
    verdict = Verdict("grange", "Fig. 1", "differs", "a", "b", "because <so>")
    bundle = verdict._repr_mimebundle_()
    data = bundle["application/vnd.distfilt.verdict+json"]
    # The ledger reads the verdict back from the notebook's JSON.
    assert Verdict(**json.loads(json.dumps(data))) == verdict
    assert bundle["text/plain"] == (
        "grange Fig. 1: differs\n  ours       a\n  published  b\n  why        because <so>"
    )
    assert "because &lt;so&gt;" in bundle["text/html"]


def test_a_changed_scenario_is_not_compared() -> None:
    for verdict in (
        # Neither a match nor a difference says anything about another scenario.
        judge_claims("grange", "Fig. 1", CLAIMS, scenario=CHANGED),
        judge_claims("grange", "Fig. 1", DENIED, why="x", scenario=CHANGED),
        judge_parameters("grange", "Table II", ROWS, scenario=CHANGED),
        judge_parameters("grange", "Table II", use_all(CHANGED.track_reads())),
    ):
        why = "changed scenario: gain: 0.1, not 0.05"
        assert (verdict.verdict, verdict.why) == ("not comparable", why)
        assert verdict.ours
        assert verdict.published
    # The accepted scenario itself is compared, recorded or not.
    for study in (None, S, S.track_reads()):
        assert (
            judge_claims("grange", "Fig. 1", CLAIMS, scenario=study).verdict == "match"
        )
