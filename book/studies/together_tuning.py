"""The one tuning of chapter 11: a grid of values of one number, for every filter alike.

The search goes on beyond an end of what it has tried as long as the best value is there.
The runs are not reported, and each problem has runs of its own, those held out too. The
value that is kept is the best by the rule of the table of results: the least error among
the values with which the filter is consistent. The best values stand in
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
PROBLEMS = (*together.FOUR, *together.THREE)
SCORES = ("error", "nees")
# A failure, as a file has no infinity
LARGEST = 1e9
# The first of the three values that are tried first
FIRST = {"inflation": 4, "jitter": 1, "gain": 2, "rejuvenation": 2}
# Transport without rejuvenation and grids have nothing to tune.
TRIED = {
    p: [
        c
        for c, cell in together.CELLS.items()
        if cell.grid and not cell.why_excluded(p)
    ]
    for p in PROBLEMS
}
# Two scores for each value of each filter on each problem
columns = [
    f"{p}_{c}_{k}_{score}"
    for p, cells in TRIED.items()
    for c in cells
    for k in range(len(together.CELLS[c].grid))
    for score in SCORES
]
parameters = {
    "runs": RUNS,
    "grids": {c: v.grid for c, v in together.CELLS.items() if v.grid},
    "program": together.program_digest(),
}
# Each trial is a problem, with a batch of runs of its own.
seeds = np.random.SeedSequence(SEED).spawn(len(PROBLEMS))
scenarios = (
    *(together.problem(p).scenario for p in together.FOUR),
    together.HELD,
    together.STUDY,
)
rtol = 1e-3
ill_conditioned = columns


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Score the values that are tried of every filter on one problem; NaN for all others."""
    scores = dict.fromkeys(columns, np.nan)
    # The seed's number is that of the problem.
    name = PROBLEMS[seed.spawn_key[-1]]
    p = together.problem(name)
    # The data are the same for all filters of a problem.
    data = p.simulate(RUNS, together.stream(seed, name))
    for cell in TRIED[name]:
        for k, pair in search_values(p, cell, data, seed).items():
            for score, value in zip(SCORES, pair, strict=True):
                scores[f"{name}_{cell}_{k}_{score}"] = value
    return scores


def search_values(
    p: together.Problem, cell: str, data: object, seed: np.random.SeedSequence
) -> dict[int, tuple[float, float]]:
    """Return error and NEES by the number of the value in the cell's grid.

    Three values in the middle are tried first. While a value that counts is at an end of
    those tried, the next one beyond it is tried too.
    """
    last = len(together.CELLS[cell].grid) - 1
    low = FIRST[together.CELLS[cell].option]
    high = low + 2
    tried = {k: score_value(p, cell, k, data, seed) for k in range(low, high + 1)}
    while True:
        values = [tried[k] for k in range(low, high + 1)]
        ends = together.values_that_count(*np.array(values).T)
        if 0 in ends and low > 0:
            low -= 1
            tried[low] = score_value(p, cell, low, data, seed)
        elif high - low in ends and high < last:
            high += 1
            tried[high] = score_value(p, cell, high, data, seed)
        else:
            return tried


def score_value(
    p: together.Problem, cell: str, k: int, data: object, seed: np.random.SeedSequence
) -> tuple[float, float]:
    """Return the mean error and NEES of a batch with the k-th value of a cell's grid."""
    made = together.CELLS[cell]
    # A generator of the problem and the cell: all values draw the same numbers.
    rng = together.stream(seed, f"{p.name}{cell}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            scores = together.score_filter(
                p, made.make(p, made.grid[k]), data, rng, local=made.local
            )
        except (ValueError, ArithmeticError, RuntimeError) as error:
            print(f"{p.name}, {cell}, {k}: {error}", file=sys.stderr)
            return LARGEST, LARGEST
    means = [float(scores[key].mean()) for key in SCORES]
    # A batch in which a run has failed has no mean. Six digits are enough to store.
    error, nees = (
        min(float(f"{x:.6g}"), LARGEST) if np.isfinite(x) else LARGEST for x in means
    )
    return error, nees
