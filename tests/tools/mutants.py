"""How many random faults in the library do its tests find?

    python tests/tools/mutants.py [--sample 300] [--seed 1] [--jobs 2] [--only network]
        [--minutes 30]

cosmic-ray lists the places where the library's code can be changed (an operator, a comparison, a
number, a keyword) and makes the change; a seeded sample of places is drawn, and one change at each.
The draw looks at a place's own line, so that most of a sample stays when other code changes.
A mutant is tested in two stages: by the file that mirrors the module and the module's own examples,
then by every test that runs the changed line, but for those of the book (the suite runs once with a
tracer for that; a line that runs on import only is tested by what runs its function or module). It
survives if all pass. A change of a type or a text only is no fault and is not drawn.

Writes ``data/bench/mutants.csv``, a line a mutant. A survivor that is equivalent to the original
gets a reason there by hand, which a later run of the same mutant keeps; the share of the others is
the result. With ``--minutes`` the run ends after that time, and the next one goes on: a mutant in
the table is not run again. Each job works in a copy of the repository.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import pandas

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "data" / "bench" / "mutants.csv"
COLUMNS = ("module", "line", "was", "becomes", "result", "stage", "seconds", "reason")
SECONDS = (120, 400)
"""What the tests of each stage may take; a mutant that takes longer hangs, and so is found."""
EVERY = (
    "distfilt",
    "tests",
    *(f"--ignore=tests/{name}" for name in ("book", "tools")),
    "--ignore=tests/test_package.py",
)


@dataclass(frozen=True)
class Mutant:
    """One change at one place."""

    module: str
    operator: str
    occurrence: int
    line: int
    column: int

    def source(self, text: str) -> str:
        """The module's text with the change."""
        from cosmic_ray.mutating import mutate_code
        from cosmic_ray.plugins import get_operator

        return str(mutate_code(text, get_operator(self.operator)(), self.occurrence))


def mutants(root: Path, only: str) -> Iterator[Mutant]:
    """Every change that an operator without set-up can make to the library's modules."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator, operator_names

    kinds = {name: get_operator(name) for name in sorted(operator_names())}
    plain = {name: kind() for name, kind in kinds.items() if not kind.arguments()}
    for path in sorted((root / "distfilt").rglob("*.py")):
        module = path.relative_to(root).as_posix()
        if path.name == "__init__.py" or not module.startswith(f"distfilt/{only}"):
            continue
        nodes = list(ast_nodes(get_ast(path.read_text(encoding="utf-8"))))
        for name, operator in plain.items():
            places = (
                place for node in nodes for place in operator.mutation_positions(node)
            )
            for occurrence, (start, _) in enumerate(places):
                yield Mutant(module, name, occurrence, *start)


def meaning(text: str) -> str:
    """What a module's text does: its syntax tree without types and docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        for name in ("annotation", "returns"):
            if hasattr(node, name):
                setattr(node, name, None)
        body = getattr(node, "body", None)
        first = body[0] if isinstance(body, list) and body else None
        if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
            first.value = ast.Constant("")
    return ast.dump(tree)


def keys(places: list[tuple[str, int, int]], root: Path, seed: int) -> dict[Any, str]:
    """A place's number in the lottery, from its line's text: it stays when other code changes."""
    out = {}
    seen = Counter[str]()
    lines = dict[str, list[str]]()
    for module, line, column in sorted(places):
        if module not in lines:
            lines[module] = (root / module).read_text(encoding="utf-8").splitlines()
        text = f"{seed} {module} {lines[module][line - 1].strip()} {column}"
        seen[text] += 1
        out[module, line, column] = sha256(f"{text} {seen[text]}".encode()).hexdigest()
    return out


def drawn(root: Path, size: int, seed: int, only: str) -> list[Mutant]:
    """A sample of places, and one change at each, that is a change of what the code does."""
    places: dict[tuple[str, int, int], list[Mutant]] = {}
    for mutant in mutants(root, only):
        places.setdefault((mutant.module, mutant.line, mutant.column), []).append(
            mutant
        )
    numbers = keys(list(places), root, seed)
    out: list[Mutant] = []
    for place in sorted(places, key=numbers.__getitem__):
        if len(out) == size:
            break
        mutant = random.Random(numbers[place]).choice(places[place])
        text = (root / mutant.module).read_text(encoding="utf-8")
        try:
            if meaning(mutant.source(text)) != meaning(text):
                out.append(mutant)
        except SyntaxError:
            continue
    return out


