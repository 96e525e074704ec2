"""Run the studies that take too long for a chapter, and store their metrics.

    python book/tools/studies.py [NAME ...] [--check] [--workers N]

Each ``book/studies/*.py`` defines one study: ``NAME``, ``PAPER`` (a key of the papers), ``trial``,
``parameters``, ``columns`` and ``seeds``, and if it wants ``code`` (other functions whose source is
recorded) and ``rtol`` (largest relative difference of a later run; 0, the same bits, without it).
Its metrics go to ``data/studies/PAPER/NAME.csv``. With ``--check`` nothing is written: every stored
trial runs again and is compared.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import re
import sys
import time
from pathlib import Path
from types import ModuleType

import cloudpickle

from common import ROOT
from distfilt import studies
from distfilt.published import PAPERS
from distfilt.studies.seeds import recipes
from distfilt.studies.files import jsons
from distfilt.studies.study import column_names

NEEDED = ("NAME", "PAPER", "trial", "parameters", "columns", "seeds")


def load_script(path: Path) -> ModuleType:
    """Import a study's script and check what it defines.

    Raises
    ------
    ValueError
        If it lacks one of the names, or NAME or PAPER is not one.
    """
    spec = importlib.util.spec_from_file_location(f"stored_study_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path.name}: cannot be imported")
    script = importlib.util.module_from_spec(spec)
    # inspect finds a class's source through sys.modules.
    sys.modules[spec.name] = script
    spec.loader.exec_module(script)
    # A worker cannot import it by its name: send its functions themselves.
    cloudpickle.register_pickle_by_value(script)
    lacking = [name for name in NEEDED if not hasattr(script, name)]
    if lacking:
        raise ValueError(f"{path.name}: has to define {', '.join(lacking)}")
    # A name that cannot be stored is found out now, not after the last trial.
    column_names(script.columns)
    if script.PAPER not in PAPERS:
        raise ValueError(f"{path.name}: PAPER needs one of {PAPERS}, got {script.PAPER!r}")
    if not isinstance(script.NAME, str) or not re.fullmatch(r"[a-z0-9][a-z0-9-]*", script.NAME):
        raise ValueError(f"{path.name}: NAME needs small letters, digits, -, got {script.NAME!r}")
    return script


def target(script: ModuleType, root: Path) -> Path:
    """Return where a script's metrics are stored."""
    return root / "data" / "studies" / script.PAPER / f"{script.NAME}.csv"


def scripts(root: Path) -> list[ModuleType]:
    """Return the scripts of a repository, in order; two for one file are an error."""
    out = [load_script(path) for path in sorted((root / "book" / "studies").glob("*.py"))]
    targets = [target(script, root) for script in out]
    twice = sorted({t.name for t in targets if targets.count(t) > 1})
    if twice:
        raise ValueError(f"{', '.join(twice)}: made by more than one script")
    return out


def orphans(root: Path, known: list[ModuleType]) -> list[str]:
    """Return the stored studies that no script makes."""
    made = {target(script, root) for script in known}
    stored = sorted((root / "data" / "studies").rglob("*.csv"))
    return [path.relative_to(root).as_posix() for path in stored if path not in made]


def run(script: ModuleType, root: Path, workers: int | None) -> None:
    """Run one study at full size and store it."""
    study = studies.run(script.trial, script.seeds, errors="collect", workers=workers)
    for failure in study.failures:
        print(f"  {failure}", file=sys.stderr)
    path = studies.store(
        study,
        target(script, root),
        parameters=script.parameters,
        columns=script.columns,
        code=getattr(script, "code", ()),
    )
    print(f"{path.relative_to(root)}: {study!r}, {study.seconds:.0f} s", flush=True)


def check(script: ModuleType, root: Path, workers: int | None) -> str:
    """Run one study's stored trials again; return what is wrong, or ''."""
    path, began = target(script, root), time.perf_counter()
    if not path.is_file():
        return f"{path.relative_to(root)}: not stored yet: make studies"
    rtol = getattr(script, "rtol", 0.0)
    try:
        stored = studies.check(path, script.trial, rtol=rtol, workers=workers)
    except (AssertionError, ValueError) as error:
        return str(error)
    if recipes(script.seeds) != stored.recipes:
        return f"{path.relative_to(root)}: the script has other seeds: make studies"
    written = {name: json.loads(text) for name, text in jsons(script.parameters).items()}
    if written != stored.parameters or tuple(script.columns) != tuple(stored.columns):
        return f"{path.relative_to(root)}: the script has other parameters: make studies"
    print(f"{path.relative_to(root)}: {len(stored)} trials agree, "
          f"{time.perf_counter() - began:.0f} s", flush=True)
    return ""


def main(arguments: list[str] | None = None, root: Path = ROOT) -> int:
    parser = argparse.ArgumentParser(description="Run and store the long studies.")
    parser.add_argument("names", nargs="*", help="NAMEs of studies; all without one")
    parser.add_argument("--check", action="store_true", help="run again and compare")
    parser.add_argument("--workers", type=int, default=None, help="one for each core without it")
    options = parser.parse_args(arguments)
    known = scripts(root)
    unknown = sorted(set(options.names) - {script.NAME for script in known})
    if unknown:
        print(f"{', '.join(unknown)}: no such study; there are "
              f"{', '.join(script.NAME for script in known) or 'none'}", file=sys.stderr)
        return 1
    chosen = [s for s in known if not options.names or s.NAME in options.names]
    problems = [f"{path}: no script in book/studies makes it" for path in orphans(root, known)]
    if not known:
        print("book/studies holds no script: there is no long study to run")
    for script in chosen:
        if options.check:
            problems.append(check(script, root, options.workers))
        else:
            run(script, root, options.workers)
    for problem in filter(None, problems):
        print(problem, file=sys.stderr)
    return int(any(problems))


if __name__ == "__main__":
    sys.exit(main())
