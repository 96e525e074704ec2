"""How many random faults in the library do its tests find?

    python tests/tools/mutants.py [--sample 300] [--seed 1] [--jobs 2] [--only network]

cosmic-ray lists the places where the library's code can be changed (an operator, a comparison, a
number, a keyword) and makes the change; a seeded sample of places is drawn, and one change at each.
A mutant is tested in stages, the nearest tests first: the file that mirrors the module with its own
examples, then the module's folder of tests, then all tests but those of the book. It survives if
all pass. A change of a type or a text only is no fault and is not drawn.

Writes ``data/bench/mutants.csv``, a line a mutant. A survivor that is equivalent to the original
gets a reason there by hand, which a later run of the same mutant keeps; the share of the others is
the result. Each job works in a copy of the repository.
"""

from __future__ import annotations

import argparse
import ast
import csv
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "data" / "bench" / "mutants.csv"
COLUMNS = ("module", "line", "was", "becomes", "result", "stage", "seconds", "reason")
SECONDS = (120, 600, 3000)
"""What the tests of each stage may take; a mutant that takes longer hangs, and so is found."""


@dataclass(frozen=True)
class Mutant:
    """One change at one place."""

    module: str
    operator: str
    arguments: tuple[tuple[str, Any], ...]
    occurrence: int
    line: int
    column: int

    def source(self, text: str) -> str:
        """The module's text with the change."""
        from cosmic_ray.mutating import mutate_code
        from cosmic_ray.plugins import get_operator

        operator = get_operator(self.operator)(**dict(self.arguments))
        return str(mutate_code(text, operator, self.occurrence))


def operators() -> Iterator[tuple[str, tuple[tuple[str, Any], ...], Any]]:
    """Name, arguments and instance of every operator of cosmic-ray that needs no set-up."""
    from cosmic_ray.plugins import get_operator, operator_names

    for name in sorted(operator_names()):
        kind = get_operator(name)
        if not kind.arguments() and "no-op" not in name.lower():
            yield name, (), kind()


def mutants(root: Path, only: str) -> Iterator[Mutant]:
    """Every change that can be made to the library's modules."""
    from cosmic_ray.ast import ast_nodes, get_ast

    known = list(operators())
    for path in sorted((root / "distfilt").rglob("*.py")):
        module = path.relative_to(root).as_posix()
        if path.name == "__init__.py" or not module.startswith(f"distfilt/{only}"):
            continue
        nodes = list(ast_nodes(get_ast(path.read_text(encoding="utf-8"))))
        for name, arguments, operator in known:
            places = (place for node in nodes for place in operator.mutation_positions(node))
            for occurrence, (start, _) in enumerate(places):
                yield Mutant(module, name, arguments, occurrence, *start)


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
        if isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(None)
    return ast.dump(tree)


def drawn(root: Path, size: int, seed: int, only: str) -> list[Mutant]:
    """A sample of places, and one change at each, that is a change of what the code does."""
    rng = random.Random(seed)
    places: dict[tuple[str, int, int], list[Mutant]] = {}
    for mutant in mutants(root, only):
        places.setdefault((mutant.module, mutant.line, mutant.column), []).append(mutant)
    order = sorted(places)
    rng.shuffle(order)
    out: list[Mutant] = []
    for place in order:
        if len(out) == size:
            break
        mutant = rng.choice(places[place])
        text = (root / mutant.module).read_text(encoding="utf-8")
        try:
            if meaning(mutant.source(text)) != meaning(text):
                out.append(mutant)
        except SyntaxError:
            continue
    return out


def stages(module: str, root: Path) -> list[list[str]]:
    """The tests to run for a module, nearest first."""
    parts = Path(module).with_suffix("").parts[1:]
    name = f"test_{parts[-1].lstrip('_')}.py"
    mirror = root.joinpath("tests", *parts[:-1], name)
    near = [module, *([mirror.relative_to(root).as_posix()] if mirror.is_file() else [])]
    out = [near]
    folder = root / "tests" / parts[0]
    if len(parts) > 1 and folder.is_dir():
        out.append([folder.relative_to(root).as_posix()])
    left_out = ("book", "tools", "test_package.py")
    return [*out, ["tests", *(f"--ignore=tests/{name}" for name in left_out)]]