def nearest(module: str, root: Path) -> list[str]:
    """The module's own examples, the file of tests that mirrors it, and what holds for all."""
    parts = Path(module).with_suffix("").parts[1:]
    name = f"test_{parts[-1].lstrip('_')}.py"
    mirrors = [
        root.joinpath("tests", *parts[:-1], name),
        root / "tests" / f"test_{parts[0]}.py",
    ]
    options = [p for p in (root / "tests" / "test_validation.py",) if p.is_file()]
    near = [*[p for p in mirrors if p.is_file()][:1], *options]
    return [module, *(p.relative_to(root).as_posix() for p in near)]


def traced(root: Path, jobs: int) -> Any:
    """Which tests run which lines: the stored trace of the suite, or a new one."""
    from coverage import CoverageData

    path = root / "_build" / "lines.coverage"
    sources = [p for name in ("distfilt", "tests") for p in (root / name).rglob("*.py")]
    if not path.is_file() or path.stat().st_mtime < max(
        p.stat().st_mtime for p in sources
    ):
        path.parent.mkdir(exist_ok=True)
        subprocess.run(
            [
                sys.executable,
                "-m",
                "pytest",
                "-q",
                "-n",
                str(jobs),
                "--dist",
                "loadscope",
                "--cov=distfilt",
                "--cov-context=test",
                "--cov-report=",
                *EVERY,
            ],
            cwd=root,
            check=True,
            stdin=subprocess.DEVNULL,
            env=os.environ
            | {
                "COVERAGE_FILE": str(path),
                "PYTHONPATH": str(root),
                "HYPOTHESIS_PROFILE": "gate",
            },
        )
    data = CoverageData(basename=str(path))
    data.read()
    return data


def running(contexts: dict[int, list[str]], text: str, line: int) -> list[str]:
    """The tests that run a line's statement, else its function, else its module."""
    nodes = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.stmt)]
    spans = [(n.lineno, n.end_lineno or n.lineno) for n in nodes]
    around = [(a, b) for a, b in spans if a <= line <= b]
    for first, last in (
        *sorted(around, key=lambda s: s[1] - s[0]),
        (1, text.count("\n") + 1),
    ):
        found = {c for n in range(first, last + 1) for c in contexts.get(n, ()) if c}
        if found:
            # Without the parameters, whose names may come from the library.
            return sorted({c.rpartition("|")[0].partition("[")[0] for c in found})
    return []


def passes(tests: list[str], folder: Path, seconds: float) -> bool:
    """Whether the tests pass in a copy, in time."""
    command = [
        sys.executable,
        "-B",
        "-m",
        "pytest",
        "-q",
        "-x",
        "-p",
        "no:cacheprovider",
        *tests,
    ]
    child = subprocess.Popen(
        command,
        cwd=folder,
        start_new_session=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": str(folder), "HYPOTHESIS_PROFILE": "gate"},
    )
    try:
        return child.wait(seconds) in (0, 5)  # 5: no test there
    except subprocess.TimeoutExpired:
        return False
    finally:
        with contextlib.suppress(ProcessLookupError):  # and workers that it left behind
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()


def described(mutant: Mutant, root: Path) -> dict[str, Any]:
    """The line of the table for a mutant that was not run."""
    text = (root / mutant.module).read_text(encoding="utf-8")
    pairs = zip(text.splitlines(), mutant.source(text).splitlines(), strict=False)
    was, becomes = next((a.strip(), b.strip()) for a, b in pairs if a != b)
    row: dict[str, Any] = {"module": mutant.module, "line": mutant.line, "was": was}
    return row | {
        "becomes": becomes,
        "result": "",
        "stage": "",
        "seconds": "",
        "reason": "",
    }


