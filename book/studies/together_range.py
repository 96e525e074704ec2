"""Chapter 11: every filter on the problem `range` of data/scenarios/together, 200 runs.

The work is that of `_together.py`; mixtures, which run one at a time, have a study of their own on
the same data.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import _together as together

NAME, PAPER = "range", "together"
CELLS = ("reference", "half", *together.cells_of(NAME))
columns = together.columns_of(CELLS)
parameters = {"batch": together.BATCH, "cells": CELLS}
seeds = together.seeds_of()
trial = together.trial_of(NAME)
scenarios = (together.problem(NAME).scenario, together.STUDY, together.TUNED)
code = together.code
rtol, rough = 1e-4, together.loose(CELLS)
