"""Fig. 2 of Grange et al.: five agents with principal components, 100 runs, at every step.

With the gain of the scenario, and without any pull: the difference is the effect of
consensus.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _satellites as satellites

NAME = "figure-2"
PAPER = "grange"
BATCH = 4
SETUP = satellites.setup("table-3")
# The paper prints no gain; the scenario has the one of our figure.
GAINS = {"pca": SETUP.pull["gain"], "alone": 0.0}
columns = [
    c
    for name in GAINS
    for c in (
        *satellites.score_columns(SETUP, name, BATCH),
        *satellites.step_columns(SETUP, name),
    )
]
parameters = {"batch": BATCH, "seed": 2025, "gains": GAINS}
seeds = np.random.SeedSequence(satellites.SEED + 1).spawn(SETUP.runs // BATCH)
scenarios = (SETUP.scenario,)
# The error of a filter without consensus grows, and a difference of the last bit with it.
rtol = 1e-3


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """A batch of runs with both gains, on the same data."""
    # Both gains have the same data; each filter has draws of its own.
    for_data, for_filters = seed.spawn(2)
    truth, seen = satellites.draw_data(SETUP, np.random.default_rng(for_data), (BATCH,))
    values: dict[str, float] = {}
    for name, gain in GAINS.items():
        # Gain 0 is the null of the claim: no consensus at all.
        f = satellites.paper_filter(SETUP, pca=True, gain=gain)
        result = satellites.run_filter(SETUP, f, for_filters, truth, seen)
        values |= satellites.score_runs(SETUP, name, result)
        values |= satellites.step_series(SETUP, name, result)
    return values


def part(seed: np.random.SeedSequence) -> dict[str, float]:
    """The paper's filter with the pull, as in the trial, for chapter 4 to run again."""
    for_data, for_filters = seed.spawn(2)
    truth, seen = satellites.draw_data(SETUP, np.random.default_rng(for_data), (BATCH,))
    # The pull comes first in the trial, so its draws are the same.
    f = satellites.paper_filter(SETUP, pca=True, gain=GAINS["pca"])
    result = satellites.run_filter(SETUP, f, for_filters, truth, seen)
    return satellites.score_runs(SETUP, "pca", result) | satellites.step_series(
        SETUP, "pca", result
    )


code = (satellites.draw_data, satellites.paper_filter, satellites.score_runs)
