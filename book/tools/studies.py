"""Run the studies that take too long for a chapter, and store their metrics.

    python book/tools/studies.py [NAME ...] [--check] [--workers N]

Each ``book/studies/*.py`` defines one study, which serves one item: ``NAME`` (the item's, such as
``figure-2``), ``PAPER`` (a key of the papers), ``trial``, ``parameters``, ``columns`` and
``seeds``. Optional are ``code`` (other functions whose source is recorded), the tolerances of
``studies.check`` (``rtol``, ``atol``, ``ill_conditioned``, ``max_outliers``; without them the bits
must be the same), and ``scenarios`` (those that it reads). A scenario's digest is stored among the
parameters, and a scenario that differs from the accepted one is rejected. Code of several scripts
is in ``book/studies/_NAME.py``, which they import by that name.

Metrics go to ``data/studies/PAPER/NAME.csv``; ``studies.stored(PAPER, NAME)`` loads them. The same
command continues a run that was stopped. With ``--check`` nothing is written: every stored trial
runs again and is compared.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

from bookkit import studies
from bookkit.published import PAPERS
from bookkit.studies.files import plain_json, seed_text
from common import ROOT

ALLOWED = ("rtol", "atol", "ill_conditioned", "max_outliers")
NEEDED = ("NAME", "PAPER", "trial", "parameters", "columns", "seeds")


def load_script(path: Path) -> ModuleType:
    """Import a study's script and check its definitions.

    Raises
    ------
    ValueError
        If it lacks one of the names, or NAME or PAPER is not one.
    """
    script = studies.script(path.stem, folder=path.parent)
    lacking = [name for name in NEEDED if not hasattr(script, name)]
    if lacking:
        raise ValueError(f"{path.name}: has to define {', '.join(lacking)}")
    # Both names become parts of a path.
    if script.PAPER not in PAPERS:
        raise ValueError(
            f"{path.name}: PAPER needs one of {PAPERS}, got {script.PAPER!r}"
        )
    if not isinstance(script.NAME, str) or not re.fullmatch(
        r"[a-z0-9][a-z0-9-]*", script.NAME
    ):
        raise ValueError(
            f"{path.name}: NAME needs small letters, digits, -, got {script.NAME!r}"
        )
    return script


def parameters_of(script: ModuleType) -> dict[str, Any]:
    """Return a study's parameters with the digests of the scenarios that it reads."""
    read = getattr(script, "scenarios", ())
    return {
        **script.parameters,
        **{f"scenario_{s.name.replace('-', '_')}": s.digest for s in read},
    }


def changes_of(script: ModuleType) -> str:
    """Describe the differences of a study's scenarios from the accepted ones, or ''."""
    # Results of a changed scenario must not be stored as the paper's.
    changes = [c for s in getattr(script, "scenarios", ()) for c in s.changes]
    return (
        f"{script.NAME}: changed scenario: {'; '.join(changes)}: make update-scenarios"
        if changes
        else ""
    )


def target(script: ModuleType, root: Path) -> Path:
    """Return where a script's metrics are stored."""
    return root / "data" / "studies" / script.PAPER / f"{script.NAME}.csv"


def scripts(root: Path) -> list[ModuleType]:
    """Return the scripts of a repository, in order; two for one file are an error."""
    paths = sorted((root / "book" / "studies").glob("*.py"))
    all_scripts = [load_script(path) for path in paths if not path.name.startswith("_")]
    # Two scripts must not write the same file.
    targets = [target(script, root) for script in all_scripts]
    twice = sorted({t.name for t in targets if targets.count(t) > 1})
    if twice:
        raise ValueError(f"{', '.join(twice)}: made by more than one script")
    return all_scripts


def orphans(root: Path, all_scripts: list[ModuleType]) -> list[str]:
    """Return the stored studies that no script makes."""
    targets = {target(script, root) for script in all_scripts}
    stored = sorted((root / "data" / "studies").rglob("*.csv"))
    return [path.relative_to(root).as_posix() for path in stored if path not in targets]


def run(script: ModuleType, root: Path, workers: int | None) -> None:
    """Run one study at full size, or its unfinished trials, and store it."""
    start_time = time.perf_counter()
    path = studies.store(
        target(script, root),
        script.trial,
        script.seeds,
        columns=script.columns,
        parameters=parameters_of(script),
        code=getattr(script, "code", ()),
        workers=workers,
    )
    # Reading the file back checks it.
    stored = studies.load(path)
    seconds = time.perf_counter() - start_time
    failed = [f"trial {k}: {kind}" for k, kind in enumerate(stored.failures) if kind]
    print(*failed, sep="\n", end="\n" * bool(failed), file=sys.stderr)
    print(
        f"{path.relative_to(root)}: {len(stored)} trials, {seconds:.0f} s", flush=True
    )


def check(script: ModuleType, root: Path, workers: int | None) -> str:
    """Run one study's stored trials again; return the problems, or ''."""
    path = target(script, root)
    start_time = time.perf_counter()
    file = path.relative_to(root)
    if not path.is_file():
        return f"{file}: not stored yet: make studies"
    # Tolerances are optional names of a script.
    options = {name: getattr(script, name) for name in ALLOWED if hasattr(script, name)}
    try:
        stored = studies.check(path, script.trial, workers=workers, **options)
    except (AssertionError, ValueError) as error:
        return str(error)
    # The stored trials agree; now the script must still ask for the same ones.
    if tuple(map(seed_text, script.seeds)) != stored.seeds:
        return f"{file}: the script has other seeds: make studies"
    # Compare as JSON, in which arrays are lists and tuples too.
    written = {
        name: json.loads(text)
        for name, text in plain_json(parameters_of(script)).items()
    }
    if written != stored.parameters or tuple(script.columns) != tuple(stored.columns):
        return f"{file}: the script has other parameters: make studies"
    seconds = time.perf_counter() - start_time
    print(f"{file}: {len(stored)} trials agree, {seconds:.0f} s", flush=True)
    return ""


def main(arguments: list[str] | None = None, root: Path = ROOT) -> int:
    parser = argparse.ArgumentParser(description="Run and store the long studies.")
    parser.add_argument("names", nargs="*", help="NAMEs of studies; all without one")
    parser.add_argument("--check", action="store_true", help="run again and compare")
    parser.add_argument(
        "--workers", type=int, default=None, help="one for each core without it"
    )
    options = parser.parse_args(arguments)
    all_scripts = scripts(root)
    # A misspelt name must not pass as "nothing to do".
    unknown = sorted(set(options.names) - {script.NAME for script in all_scripts})
    if unknown:
        print(
            f"{', '.join(unknown)}: no such study; there are "
            f"{', '.join(script.NAME for script in all_scripts) or 'none'}",
            file=sys.stderr,
        )
        return 1
    chosen = [s for s in all_scripts if not options.names or s.NAME in options.names]
    problems = [
        f"{path}: no script in book/studies makes it"
        for path in orphans(root, all_scripts)
    ]
    if not all_scripts:
        print("book/studies holds no script: there is no long study to run")
    for script in chosen:
        changes = changes_of(script)
        if changes:
            problems.append(changes)
        elif options.check:
            problems.append(check(script, root, options.workers))
        else:
            run(script, root, options.workers)
    for problem in filter(None, problems):
        print(problem, file=sys.stderr)
    return int(any(problems))


if __name__ == "__main__":
    sys.exit(main())
