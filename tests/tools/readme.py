"""Run the code of README.md with the installed library, as a user would.

    python tests/tools/readme.py

`make dist` runs it in an empty environment, once with the wheel and once with the source archive.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def main() -> int:
    import distfilt

    location = Path(distfilt.__file__)
    if location.is_relative_to(ROOT / "distfilt"):
        sys.exit(f"the installed library is needed, got the repository's: {location}")
    (block,) = BLOCK.findall((ROOT / "README.md").read_text(encoding="utf-8"))
    exec(compile(block, "README.md", "exec"), {})
    print(f"README.md runs: distfilt {distfilt.__version__}, Python {sys.version}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
