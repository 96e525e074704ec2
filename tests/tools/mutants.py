"""Count the random mutations of the library that its tests detect.

    python tests/tools/mutants.py [--sample 300] [--seed 1] [--jobs 2] [--only network]
        [--minutes 30]

cosmic-ray lists the positions where code can be mutated (an operator, a comparison, a number, a
keyword) and makes the change. A seeded sample of positions is drawn, with one change at each. The
draw depends on the text of the line, so that most of a sample stays when other code changes. A
mutant is tested in two stages: by the examples of its module and the test file of the same name,
then by every test outside tests/book that runs the changed line. The suite runs once with coverage
for that; a line that runs only on import is tested by the tests of its function or module. A mutant
survives if all pass. Changes of types or docstrings are not drawn.

Writes ``data/bench/mutants.csv``, a line a mutant. If a survivor is equivalent to the original
code, write the reason there by hand; later runs of the same mutant keep it. The result is the
fraction killed of the other mutants. With ``--minutes`` the run ends after that time, and the next
run continues. Each job works in a copy of the repository.
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
"""Time limit of each stage, in seconds; a mutant that takes longer counts as killed."""
EVERY = (
    "distfilt",
    "tests",
    *(f"--ignore=tests/{name}" for name in ("book", "tools")),
    "--ignore=tests/test_package.py",
)


@dataclass(frozen=True)
class Mutant:
    """One change at one position."""

    module: str
    operator: str
    occurrence: int
    line: int
    column: int

    def source(self, text: str) -> str:
        """Return the module's text with the change."""
        from cosmic_ray.mutating import mutate_code
        from cosmic_ray.plugins import get_operator

        return str(mutate_code(text, get_operator(self.operator)(), self.occurrence))


def mutants(root: Path, only: str) -> Iterator[Mutant]:
    """Yield every change that an operator without parameters can make to the library."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator, operator_names

    kinds = {name: get_operator(name) for name in sorted(operator_names())}
    # Operators with parameters need values that only a user can give.
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
            # cosmic-ray makes its k-th change of an operator in a module.
            for occurrence, (start, _) in enumerate(places):
                yield Mutant(module, name, occurrence, *start)


def meaning(text: str) -> str:
    """Return a module's syntax tree without types and docstrings, as text."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        # A mutant that changes types or texts only cannot be detected by a test.
        for name in ("annotation", "returns"):
            if hasattr(node, name):
                setattr(node, name, None)
        body = getattr(node, "body", None)
        first = body[0] if isinstance(body, list) and body else None
        if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
            first.value = ast.Constant("")
    return ast.dump(tree)


def keys(places: list[tuple[str, int, int]], root: Path, seed: int) -> dict[Any, str]:
    """Return a random number for each position, which depends on the text of its line only."""
    hashes = {}
    counts = Counter[str]()
    lines = dict[str, list[str]]()
    for module, line, column in sorted(places):
        if module not in lines:
            lines[module] = (root / module).read_text(encoding="utf-8").splitlines()
        text = f"{seed} {module} {lines[module][line - 1].strip()} {column}"
        # Equal lines of a module are told apart by a count.
        counts[text] += 1
        hashes[module, line, column] = sha256(
            f"{text} {counts[text]}".encode()
        ).hexdigest()
    return hashes


def draw_sample(root: Path, size: int, seed: int, only: str) -> list[Mutant]:
    """Draw positions and one change at each that changes the syntax tree."""
    places: dict[tuple[str, int, int], list[Mutant]] = {}
    for mutant in mutants(root, only):
        places.setdefault((mutant.module, mutant.line, mutant.column), []).append(
            mutant
        )
    numbers = keys(list(places), root, seed)
    sample: list[Mutant] = []
    # In the order of their random numbers: a larger sample contains the smaller one.
    for place in sorted(places, key=numbers.__getitem__):
        if len(sample) == size:
            break
        mutant = random.Random(numbers[place]).choice(places[place])
        text = (root / mutant.module).read_text(encoding="utf-8")
        try:
            if meaning(mutant.source(text)) != meaning(text):
                sample.append(mutant)
        except SyntaxError:
            continue
    return sample


def nearest(module: str, root: Path) -> list[str]:
    """Return the tests of the first stage: examples, the module's test file, validation."""
    parts = Path(module).with_suffix("").parts[1:]
    name = f"test_{parts[-1].lstrip('_')}.py"
    # distfilt/network/graphs.py has tests/network/test_graphs.py, or
    # tests/test_network.py.
    mirrors = [
        root.joinpath("tests", *parts[:-1], name),
        root / "tests" / f"test_{parts[0]}.py",
    ]
    options = [p for p in (root / "tests" / "test_validation.py",) if p.is_file()]
    names = [*[p for p in mirrors if p.is_file()][:1], *options]
    return [module, *(p.relative_to(root).as_posix() for p in names)]


def trace_tests(root: Path, jobs: int) -> Any:
    """Return which tests run which lines, from the stored trace of the suite or a new one."""
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
                # The context of a line is the test that runs it.
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
    """Return the tests that run a line's statement, else its function, else its module."""
    nodes = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.stmt)]
    spans = [(n.lineno, n.end_lineno or n.lineno) for n in nodes]
    # From the innermost statement outwards to the whole module
    enclosing = [(a, b) for a, b in spans if a <= line <= b]
    for first, last in (
        *sorted(enclosing, key=lambda s: s[1] - s[0]),
        (1, text.count("\n") + 1),
    ):
        tests = {c for n in range(first, last + 1) for c in contexts.get(n, ()) if c}
        if tests:
            # Without the parameters, whose names may come from the library.
            return sorted({c.rpartition("|")[0].partition("[")[0] for c in tests})
    return []


