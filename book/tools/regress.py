"""Run chapters again and compare every stored output with nbval, strictly.

    python book/tools/regress.py [CHAPTER ...] [--portable] [--jobs N]

``--portable`` runs them with another BLAS kernel and without numpy's newer SIMD code. A probe
notebook runs by the same command first, and fails if the setting has no effect.
"""

from __future__ import annotations

import startup  # noqa: F401

# isort: split
import argparse
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import nbformat

from common import ROOT, chosen, end_with_children, fixed_environment

PROBE_BLAS = """\
import numpy, scipy.linalg, threadpoolctl
found = [b for b in threadpoolctl.threadpool_info() if b["user_api"] == "blas"]
assert found, "no BLAS was found"
for blas in found:
    assert blas["internal_api"] == "openblas", blas
    assert blas["architecture"] == "Nehalem", blas
    assert blas["num_threads"] == 1, blas
"""
PROBE_SIMD = """\
from numpy._core._multiarray_umath import __cpu_features__ as features
assert features["X86_V3"] is False, "X86_V3 is still on"
"""
SETTINGS = {
    "blas": ({"OPENBLAS_CORETYPE": "Nehalem"}, PROBE_BLAS),
    "simd": (
        {"NPY_DISABLE_CPU_FEATURES": "X86_V4 X86_V3 AVX512_ICL AVX512_SPR"},
        PROBE_SIMD,
    ),
}


def compare(notebook: Path, extra: dict[str, str]) -> int:
    """Run one notebook against its stored outputs; return pytest's exit code."""
    started = time.perf_counter()
    # -m "" runs tests of every mark, also those that the settings leave out.
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", ""]
    command += [
        "-p",
        "book.tools.startup",
        "-p",
        # The first plugin makes nbformat's import fast.
        "nbval.plugin",
        "--nbval",
        "--nbval-current-env",
    ]
    command += ["--nbval-cell-timeout=900", str(notebook)]
    result = subprocess.run(
        command,
        cwd=ROOT,
        env=fixed_environment() | extra,
        capture_output=True,
        text=True,
    )
    if result.returncode:
        print(result.stdout, result.stderr, sep="\n", file=sys.stderr)
    state = "differs" if result.returncode else "as stored"
    print(
        f"{notebook.stem}: {state}, {time.perf_counter() - started:.1f} s", flush=True
    )
    return result.returncode


def probe(name: str, code: str) -> Path:
    """Write a notebook of one cell that fails if the setting has no effect."""
    target = ROOT / "_build" / "portable" / f"probe-{name}.ipynb"
    target.parent.mkdir(parents=True, exist_ok=True)
    cell = nbformat.v4.new_code_cell(code, execution_count=1, id="probe-000")
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), target)
    return target


def main() -> int:
    parser = argparse.ArgumentParser(
        description="Compare chapters with their stored outputs."
    )
    parser.add_argument("chapters", nargs="*", help="names or numbers; all without one")
    parser.add_argument(
        "--portable", action="store_true", help="other BLAS kernel, less SIMD"
    )
    parser.add_argument("--jobs", type=int, default=2, help="chapters at a time")
    options = parser.parse_args()
    end_with_children()
    notebooks = [source.with_suffix(".ipynb") for source in chosen(options.chapters)]
    # The largest first, so that no core idles at the end.
    notebooks.sort(key=lambda notebook: -notebook.stat().st_size)
    if not notebooks:
        print("the table of contents has no chapter", file=sys.stderr)
        return 1
    # Without --portable there is one setting: this machine's own.
    codes = []
    for name, (extra, code) in (
        SETTINGS.items() if options.portable else [("", ({}, ""))]
    ):
        if name:
            print(f"under {extra}", flush=True)
            # The probe shows that the setting reaches the kernels.
            codes.append(compare(probe(name, code), extra))
        with ThreadPoolExecutor(max_workers=options.jobs) as pool:
            codes += pool.map(compare, notebooks, [extra] * len(notebooks))
    return int(any(codes))


if __name__ == "__main__":
    sys.exit(main())
