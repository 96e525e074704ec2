"""The package as a whole: its floors, its size, its public names, and the wheel that it makes."""

from __future__ import annotations

import ast
import importlib
import os
import re
import subprocess
import sys
import tokenize
import zipfile
from pathlib import Path

import pytest

import distfilt
from tests.tools.calls import public, rooms

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "distfilt"
PATHS = sorted(PACKAGE.rglob("*.py"))
TREES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in PATHS}

# Who may import whom: a module imports from floors below its own, or within its own folder.
LEVELS = (
    ("validation",),
    ("linalg",),
    ("ensembles", "gaussians"),
    ("models",),
    ("network", "sensors", "metrics"),
    ("mixtures", "density", "kalman", "triangular", "coupling"),
    ("updates",),
    ("filters",),
    ("",),
)
FLOORS = {room: floor for floor, level in enumerate(LEVELS) for room in level}
# A heavy package has a home.
HOMES = {
    "cvxpy": {"triangular"},
    "ot": {"coupling"},
    "filterpy": {"kalman"},
    "networkx": {"network"},
    "xarray": {"filters"},
}
# What only the book's tools need: the library knows nothing of them.
BOOK = ("bookkit", "matplotlib", "loky", "cloudpickle", "threadpoolctl", "pandas")


def dotted(path: Path) -> str:
    """Return a module's name below the package: ``network.channel``, '' for the package itself."""
    name = path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", ".")
    return name.removesuffix("__init__").rstrip(".")


def part(name: str) -> str:
    """Return the folder or the single module that a dotted name belongs to."""
    return name.split(".")[0]


def imports(path: Path) -> set[str]:
    """Return the full names of what a module imports, at its top or inside."""
    out = set()
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.Import):
            out |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                here = path.relative_to(ROOT).with_suffix("").parts[: -node.level]
                base = ".".join([*here, *filter(None, [node.module])])
            out |= {f"{base}.{alias.name}" for alias in node.names}
    return out


def test_modules_import_only_from_floors_below() -> None:
    for path in PATHS:
        here = part(dotted(path))
        names = [
            n.removeprefix("distfilt.")
            for n in imports(path)
            if n.startswith("distfilt.")
        ]
        wanted = {part(name) for name in names} - {"__version__"}
        assert here in FLOORS, f"{here} has no floor: add it to FLOORS"
        for other in wanted - {here}:
            assert FLOORS[other] < FLOORS[here], (
                f"{here} imports {other}, which is not below it"
            )


def test_the_library_knows_nothing_of_the_book() -> None:
    for path in PATHS:
        text = path.read_text(encoding="utf-8")
        assert [name for name in BOOK if name in text] == []


def test_heavy_packages_stay_at_home() -> None:
    for path in PATHS:
        here = part(dotted(path))
        for package in {part(name) for name in imports(path)} & set(HOMES):
            home = HOMES[package]
            assert here in home, (
                f"{here} imports {package}, whose home is {sorted(home)}"
            )


def test_modules_are_short_and_say_what_is_public() -> None:
    for path in PATHS:
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= MODULE, f"{path.name} is too long"
        name = f"distfilt.{dotted(path)}".rstrip(".")
        module = importlib.import_module(name)
        assert module.__doc__, f"{name}: a module starts with what it is for"
        for shown in module.__all__:
            value = getattr(module, shown)
            if callable(value) and getattr(value, "__module__", "").startswith(
                "distfilt"
            ):
                assert value.__doc__, f"{shown} has no docstring"


DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef


def spanned(node: ast.stmt) -> range:
    """Return the numbers of a statement's lines, its decorators' included."""
    first = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", ()))])
    return range(first, (node.end_lineno or first) + 1)


def test_functions_fit_a_screen() -> None:
    for path in PATHS:
        for node in ast.walk(TREES[path]):
            if isinstance(node, ast.FunctionDef):
                told = len(spanned(node.body[0])) if ast.get_docstring(node) else 0
                assert len(spanned(node)) - told <= 40, (
                    f"{path.name}: {node.name} is too long"
                )


IDLE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


def code_lines(path: Path) -> int:
    """Count the lines that hold code: no docstring, no comment, no blank line."""
    found: set[int] = set()
    with path.open("rb") as lines:
        for token in list(tokenize.tokenize(lines.readline))[1:]:
            if token.type not in IDLE:
                found |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(TREES[path]):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node):
            found -= set(spanned(node.body[0]))
    return len(found)


MODULE = 400
LIMITS = {
    "lines": 8000,
    "files": 90,
    "rooms": 16,
    "names": 260,
    "unreached": 0,
    "private": 0,
}


