"""Faults that were made once are found by the tests that were written for them."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("cosmic_ray", reason="the extra mutants is not installed")

from . import faults, mutants


@pytest.mark.parametrize("fault", faults.FAULTS, ids=lambda f: f.what)
def test_a_fault_can_still_be_made(fault: faults.Fault) -> None:
    """The line is there, the change is one, and the test exists."""
    text = (mutants.ROOT / "distfilt" / fault.module).read_text(encoding="utf-8")
    assert fault.line in text
    changed = text.replace(fault.line, fault.fault, 1)
    assert mutants.meaning(changed) != mutants.meaning(text)
    file, _, name = fault.test.partition("::")
    tests = (mutants.ROOT / "tests" / file).read_text(encoding="utf-8")
    assert not name or f"def {name}(" in tests


@pytest.mark.slow
def test_every_fault_is_found(tmp_path: Path) -> None:
    import subprocess
    import sys

    tool = Path(faults.__file__)
    call = "import faults; from pathlib import Path; "
    call += f"faults.main([], Path({str(tmp_path)!r}) / 'f')"
    done = subprocess.run(
        [sys.executable, "-c", call], cwd=tool.parent, capture_output=True, text=True
    )
    assert "MISSED" not in done.stdout and done.stdout.count("found ") == len(faults.FAULTS)
