"""The package as a whole: its layers, its public names, its version and its wheel."""

from __future__ import annotations

import ast
import importlib
import os
import runpy
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

import distfilt
from tests.tools.reach import code_of_pages, unused_names

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "distfilt"
PATHS = sorted(PACKAGE.rglob("*.py"))
TREES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in PATHS}

# A module imports only from layers below its own, or from its own subpackage.
LAYERS = (
    ("validation",),
    ("derivatives", "periods"),
    ("linalg",),
    ("ensembles", "gaussians"),
    ("models",),
    ("network", "sensors", "metrics"),
    ("mixtures", "density", "kalman", "triangular", "coupling"),
    ("updates",),
    ("filters",),
    ("",),
)
LAYER_OF = {name: k for k, layer in enumerate(LAYERS) for name in layer}
# Each heavy package may be imported in one subpackage only.
HEAVY = {
    "cvxpy": "triangular",
    "ot": "coupling",
    "filterpy": "kalman",
    "networkx": "network",
    "xarray": "filters",
}
# Packages of the book's tools, which the library must not import.
BOOK = ("bookkit", "matplotlib", "loky", "cloudpickle", "threadpoolctl", "pandas")
LONGEST_FUNCTION = 60
"""Lines of a formatted function, its docstring not counted: a function fits on a screen."""


def module_name(path: Path) -> str:
    """Return a module's name below the package: ``network.channel``, '' for the package itself."""
    name = path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", ".")
    return name.removesuffix("__init__").rstrip(".")


def first_part(name: str) -> str:
    """Return the first part of a dotted name: the subpackage or top-level module."""
    return name.split(".")[0]


def imports(path: Path) -> set[str]:
    """Return the full names that a module imports, at its top or inside functions."""
    names = set()
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                # A relative import: go up `level` folders from the module's own path.
                package = path.relative_to(ROOT).with_suffix("").parts[: -node.level]
                base = ".".join([*package, base]).rstrip(".")
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def library_imports(path: Path) -> set[str]:
    """Return the names of the library that a module imports, without ``distfilt.``."""
    names = imports(path)
    return {n.removeprefix("distfilt.") for n in names if n.startswith("distfilt.")}


def functions(folder: Path) -> Iterator[tuple[Path, ast.FunctionDef]]:
    """Yield every function below a folder with its file."""
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                yield path, node


def line_count(node: ast.FunctionDef) -> int:
    """Count a function's lines from its name to its end, without the docstring."""
    lines = (node.end_lineno or node.lineno) - node.lineno + 1
    if ast.get_docstring(node):
        docstring = node.body[0]
        lines -= (docstring.end_lineno or 0) - docstring.lineno + 1
    return lines


def test_modules_import_only_from_layers_below() -> None:
    for path in PATHS:
        importer = first_part(module_name(path))
        assert importer in LAYER_OF, f"{importer} has no layer: add it to LAYERS"
        imported = {first_part(name) for name in library_imports(path)}
        for other in imported - {importer, "__version__"}:
            below = LAYER_OF[other] < LAYER_OF[importer]
            assert below, f"{importer} imports {other}, which is not in a layer below"


def test_library_does_not_depend_on_the_book() -> None:
    for path in PATHS:
        imported = {first_part(name) for name in imports(path)}
        assert imported.isdisjoint(BOOK), f"{path} imports a package of the book"


def test_heavy_packages_are_imported_in_one_subpackage_only() -> None:
    for path in PATHS:
        importer = first_part(module_name(path))
        for package in {first_part(name) for name in imports(path)} & set(HEAVY):
            allowed = HEAVY[package]
            assert importer == allowed, f"{importer} imports {package}, not {allowed}"


def test_no_subpackage_imports_private_names_of_another() -> None:
    for path in PATHS:
        importer = first_part(module_name(path))
        for name in library_imports(path) - {"__version__"}:
            parts = name.split(".")
            private = any(part.startswith("_") for part in parts)
            assert parts[0] == importer or not private, f"{path}: {name} is private"


def test_modules_and_public_names_have_docstrings() -> None:
    for path in PATHS:
        name = f"distfilt.{module_name(path)}".rstrip(".")
        module = importlib.import_module(name)
        assert module.__doc__, f"{name} has no docstring"
        for public in module.__all__:
            value = getattr(module, public)
            home = getattr(value, "__module__", "")
            if callable(value) and home.startswith("distfilt"):
                assert value.__doc__, f"{name}.{public} has no docstring"


@pytest.mark.parametrize("folder", ["distfilt", "book/kit", "book/tools"])
def test_functions_fit_on_a_screen(folder: str) -> None:
    for path, node in functions(ROOT / folder):
        lines = line_count(node)
        fits = lines <= LONGEST_FUNCTION
        assert fits, f"{path.name}: {node.name} has {lines} lines: split it"


