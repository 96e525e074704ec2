"""Files and parts that several of these tests write and read."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from pathlib import Path

from bookkit.published import Parameter, Row, Verdict

SCRATCH = Path(tempfile.mkdtemp(prefix="published-"))
atexit.register(shutil.rmtree, SCRATCH, ignore_errors=True)


def written(name: str, content: str | bytes) -> Path:
    """A file of that content in a folder of this test run."""
    path = SCRATCH / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def parameter(**changes: object) -> Parameter:
    fields = {"name": "gain", "value": 0.05, "unit": "1", "source": "assumed", "reason": "x"}
    return Parameter(**(fields | changes))


def row(**changes: object) -> Row:
    """An agent; None leaves a column out."""
    cells = {"name": "A", "dims": (0,), "kind": "direct", "noise": 0.2, "neighbours": ("A",),
             "unit": "m", "source": "given", "where": "Table II"} | changes  # fmt: skip
    return Row({key: value for key, value in cells.items() if value is not None})


def verdict(**changes: object) -> Verdict:
    fields = {
        "paper": "grange",
        "item": "Fig. 1",
        "verdict": "match",
        "ours": "a",
        "published": "b",
    }
    return Verdict(**(fields | changes))


def named(tables: dict[str, list]) -> dict[str, list]:
    """Bad-input cases under the qualified names of the package's face."""
    return {f"bookkit.published.{name}": cases for name, cases in tables.items()}
