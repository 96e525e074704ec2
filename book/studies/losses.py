"""The paper's orbit with messages lost: covariance intersection and information increments."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import orbit as paper

from distfilt.network import Faults

NAME = "losses"
PAPER = "semeraro"
METRICS = ("error_tp", "nees")
ROWS = ("one_ci", "increments")
# Shares of messages that are lost
LOSSES = {"none": 0.0, "some": 0.3}


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Means over agents and the epochs from 2 to 20 h."""
    rng = np.random.default_rng(seed)
    truth, *inputs = paper.simulate(paper.SETTING, rng)
    # Both rows and both shares have the same data, and the same draws decide the losses.
    loss_seed = int(rng.integers(2**31))
    values = {}
    for row in ROWS:
        for label, share in LOSSES.items():
            options = {
                **paper.SINGLE[row],
                "faults": Faults(loss=share, seed=loss_seed),
            }
            # Single Gaussians on the paper's orbit
            states = paper.run_filter(paper.SETTING, options, *inputs)
            scores = [
                paper.score_epoch(states[k].mixtures, truth[k]) for k in paper.EARLY
            ]
            # Means over the agents, then over the epochs before the ephemeris
            values |= {
                f"{row}_{label}_{m}": float(np.mean([f[m].mean() for f in scores]))
                for m in METRICS
            }
    return {name: float(paper.SIX.format(v)) for name, v in values.items()}


columns = [f"{row}_{lost}_{m}" for row in ROWS for lost in LOSSES for m in METRICS]
parameters = {"setting": paper.SETTING, "losses": LOSSES}
code = paper.run_code
scenarios = paper.scenarios
seeds = np.random.SeedSequence(900).spawn(96)
rtol = 1e-3
