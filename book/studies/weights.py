"""The paper's orbit with weights by C1, on the first sixteen seeds of the study `orbit`."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import orbit as paper

from distfilt.mixtures import fuse

NAME, PAPER = "weights", "semeraro"
METRICS = ("error_tp", "error_tv", "error_ep", "error_ev", "nees_t", "nees_e", "nees", "apart")


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Means over agents and the epochs from 2 to 20 h."""
    truth, *rest = paper.data(paper.SETTING, np.random.default_rng(seed.spawn(1)[0]))
    options = {**paper.MANY, "agreement": partial(fuse, rule="C1")}
    states = paper.run(paper.SETTING, options, *rest)
    found = [paper.scored(states[k].mixtures, truth[k]) for k in paper.EARLY]
    out = {f"c1_{m}": float(np.mean([f[m].mean() for f in found])) for m in METRICS}
    out["c1_floats"] = float(states[-1].ledger.scalars.sum())
    return {name: float(paper.SIX.format(v)) for name, v in out.items()}


columns = [f"c1_{m}" for m in (*METRICS, "floats")]
parameters = {"setting": paper.SETTING}
code = (paper.data, paper.readings, paper.beliefs, paper.network, paper.run, paper.scored)
scenarios = paper.scenarios
seeds = paper.seeds[:16]
rtol = 1e-3
