"""Code of a user passes ``mypy --strict``: the README's block and every example."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_user_code_passes_a_strict_type_checker(tmp_path: Path) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.*?)^```$", readme, re.M | re.S)
    script = tmp_path / "readme.py"
    script.write_text(block, encoding="utf-8")
    examples = sorted(str(path) for path in (ROOT / "book" / "examples").glob("*.py"))
    # The settings of the repository hold for its own code, so that a user's must be
    # given here.
    options = ["--strict", "--config-file", str(ROOT / "pyproject.toml")]
    command = [sys.executable, "-m", "mypy", *options, str(script), *examples]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout
