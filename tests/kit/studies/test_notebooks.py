"""Studies in notebooks, scripts and pipes: nothing is written that nobody asked for."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.random import SeedSequence

from bookkit import studies

CELLS = [
    """
    from dataclasses import dataclass
    import numpy as np
    from bookkit import studies
    scale = 3
    """,
    """
    @dataclass(frozen=True)
    class Score:
        rmse: float

    def inner(rng):
        return scale * rng.normal()

    def trial(seed):
        return Score(inner(np.random.default_rng(seed)))
    """,
    """
    study = studies.run(trial, studies.spawn(1, 40), workers=2)
    alone = studies.run(trial, studies.spawn(1, 40), workers=1)
    assert study.values == alone.values and len(set(study.values)) == 40
    assert all(type(v) is Score for v in study.values)
    assert set(study.code) == {"trial"}
    study
    """,
]


def _notebook() -> Any:
    import nbformat
    from nbformat.v4 import new_code_cell, new_notebook

    notebook = new_notebook(cells=[new_code_cell(textwrap.dedent(c).strip()) for c in CELLS])
    notebook.metadata["kernelspec"] = {
        "name": "python3", "display_name": "Python 3", "language": "python",
    }
    nbformat.validate(notebook)
    return notebook


@pytest.fixture(scope="module")
def executed() -> Any:
    from nbclient import NotebookClient

    notebook = _notebook()
    NotebookClient(notebook, timeout=60, kernel_name="python3").execute()
    return notebook


def test_functions_and_classes_of_a_notebook_run_in_silence(executed: Any) -> None:
    outputs = [output for cell in executed.cells for output in cell.outputs]
    assert [output.output_type for output in outputs] == ["execute_result"]
    assert outputs[0]["data"]["text/plain"] == "Study(40 trials: 40 done, 0 failed, 0 not run)"


@pytest.mark.slow
def test_nbval_sees_nothing_but_the_result(executed: Any, tmp_path: Path) -> None:
    import nbformat

    path = tmp_path / "study.ipynb"
    nbformat.write(executed, path)
    environment = {k: v for k, v in os.environ.items() if k not in ("CI", "TQDM_DISABLE")}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--nbval"]
    done = subprocess.run(
        [*command, "--rootdir", str(tmp_path), str(path)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "3 passed" in done.stdout, done.stdout + done.stderr


def test_a_script_is_silent_in_a_pipe(tmp_path: Path) -> None:
    """A bar is asked for, and nobody watches; the functions are ``__main__``'s, without a guard."""
    script = tmp_path / "script.py"
    script.write_text(
        textwrap.dedent("""
        from dataclasses import dataclass
        from bookkit import studies

        @dataclass
        class Score:
            rmse: int

        study = studies.run(lambda seed: Score(seed.spawn_key[0]), studies.spawn(1, 20), workers=2)
        assert study.values == tuple(Score(i) for i in range(20))
        """),
        encoding="utf-8",
    )
    names = ("CI", "TQDM_DISABLE", "PYTEST_CURRENT_TEST")
    environment = {k: v for k, v in os.environ.items() if k not in names}
    done = subprocess.run(
        [sys.executable, "-W", "error", str(script)],
        env=environment, capture_output=True, text=True,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.slow
def test_a_worker_whose_memory_grows_is_replaced_without_a_word() -> None:
    import warnings

    def hoard(seed: SeedSequence) -> int:
        sys.__dict__.setdefault("hoard", []).append(np.ones(2**23))
        time.sleep(0.3)
        return int(seed.spawn_key[0])

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        study = studies.run(hoard, studies.spawn(1, 60), workers=2, chunk=1)
    assert list(study.values) == list(range(60))
