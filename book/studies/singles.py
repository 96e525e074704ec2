"""Single Gaussians on the paper's orbit, many seeds: fusion against the joint filter.

The draws are those of the study `orbit`, whose 48 seeds are the first of these. The
unscented rows are the same filters with unscented points in place of second-order
differences.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import orbit as paper

from distfilt.filters import GaussianFilter
from distfilt.mixtures import GaussianMixture, fuse_moments, target_fusion
from distfilt.network import Channel, graphs

NAME = "singles"
PAPER = "semeraro"
METRICS = ("error_tp", "error_ep", "nees_t", "nees_e", "nees")
# None: a row of the study `orbit`; else unscented filters, and whether they fuse
ROWS = {"one_none": None, "one_ci": None, "unscented_none": False, "unscented_ci": True}


def fuse_targets(
    belief: tuple[np.ndarray, np.ndarray], channel: Channel
) -> tuple[np.ndarray, np.ndarray]:
    """Intersect the targets' covariances, as a fusion rule of `GaussianFilter`."""
    # One component each: the fusion of mixtures is then covariance intersection.
    mixtures = [GaussianMixture.gaussian(m, p) for m, p in zip(*belief, strict=True)]
    fuse = partial(fuse_moments, omega="equal")
    fused = [
        m.moments() for m in target_fusion(mixtures, channel, target_dim=6, fuse=fuse)
    ]
    return np.array([m for m, _ in fused]), np.array([p for _, p in fused])


def run_unscented(
    s: dict, fuses: bool, seen: np.ndarray, first: np.ndarray, covs: list
) -> list[list[GaussianMixture]]:
    """Run unscented filters of one Gaussian; return beliefs by epoch and agent."""
    n = len(s["agents"])
    # Observations stay with their agent; only beliefs about the target are sent.
    start = [b.moments() for b in paper.prior_beliefs(first, covs)]
    f = GaussianFilter(
        paper.orbit_model(s, 2),
        [paper.agent_sensor(s)] * n,
        graphs.complete(n),
        share_observations=False,
        linearization="unscented",
        kappa=1.0,
        fusion=fuse_targets if fuses else None,
    )
    state = f.start(start[0])
    beliefs = []
    means = np.array([m for m, _ in start])
    covariances = np.array([p for _, p in start])
    # Each agent has a prior of its own.
    state = state.replace(joint_means=means, joint_covariances=covariances)
    for k, hour in enumerate(paper.HOURS):
        state = f.step(state, 3600.0 * hour, list(seen[k]))
        pairs = zip(state.means, state.covariances, strict=True)
        beliefs.append([GaussianMixture.gaussian(m, p) for m, p in pairs])
    return beliefs


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Means over agents and the epochs from 2 to 20 h."""
    s = paper.SETTING
    # The draws of the study `orbit`
    truth, *inputs = paper.simulate(s, np.random.default_rng(seed.spawn(1)[0]))
    # The joint filter has all observations: the reference.
    beliefs = {"bound": paper.run_joint(s, paper.ONE, *inputs)}
    for row, fuses in ROWS.items():
        # The same data for each row
        if fuses is None:
            states = paper.run_filter(s, paper.SINGLE[row], *inputs)
            beliefs[row] = [state.mixtures for state in states]
        else:
            beliefs[row] = run_unscented(s, fuses, *inputs)
    values: dict[str, float] = {}
    for row, row_beliefs in beliefs.items():
        # Means over agents and the epochs before the ephemeris
        scores = [paper.score_epoch(row_beliefs[k], truth[k]) for k in paper.EARLY]
        values |= {
            f"{row}_{m}": float(np.mean([f[m].mean() for f in scores])) for m in METRICS
        }
    # Six digits are stored.
    return {name: float(paper.SIX.format(v)) for name, v in values.items()}


columns = [f"{row}_{m}" for row in ("bound", *ROWS) for m in METRICS]
parameters = {"setting": paper.SETTING, "rows": sorted(ROWS)}
code = (*paper.run_code, fuse_targets, run_unscented, paper.run_joint)
scenarios = paper.scenarios
seeds = np.random.SeedSequence(480).spawn(448)
rtol = 1e-3
