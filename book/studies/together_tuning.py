"""The one tuning budget of chapter 11: five values of one number, for every filter alike.

The runs are not reported. Filters are compared by the mean log score of all scored
components, which rewards small errors and reported covariances that fit them: no filter
gains by being overconfident or underconfident. The best values stand in
data/scenarios/together/tuned.toml.
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _together as together

NAME = "tuned"
PAPER = "together"
SEED, RUNS = together.TUNING
VALUES = range(5)
TRIED = {
    p: [
        c
        for c, cell in together.CELLS.items()
        if cell.grid and not cell.why_excluded(p)
    ]
    for p in together.FOUR
}
columns = [f"{p}_{c}_{k}" for p, cells in TRIED.items() for c in cells for k in VALUES]
parameters = {
    "runs": RUNS,
    "grids": {c: v.grid for c, v in together.CELLS.items() if v.grid},
    "program": together.program_digest(),
}
seeds = np.random.SeedSequence(SEED).spawn(1)
scenarios = (*(together.problem(p).scenario for p in together.FOUR), together.STUDY)
rtol = 1e-3
ill_conditioned = [
    c for c in columns if any(k in c for k in ("_pf_", "_ot_", "_maps_", "_gm_"))
]


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Score every value of every filter on every problem; 1e9 where a run fails."""
    scores = {}
    for name, cells in TRIED.items():
        p = together.problem(name)
        data = p.simulate(RUNS, together.stream(seed, name))
        for cell in cells:
            made = together.CELLS[cell]
            for k, value in enumerate(made.grid):
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    try:
                        mean = together.log_scores(
                            p,
                            made.make(p, value),
                            data,
                            together.stream(seed, f"{name}{cell}"),
                            local=made.local,
                        ).mean()
                    except (ValueError, ArithmeticError, RuntimeError) as error:
                        print(f"{name}, {cell}, {value}: {error}", file=sys.stderr)
                        mean = np.inf
                scores[f"{name}_{cell}_{k}"] = (
                    float(f"{mean:.6g}") if np.isfinite(mean) else 1e9
                )
    return scores