def tested(
    mutant: Mutant, stages: list[list[str]], free: SimpleQueue[Path]
) -> dict[str, Any]:
    """What became of one mutant, in a copy that no other one is using."""
    folder = free.get()
    path = folder / mutant.module
    text = path.read_text(encoding="utf-8")
    found: dict[str, Any] = {"result": "survived"}
    began = time.perf_counter()
    path.write_text(mutant.source(text), encoding="utf-8")
    try:
        for stage, names in enumerate(stages, start=1):
            found["stage"] = stage
            if names and not passes(names, folder, SECONDS[stage - 1]):
                found["result"] = "killed"
                break
    finally:
        path.write_text(text, encoding="utf-8")
        free.put(folder)
    return found | {"seconds": f"{time.perf_counter() - began:.0f}"}


def stages(mutant: Mutant, root: Path, trace: Any) -> list[list[str]]:
    """The tests of both stages."""
    path = root / mutant.module
    lines = trace.contexts_by_lineno(str(path))
    text = path.read_text(encoding="utf-8")
    return [nearest(mutant.module, root), running(lines, text, mutant.line)]


def run(
    rows: list[tuple[Mutant, dict[str, Any]]], root: Path, jobs: int
) -> Iterator[None]:
    """Complete the rows, each job with a copy of the repository; yields after each one."""
    trace = traced(root, jobs)
    left_out = shutil.ignore_patterns(
        ".git", ".venv", "_build", "__pycache__", ".*_cache"
    )
    free: SimpleQueue[Path] = SimpleQueue()
    with (
        tempfile.TemporaryDirectory(prefix="mutants-") as own,
        ThreadPoolExecutor(jobs) as pool,
    ):
        for k in range(jobs):
            free.put(shutil.copytree(root, Path(own) / str(k), ignore=left_out))
        waiting = {
            pool.submit(tested, m, stages(m, root, trace), free): row for m, row in rows
        }
        try:
            for future in as_completed(waiting):
                row = waiting[future]
                row |= future.result()
                place = f"{row['module']}:{row['line']}"
                print(f"{row['result']:8} {place}: {row['becomes']}", flush=True)
                yield
        finally:
            pool.shutdown(cancel_futures=True)


def known(table: Path) -> dict[tuple[str, str, str], dict[str, Any]]:
    """The lines of an earlier run, by module and change."""
    if not table.is_file():
        return {}
    rows = pandas.read_csv(table, dtype=str, keep_default_na=False).to_dict("records")
    return {(r["module"], r["was"], r["becomes"]): r for r in rows}


def stored(rows: list[dict[str, Any]], table: Path) -> None:
    """Write the table; in one step, so that a run that is ended leaves a whole one."""
    table.parent.mkdir(parents=True, exist_ok=True)
    part = table.with_suffix(".part")
    pandas.DataFrame(rows, columns=COLUMNS).to_csv(
        part, index=False, lineterminator="\n"
    )
    part.replace(table)


def main(
    arguments: list[str] | None = None, root: Path = ROOT, table: Path = TABLE
) -> int:
    parser = argparse.ArgumentParser(
        description="Random faults, and whether the tests find them."
    )
    parser.add_argument("--sample", type=int, default=300, help="how many places")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", default="", help="a folder or module of the library")
    parser.add_argument(
        "--minutes", type=float, default=1e6, help="when to stop for now"
    )
    options = parser.parse_args(arguments)
    before = known(table)
    chosen = drawn(root, options.sample, options.seed, options.only)
    pairs = []
    for mutant in chosen:
        row = described(mutant, root)
        old = before.get((row["module"], row["was"], row["becomes"]), {})
        pairs.append((mutant, row | {n: old[n] for n in COLUMNS[4:] if n in old}))
    waiting = [(m, row) for m, row in pairs if not row["result"]]
    rows = [row for _, row in pairs]
    end = time.monotonic() + 60 * options.minutes
    stored(rows, table)
    for _ in run(waiting, root, options.jobs) if waiting else ():
        stored(rows, table)
        if time.monotonic() > end:
            break
    ran = [row for row in rows if row["result"]]
    killed = sum(row["result"] == "killed" for row in ran)
    equivalent = sum(row["result"] == "survived" and bool(row["reason"]) for row in ran)
    share = killed / max(len(ran) - equivalent, 1)
    print(
        f"{killed} of {len(ran)} killed, {equivalent} equivalent: {share:.1%} of the others"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