def private_imports() -> list[str]:
    """Names with an underscore that a room takes from another one."""
    found = []
    for path in PATHS:
        here = part(dotted(path))
        for name in imports(path):
            inside = name.removeprefix("distfilt.").split(".")
            other = name.startswith("distfilt.") and inside[0] != here
            if other and any(p.startswith("_") and p != "__version__" for p in inside):
                found.append(f"{dotted(path)}: {name}")
    return found


def unreached() -> list[str]:
    """Public names that no code of a page, study or example says, and that nothing returns."""
    book = ROOT / "book"
    pages = "\n".join(page.read_text(encoding="utf-8") for page in book.glob("*.md"))
    block = re.compile(r"^(`{3,}).*?^\1", re.S | re.M)
    code = [found[0] for found in block.finditer(pages)]
    code += re.findall(r"`[^`]+`", block.sub("", pages))
    for folder in ("studies", "examples"):
        code += [
            path.read_text(encoding="utf-8") for path in (book / folder).glob("*.py")
        ]
    for path in PATHS:
        code += re.findall(r"-> .*?:\n", path.read_text(encoding="utf-8"), re.S)
    known = set(re.findall(r"\w+", " ".join(code)))
    names = {
        name
        for room in rooms()
        for name, thing in public(room).items()
        if callable(thing)
    }
    return sorted(name for name in names if name.rpartition(".")[2] not in known)


def test_the_library_stays_small() -> None:
    found = {
        "lines": sum(code_lines(path) for path in PATHS),
        "files": len(PATHS),
        "rooms": len({part(dotted(path)) for path in PATHS} - {""}),
        "names": sum(len(public(room)) for room in rooms()),
        "unreached": len(unreached()),
        "private": len(private_imports()),
    }
    over = {what: n for what, n in found.items() if n > LIMITS[what]}
    assert not over, f"{over} above {LIMITS}\n{unreached()}\n{private_imports()}"


def test_every_room_is_seen_and_shows_what_it_exports() -> None:
    """`dir` and completion find each room, and in it what a reader calls; helpers stay inside."""
    seen = {name for name in dir(distfilt) if not name.startswith("__")}
    inside = {part(dotted(path)) for path in PATHS} - {""}
    folders = {path.parent.name for path in PATHS if path.parent.parent == PACKAGE}
    assert folders - {"validation"} <= seen <= inside
    faces = [getattr(distfilt, room) for room in seen]
    assert [face for face in faces if not set(face.__all__) <= set(dir(face))] == []


def run(code: str, path: Path | None = None) -> str:
    """Run code in a fresh interpreter, away from the repository; return what it prints."""
    env = {**os.environ, "PYTHONPATH": str(path or "")}
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(
        command, cwd=path or ROOT.parent, env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_import_loads_no_heavy_package() -> None:
    heavy = [*HOMES, *BOOK, "ecos", "scipy.stats", "tqdm"]
    modules = [f"distfilt.{dotted(path)}".rstrip(".") for path in PATHS]
    for names in (["distfilt"], modules):
        code = f"import sys, {', '.join(names)}; print([h for h in {heavy} if h in sys.modules])"
        assert run(code).strip() == "[]"


def test_lock_names_no_registry_and_has_a_hash_for_every_file() -> None:
    text = (ROOT / "requirements.txt").read_text(encoding="utf-8").replace("\\\n", "")
    assert "//" not in text and "--index" not in text
    pins = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert pins and all("==" in pin and "--hash=sha256:" in pin for pin in pins)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel without a network and unpack it; return the folder."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-index",
        "--no-deps",
    ]
    command += ["--no-build-isolation", "--wheel-dir", str(folder), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (built,) = folder.glob("distfilt-*.whl")
    target = folder / "installed"
    with zipfile.ZipFile(built) as archive:
        archive.extractall(target)
    return target


def test_wheel_holds_the_library_and_nothing_else_in_one_version(wheel: Path) -> None:
    told = ("pyproject.toml", "book/kit/pyproject.toml", "CITATION.cff", "CHANGELOG.md")
    assert all(
        distfilt.__version__ in (ROOT / name).read_text("utf-8") for name in told
    )
    assert sorted(p.name.partition("-")[0] for p in wheel.iterdir()) == [
        "distfilt",
        "distfilt",
    ]
    files = (p for p in (wheel / "distfilt").rglob("*") if p.is_file())
    found = sorted(p.relative_to(wheel / "distfilt") for p in files)
    assert found == sorted(
        p.relative_to(PACKAGE) for p in [*PATHS, PACKAGE / "py.typed"]
    )


def test_installed_library_runs_alone(wheel: Path) -> None:
    code = "import distfilt; from distfilt import filters; print(distfilt.__file__)"
    assert Path(run(code, wheel).strip()).is_relative_to(wheel)