def passes(tests: list[str], folder: Path, seconds: float) -> bool:
    """Return whether the tests pass in a copy within the time limit."""
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
    # A session of its own, so that all its processes can be ended together.
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
        # A mutant may loop for ever: too long counts as detected.
        return child.wait(seconds) in (0, 5)  # 5: no test there
    except subprocess.TimeoutExpired:
        return False
    finally:
        with contextlib.suppress(ProcessLookupError):  # and workers that it left behind
            os.killpg(child.pid, signal.SIGKILL)
        child.wait()


def describe(mutant: Mutant, root: Path) -> dict[str, Any]:
    """Return the line of the table for a mutant that has not run."""
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


def run_mutant(
    mutant: Mutant, stages: list[list[str]], free: SimpleQueue[Path]
) -> dict[str, Any]:
    """Test one mutant in a free copy of the repository; return its result."""
    # Each job waits for a copy that no other job uses.
    folder = free.get()
    path = folder / mutant.module
    text = path.read_text(encoding="utf-8")
    result: dict[str, Any] = {"result": "survived"}
    started = time.perf_counter()
    path.write_text(mutant.source(text), encoding="utf-8")
    try:
        for stage, names in enumerate(stages, start=1):
            result["stage"] = stage
            # The second stage runs only if the first one finds nothing.
            if names and not passes(names, folder, SECONDS[stage - 1]):
                result["result"] = "killed"
                break
    finally:
        # The copy serves the next mutant.
        path.write_text(text, encoding="utf-8")
        free.put(folder)
    return result | {"seconds": f"{time.perf_counter() - started:.0f}"}


def stages(mutant: Mutant, root: Path, trace: Any) -> list[list[str]]:
    """Return the tests of both stages."""
    path = root / mutant.module
    # Which tests run which line of the module
    lines = trace.contexts_by_lineno(str(path))
    text = path.read_text(encoding="utf-8")
    return [nearest(mutant.module, root), running(lines, text, mutant.line)]


def run(
    rows: list[tuple[Mutant, dict[str, Any]]], root: Path, jobs: int
) -> Iterator[None]:
    """Run mutants and complete their rows, each job in a copy; yield after each one."""
    trace = trace_tests(root, jobs)
    left_out = shutil.ignore_patterns(
        ".git", ".venv", "_build", "__pycache__", ".*_cache"
    )
    free: SimpleQueue[Path] = SimpleQueue()
    with (
        tempfile.TemporaryDirectory(prefix="mutants-") as scratch,
        ThreadPoolExecutor(jobs) as pool,
    ):
        for k in range(jobs):
            # A copy for each job: a mutant changes the source that its tests import.
            free.put(shutil.copytree(root, Path(scratch) / str(k), ignore=left_out))
        waiting = {
            pool.submit(run_mutant, m, stages(m, root, trace), free): row
            for m, row in rows
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


def read_table(table: Path) -> dict[tuple[str, str, str], dict[str, Any]]:
    """Return the lines of an earlier run, by module and change."""
    if not table.is_file():
        return {}
    rows = pandas.read_csv(table, dtype=str, keep_default_na=False).to_dict("records")
    return {(r["module"], r["was"], r["becomes"]): r for r in rows}


def write_table(rows: list[dict[str, Any]], table: Path) -> None:
    """Write the table in one step, so that an interrupted run leaves a complete one."""
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
        description="Count random mutations that the tests detect."
    )
    parser.add_argument("--sample", type=int, default=300, help="number of positions")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", default="", help="a folder or module of the library")
    parser.add_argument(
        "--minutes", type=float, default=1e6, help="when to stop for now"
    )
    options = parser.parse_args(arguments)
    earlier = read_table(table)
    chosen = draw_sample(root, options.sample, options.seed, options.only)
    pairs = []
    for mutant in chosen:
        row = describe(mutant, root)
        # A mutant that ran before keeps its result and the reason written by hand.
        old = earlier.get((row["module"], row["was"], row["becomes"]), {})
        pairs.append((mutant, row | {n: old[n] for n in COLUMNS[4:] if n in old}))
    waiting = [(m, row) for m, row in pairs if not row["result"]]
    rows = [row for _, row in pairs]
    end = time.monotonic() + 60 * options.minutes
    # The table is complete at any time, so that a run may be interrupted.
    write_table(rows, table)
    for _ in run(waiting, root, options.jobs) if waiting else ():
        write_table(rows, table)
        if time.monotonic() > end:
            break
    ran = [row for row in rows if row["result"]]
    killed = sum(row["result"] == "killed" for row in ran)
    equivalent = sum(row["result"] == "survived" and bool(row["reason"]) for row in ran)
    # An equivalent mutant behaves as the original, so that no test can detect it.
    share = killed / max(len(ran) - equivalent, 1)
    print(
        f"{killed} of {len(ran)} killed, {equivalent} equivalent: {share:.1%} of the other mutants"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