def passes(tests: list[str], folder: Path, seconds: int) -> bool:
    """Whether the tests pass in a copy, in time."""
    command = [sys.executable, "-B", "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *tests]
    environment = {
        **os.environ,
        "PYTHONPATH": str(folder),
        "HYPOTHESIS_PROFILE": "gate",
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
    }
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, timeout=seconds, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return False
    return done.returncode in (0, 5)  # 5: no test there


def tested(mutant: Mutant, folder: Path) -> dict[str, Any]:
    """The line of the table for one mutant, from the copy in that folder."""
    path = folder / mutant.module
    text = path.read_text(encoding="utf-8")
    changed = mutant.source(text)
    pairs = zip(text.splitlines(), changed.splitlines(), strict=False)
    was, becomes = next((a.strip(), b.strip()) for a, b in pairs if a != b)
    row: dict[str, Any] = {"module": mutant.module, "line": mutant.line, "was": was}
    row |= {"becomes": becomes, "result": "survived", "stage": "", "reason": ""}
    began = time.perf_counter()
    path.write_text(changed, encoding="utf-8")
    try:
        tests = stages(mutant.module, folder)
        for stage, names in enumerate(tests, start=1):
            if not passes(names, folder, SECONDS[min(stage, len(SECONDS)) - 1]):
                row |= {"result": "killed", "stage": stage}
                break
    finally:
        path.write_text(text, encoding="utf-8")
    return row | {"seconds": f"{time.perf_counter() - began:.0f}"}


def copied(root: Path, folder: Path) -> Path:
    """A copy of what the tests need."""
    left_out = shutil.ignore_patterns(".git", ".venv", "_build", "__pycache__", ".*_cache")
    shutil.copytree(root, folder, ignore=left_out)
    return folder


def run(chosen: list[Mutant], root: Path, jobs: int) -> list[dict[str, Any]]:
    """Every mutant's line, in the sample's order."""
    with tempfile.TemporaryDirectory(prefix="mutants-") as scratch:
        free: Queue[Path] = Queue()
        for k in range(jobs):
            free.put(copied(root, Path(scratch) / str(k)))

        def one(mutant: Mutant) -> dict[str, Any]:
            folder = free.get()
            try:
                row = tested(mutant, folder)
            finally:
                free.put(folder)
            print(f"{row['result']:8} {row['module']}:{row['line']}: {row['becomes']}", flush=True)
            return row

        with ThreadPoolExecutor(jobs) as pool:
            return list(pool.map(one, chosen))


def reasons(table: Path) -> dict[tuple[str, str, str], str]:
    """The reasons that were given by hand, by module and change."""
    if not table.is_file():
        return {}
    with table.open(encoding="utf-8", newline="") as lines:
        return {(r["module"], r["was"], r["becomes"]): r["reason"] for r in csv.DictReader(lines)}


def main(arguments: list[str] | None = None, root: Path = ROOT, table: Path = TABLE) -> int:
    parser = argparse.ArgumentParser(description="Random faults, and whether the tests find them.")
    parser.add_argument("--sample", type=int, default=300, help="how many places")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", default="", help="a folder or module of the library")
    options = parser.parse_args(arguments)
    chosen = drawn(root, options.sample, options.seed, options.only)
    kept = reasons(table)
    rows = run(chosen, root, options.jobs)
    for row in rows:
        row["reason"] = kept.get((row["module"], row["was"], row["becomes"]), "")
    table.parent.mkdir(parents=True, exist_ok=True)
    with table.open("w", encoding="utf-8", newline="") as lines:
        writer = csv.DictWriter(lines, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    killed = sum(row["result"] == "killed" for row in rows)
    equivalent = sum(row["result"] == "survived" and bool(row["reason"]) for row in rows)
    share = killed / max(len(rows) - equivalent, 1)
    print(f"{killed} of {len(rows)} killed, {equivalent} equivalent: {share:.1%} of the others")
    return 0


if __name__ == "__main__":
    sys.exit(main())
