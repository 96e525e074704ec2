"""Chapter 11: every filter on each of the four problems of data/scenarios/together, 200 runs.

The work is that of `_together.py`. A column begins with the name of its problem.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _together as together

NAME = "every"
PAPER = "together"
CELLS = {
    p: (*together.references(together.problem(p)), *together.cells_of(p))
    for p in together.FOUR
}
columns = together.columns_of(f"{p}_{c}" for p, cells in CELLS.items() for c in cells)
parameters = {"batch": together.BATCH, "program": together.program(), "cells": CELLS}
seeds = together.seeds_of()
scenarios = (
    *(together.problem(p).scenario for p in CELLS),
    together.STUDY,
    together.TUNED,
)
rtol = 1e-4
rough = [f"{p}_{k}" for p, cells in CELLS.items() for k in together.loose(cells)]


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """References and cells of the four problems."""
    return {f"{p}_{k}": v for p in CELLS for k, v in together.trial_of(p)(seed).items()}
