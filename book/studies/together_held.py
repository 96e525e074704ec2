"""Chapter 11's held-out problems, on which its decision tree is tried: every filter, 200 runs."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _together as together

NAME = "held"
PAPER = "together"
CELLS = {p: ("reference", *together.cell_names(p)) for p in together.THREE}
# A column for each run of each cell, and for both bills
columns = together.score_columns(
    [f"{p}_{c}" for p, cells in CELLS.items() for c in cells]
)
parameters = {
    "batch": together.BATCH,
    "program": together.program_digest(),
    "cells": CELLS,
}
# Seeds of their own: these runs are in no other study.
seeds = np.random.SeedSequence(together.STUDY["seed"] + 2).spawn(
    len(together.make_seeds())
)
scenarios = (together.HELD, together.STUDY, together.TUNED)
rtol = 1e-4
ill_conditioned = columns


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """References and cells of the three problems."""
    metrics: dict[str, float] = {}
    for name in together.THREE:
        p = together.problem(name)
        # The reference with half the effort serves the row of the grid alone.
        part = together.measure_references(p, seed, together.draw_data(p, seed))
        part |= together.measure_cells(name, seed, together.cell_names(name))
        metrics |= {
            f"{name}_{k}": v for k, v in part.items() if not k.startswith("half")
        }
    return metrics
