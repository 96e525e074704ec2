"""The reader's example on the API page: short, and it runs."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np

EXAMPLE = Path(__file__).parents[1] / "book" / "examples" / "own_filter.py"


def test_the_example_is_short_and_finds_the_spill() -> None:
    code = [line for line in EXAMPLE.read_text(encoding="utf-8").splitlines() if line.strip()]
    assert len(code) <= 30
    names = runpy.run_path(str(EXAMPLE))
    run, truth = names["run"], names["truth"]
    late = run["squared_error"].values[-20:].mean()
    lost = ((truth[-20:] - np.array([0.5, 0.5])) ** 2).sum(axis=-1).mean()
    assert late < 0.05 * lost
    assert run["scalars"].values[-1].sum() > 0
