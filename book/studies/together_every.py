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
    # The references first, then every cell that a problem has
    p: (*together.references(together.problem(p)), *together.cell_names(p))
    for p in together.FOUR
}
# A column for each run of each cell, and for both bills
columns = together.score_columns(
    f"{p}_{c}" for p, cells in CELLS.items() for c in cells
)
parameters = {
    "batch": together.BATCH,
    "program": together.program_digest(),
    "cells": CELLS,
}
seeds = together.make_seeds()
scenarios = (
    *(together.problem(p).scenario for p in CELLS),
    together.STUDY,
    together.TUNED,
)
rtol = 1e-4
ill_conditioned = [
    f"{p}_{k}"
    for p, cells in CELLS.items()
    for k in together.ill_conditioned_columns(cells)
]


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """References and cells of the four problems."""
    # Each problem has data of its own, the same for all filters.
    return {
        f"{p}_{k}": v for p in CELLS for k, v in together.run_problem(p, seed).items()
    }
