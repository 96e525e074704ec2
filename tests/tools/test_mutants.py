"""The mutation tool: it draws changes of behaviour, tests them, and restores the copy."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("cosmic_ray", reason="the extra mutants is not installed")

from . import mutants

LIBRARY = '''"""Text."""

def half(x: int | None, scale: float = 2.0) -> float | None:
    """Half."""
    if x is None:
        return None
    return x / scale


def unused(x: int) -> int:
    return x + 1
'''
TESTS = """
from distfilt.a import half

def test_half():
    assert half(3) == 1.5 and half(None) is None and half(9, 3.0) == 3.0
"""


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    for folder, name, text in (
        ("distfilt", "a.py", LIBRARY),
        ("tests", "test_a.py", TESTS),
    ):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "__init__.py").touch()
        (tmp_path / folder / name).write_text(text, encoding="utf-8")
    return tmp_path


def test_changes_of_types_and_docstrings_are_not_drawn(repository: Path) -> None:
    # Other types and texts, the same behaviour
    same = LIBRARY.replace("int | None", "int & None").replace("Half.", "Whole.")
    assert mutants.meaning(same) == mutants.meaning(LIBRARY)
    assert mutants.meaning(
        LIBRARY.replace("x / scale", "x * scale")
    ) != mutants.meaning(LIBRARY)
    for mutant in mutants.draw_sample(repository, 50, 3, ""):
        mutated = mutant.source(LIBRARY)
        assert mutants.meaning(mutated) != mutants.meaning(LIBRARY)


def test_a_sample_depends_on_the_seed_and_has_one_change_a_position(
    repository: Path,
) -> None:
    sample = mutants.draw_sample(repository, 50, 3, "")
    # Reproducible; a smaller sample is the beginning of a larger one.
    assert sample == mutants.draw_sample(repository, 50, 3, "")
    assert len(sample) >= 4
    assert len({(m.line, m.column) for m in sample}) == len(sample)
    assert mutants.draw_sample(repository, 2, 3, "") == sample[:2]
    assert mutants.draw_sample(repository, 50, 3, "other") == []


def test_tests_of_a_line_run_its_statement_or_function_or_module() -> None:
    text = "A = (\n    1\n)\n\ndef f(x,\n      y=2):\n    z = (x +\n         y)\n    return z\n"
    # Lines and the tests that run them; '' is the import.
    # As coverage stores them: TEST|PHASE, with the parameters of the test in brackets
    contexts = {
        1: [""],
        5: [""],
        7: ["t.py::a[1]|run", "t.py::a[2]|run", ""],
        9: ["t.py::b|call"],
    }
    # The statement of lines 7 and 8; line 6 belongs to the function only.
    assert mutants.running(contexts, text, 8) == ["t.py::a"]
    assert mutants.running(contexts, text, 9) == ["t.py::b"]
    assert mutants.running(contexts, text, 6) == ["t.py::a", "t.py::b"]
    assert mutants.running(contexts, text, 2) == ["t.py::a", "t.py::b"]
    assert mutants.running({1: [""]}, text, 8) == []


def run(repository: Path, table: Path, *options: str) -> str:
    """Run the tool in a separate process, on that repository."""
    call = f"import mutants; from pathlib import Path; mutants.main({['--jobs', '2', *options]}, "
    call += f"Path({str(repository)!r}), Path({str(table)!r}))"
    # The process imports the tool by its name.
    tools = Path(mutants.__file__).parent
    return subprocess.run(
        [sys.executable, "-c", call],
        cwd=tools,
        check=True,
        capture_output=True,
        text=True,
    ).stdout


@pytest.mark.slow
def test_mutants_are_killed_or_survive_and_a_run_continues(
    repository: Path, tmp_path: Path
) -> None:
    table = tmp_path / "out" / "mutants.csv"
    # With no time at all one mutant still runs, so that every call gets on.
    assert "of 1 killed" in run(
        repository, table, "--jobs", "1", "--sample", "4", "--minutes", "0"
    )
    assert run(repository, table, "--sample", "4").count("distfilt/a.py") == 3
    run(repository, table, "--sample", "50")
    with table.open(newline="") as lines:
        rows = {(r["was"], r["result"]) for r in csv.DictReader(lines)}
    # The tested function's mutants are killed, those of the unused one survive.
    assert ("return x / scale", "killed") in rows
    assert (
        "return x + 1",
        "survived",
    ) in rows
    assert ("return x / scale", "survived") not in rows
    assert (repository / "distfilt" / "a.py").read_text() == LIBRARY
    text = table.read_text()
    # Reasons are written into the table by hand, and must survive the next run.
    reasoned = re.sub(r"^(.*,survived,.*)$", r"\1dead code", text, flags=re.M)
    table.write_text(reasoned)
    assert run(repository, table, "--sample", "50").count("distfilt/a.py") == 0
    assert table.read_text() == reasoned
    assert text.count(",survived,") > 0