def test_names_that_the_book_never_uses_are_found() -> None:
    """The warning of ``make style``: no code uses nothing, code with every name uses all."""
    names = unused_names("")
    assert "filters.EnsembleFilter" in names
    assert unused_names(" ".join(names)) == []
    assert "filters.EnsembleFilter" not in unused_names(code_of_pages())


def test_dir_lists_subpackages_and_their_public_names() -> None:
    """``dir`` and completion offer each subpackage and its exports, and no helper module."""
    listed = {name for name in dir(distfilt) if not name.startswith("__")}
    existing = {first_part(module_name(path)) for path in PATHS} - {""}
    folders = {path.parent.name for path in PATHS if path.parent.parent == PACKAGE}
    assert folders - {"validation"} <= listed <= existing
    for name in listed:
        package = getattr(distfilt, name)
        assert set(package.__all__) <= set(dir(package)), name


def run(code: str, path: Path | None = None) -> str:
    """Run code in a fresh interpreter, outside the repository; return its standard output.

    It imports the library of this repository, or of `path`, and nothing of the folder it runs in.
    """
    result = subprocess.run(
        [sys.executable, "-P", "-W", "error", "-c", code],
        cwd=path or ROOT.parent,
        env={**os.environ, "PYTHONPATH": str(path or ROOT)},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_import_loads_no_heavy_package() -> None:
    heavy = [*HEAVY, *BOOK, "ecos", "scipy.stats", "tqdm"]
    modules = [f"distfilt.{module_name(path)}".rstrip(".") for path in PATHS]
    for names in (["distfilt"], modules):
        statement = f"import sys, {', '.join(names)}"
        loaded = f"[name for name in {heavy} if name in sys.modules]"
        assert run(f"{statement}; print({loaded})").strip() == "[]"


def test_lock_names_no_registry_and_has_a_hash_for_every_file() -> None:
    text = (ROOT / "requirements.txt").read_text(encoding="utf-8").replace("\\\n", "")
    assert "//" not in text
    assert "--index" not in text
    pins = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert pins
    assert all("==" in pin and "--hash=sha256:" in pin for pin in pins)


def test_version_stands_in_one_place_and_is_the_one_to_cite() -> None:
    """Both packages take it from ``distfilt/__init__.py``; citation and changelog agree."""
    for name in ("pyproject.toml", "book/kit/pyproject.toml"):
        settings = tomllib.loads((ROOT / name).read_text(encoding="utf-8"))
        assert settings["project"]["dynamic"] == ["version"]
        source = (ROOT / name).parent / settings["tool"]["hatch"]["version"]["path"]
        assert source.resolve() == PACKAGE / "__init__.py"
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == distfilt.__version__
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"## [{distfilt.__version__}] - {citation['date-released']}" in changes


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel without a network and unpack it; return the folder."""
    folder = tmp_path_factory.mktemp("wheel")
    options = ["--quiet", "--no-index", "--no-deps", "--no-build-isolation"]
    command = [sys.executable, "-m", "pip", "wheel", *options]
    command += ["--wheel-dir", str(folder), str(ROOT)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    (built,) = folder.glob(f"distfilt-{distfilt.__version__}-*.whl")
    target = folder / "installed"
    with zipfile.ZipFile(built) as archive:
        archive.extractall(target)
    return target


def test_wheel_holds_the_library_and_nothing_else(wheel: Path) -> None:
    top = sorted(path.name.partition("-")[0] for path in wheel.iterdir())
    assert top == ["distfilt", "distfilt"]  # the package and its metadata
    packed = [p for p in (wheel / "distfilt").rglob("*") if p.is_file()]
    names = sorted(path.relative_to(wheel / "distfilt") for path in packed)
    sources = [*PATHS, PACKAGE / "py.typed"]
    assert names == sorted(path.relative_to(PACKAGE) for path in sources)


def test_installed_library_runs_alone(wheel: Path) -> None:
    code = "import distfilt; from distfilt import filters; print(distfilt.__file__)"
    assert Path(run(code, wheel).strip()).is_relative_to(wheel)


def test_readme_runs_with_the_installed_library(wheel: Path) -> None:
    script = str(ROOT / "tests" / "tools" / "readme.py")
    code = f"import runpy; runpy.run_path({script!r}, run_name='__main__')"
    # `make dist` must not try the repository's library by mistake.
    with pytest.raises(SystemExit, match="the installed library is needed"):
        runpy.run_path(script, run_name="__main__")
    assert f"README.md runs: distfilt {distfilt.__version__}" in run(code, wheel)
