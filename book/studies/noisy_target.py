"""Information increments against shared observations, of a target with process noise.

The stored trial is the orbit of chapter 8 with five agents, noise on all velocities and
no ephemeris. ``increments`` is `InformationIncrementFilter`; in ``joint`` each agent filters
[target; all agents] with the observations of all; ``intersection`` fuses beliefs of the
target.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import orbit as paper

from distfilt.filters import GaussianFilter
from distfilt.mixtures import GaussianMixture
from distfilt.network import graphs
from distfilt.sensors import angles_only

NAME = "noisy-target"
PAPER = "semeraro"
SETTING = {
    **paper.SETTING,
    "agents": paper.CROWD,
    "fix_at": 0,
    "noise_std": [paper.SETTING["noise_std"][0], 0.5],
}
"""Every two hours add half a metre per second to each component of each velocity."""
# Squared error and reported variance of the target's position, and NEES
METRICS = ("error_tp", "variance_tp", "nees_t", "nees")
ROWS = ("intersection", "increments", "joint")


def run_joint(
    s: dict, seen: np.ndarray, first: np.ndarray, covs: list
) -> tuple[list[list[GaussianMixture]], float]:
    """Run joint filters on shared angles; return beliefs of [target; ego] and numbers sent."""
    n = len(s["agents"])
    # Sensor a measures the direction from agent a to the target, in the joint state.
    eye = partial(angles_only, std=s["angle_std"] * paper.ARCSECOND, form=s["form"])
    eyes = [eye(observer=6 * a) for a in range(1, n + 1)]
    f = GaussianFilter(
        paper.orbit_model(s, n + 1), eyes, graphs.complete(n), linearization="unscented"
    )
    # All agents start with the same belief about all bodies.
    state = f.start((first, paper.block_diagonal(covs)))
    beliefs = []
    for k, hour in enumerate(paper.HOURS):
        # Only angles are observed: columns 0 and 1.
        state = f.step(state, 3600.0 * hour, list(seen[k, :, :2]))
        # Each agent's belief about [target; ego] is a marginal of its joint one.
        components = [[*range(6), *range(6 * a, 6 * a + 6)] for a in range(1, n + 1)]
        beliefs.append(
            [
                GaussianMixture.gaussian(m[o], p[np.ix_(o, o)])
                for m, p, o in zip(
                    state.means, state.covariances, components, strict=True
                )
            ]
        )
    return beliefs, float(state.ledger.scalars.sum())


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Return the three rows on one set of data, means over agents and epochs from 2 to 20 h."""
    truth, *inputs = paper.simulate(SETTING, np.random.default_rng(seed))
    metrics: dict[str, float] = {}
    for row, options in zip(ROWS, ("one_ci", "increments", None), strict=True):
        # The three rows filter the same data.
        if options is None:
            beliefs, sent = run_joint(SETTING, *inputs)
        else:
            states = paper.run_filter(SETTING, paper.SINGLE[options], *inputs)
            beliefs = [state.mixtures for state in states]
            sent = float(states[-1].ledger.scalars.sum())
        # Means over agents and the epochs from 2 to 20 h
        scores = [paper.score_epoch(beliefs[k], truth[k]) for k in paper.EARLY]
        metrics |= {
            f"{row}_{m}": float(np.mean([f[m].mean() for f in scores])) for m in METRICS
        }
        metrics[f"{row}_floats"] = sent
    return {name: float(paper.SIX.format(v)) for name, v in metrics.items()}


columns = [f"{row}_{m}" for row in ROWS for m in (*METRICS, "floats")]
parameters = {"setting": SETTING}
code = (*paper.run_code, run_joint)
scenarios = paper.scenarios
seeds = np.random.SeedSequence(1920).spawn(104)
rtol = 1e-3
