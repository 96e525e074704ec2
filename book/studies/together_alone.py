"""Chapter 11's mixtures, which run one at a time, on the main table's own data."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _together as together

NAME, PAPER = "alone", "together"
# Mixtures follow a curved flow or curved readings; with linear ones a single mixand is exact.
CELLS = {"lorenz": ("gm_c3",)}
COLUMNS = [f"{p}_{c}" for p, cells in CELLS.items() for c in cells]
columns = together.columns_of(COLUMNS)
parameters = {"batch": together.BATCH, "cells": CELLS}
seeds = together.seeds_of()
scenarios = (*(together.problem(p).scenario for p in CELLS), together.STUDY, together.TUNED)
code = together.code
rtol, rough = 1e-4, columns


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Each of them on the data of the trial of its problem."""
    out = {}
    for name, cells in CELLS.items():
        found = together.compared(name, seed, cells)
        out |= {f"{name}_{column}": value for column, value in found.items()}
    return out
