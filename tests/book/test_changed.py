"""Chapter 4 as a template: with other links or another sensor it runs to its end."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

import execute
from common import ROOT, VERDICT, fixed_environment

PAGES = ("04-satellite-network.md", "04b-five-agents-and-a-pose.md")
# A link has two ends: a change of one alone would be refused.
LINKS = (
    ('neighbours = ["A", "B"]', 'neighbours = ["A", "B", "C"]'),
    ('neighbours = ["A", "C"]', 'neighbours = ["A", "B", "C"]'),
)
# A sensor that measures a length instead of an angle has another unit too.
SENSOR = (
    (
        'kind = "line_angle"\nnoise = 0.2\nunit = "rad"',
        'kind = "distance"\nnoise = 0.2\nunit = "m"',
    ),
)


def copy_chapter(target: Path, changes: tuple[tuple[str, str], ...]) -> Path:
    """Copy the chapter and its data, with a changed scenario of Table II."""
    for name in ("book", "data"):
        shutil.copytree(
            ROOT / name, target / name, ignore=shutil.ignore_patterns("__pycache__")
        )
    path = target / "data" / "scenarios" / "grange" / "table-2.toml"
    text = path.read_text(encoding="utf-8")
    for old, new in changes:
        # A change that finds no text would test the unchanged chapter.
        assert text.count(old) == 1
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")
    return target / "book"


def verdicts(notebook: Any) -> dict[str, tuple[str, str]]:
    """Return verdict and reason of each item, from the outputs of the cells."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    bundles = [output.get("data", {}).get(VERDICT) for output in outputs]
    return {
        verdict["item"]: (verdict["verdict"], verdict["why"])
        for verdict in bundles
        if verdict
    }


@pytest.mark.slow
@pytest.mark.parametrize("changes", [LINKS, LINKS + SENSOR], ids=["links", "both"])
def test_a_changed_scenario_runs_to_the_end_and_is_not_compared(
    changes: tuple[tuple[str, str], ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = copy_chapter(tmp_path, changes)
    # As for a reader: a statement that no longer holds prints, and the notebook runs
    # on.
    lenient = {k: v for k, v in fixed_environment().items() if k != "BOOK_STRICT"}
    monkeypatch.setattr(execute, "fixed_environment", lambda: lenient)
    results = {}
    for page in PAGES:
        notebook = execute.read(folder / page)
        execute.run(notebook, folder)
        # It raised nothing, and warned of nothing.
        assert execute.complaints(notebook) == []
        results |= verdicts(notebook)
    # Items that use the changed scenario cannot be compared with the paper ...
    for item in ("Table II", "Fig. 1"):
        verdict, why = results[item]
        assert verdict == "not comparable"
        assert why.startswith("changed scenario: agents.")
    # ... the table of another scenario is read as before.
    assert results["Table III"][0] == "read"
    assert results["Fig. 2"][0] == "not comparable"
