"""Run every benchmark in turn; missed floors are listed at the end and give an error.

python tests/bench/run.py [--force] [name …]
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def main(arguments: list[str]) -> int:
    """Run the scripts, all or the named ones; 1 if any missed a floor or broke."""
    options = [a for a in arguments if a.startswith("-")]
    names = {a for a in arguments if not a.startswith("-")}
    missed = []
    for script in sorted(Path(__file__).parent.glob("bench_*.py")):
        name = script.stem.removeprefix("bench_")
        if not names or name in names:
            print(f"== {name}", flush=True)
            code = subprocess.run([sys.executable, str(script), *options]).returncode
            missed += [f"{name}: {code} missed" if code > 0 else f"{name}: stopped"] * (
                code != 0
            )
    print("\n".join(missed) or "every floor holds")
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
