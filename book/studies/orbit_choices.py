"""Choices that the paper leaves open in orbit, swept: do the conclusions of Figs. 4 to 6 need them?

The rule for weights and its terms, how many components an agent keeps, from which
length a component is split, and whether the ephemeris of 22 h has one error or one for
each agent. The draws are those of the study `orbit`. The null of Fig. 4, beliefs that
are added as if they were independent, is a row too.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import orbit as paper

from bookkit.studies import Stored, check, stored
from distfilt.mixtures import GaussianMixture, fuse_mixtures

NAME = "orbit-choices"
PAPER = "semeraro"
# Epochs before the ephemeris, in hours
EARLY_HOURS = tuple(paper.HOURS[k] for k in paper.EARLY)
# An ephemeris of 22 h with an error of each agent's own
FIXES = {**paper.SETTING, "one_fix": False}


def with_components(mixands: int) -> dict[str, Any]:
    """Return the options of mixture filters with a number of components."""
    return {**paper.MANY, "n_components": mixands, "max_components": mixands}


CHOICES: dict[str, tuple[dict, dict, dict[str, Any]]] = {
    # Rules and terms, on filters as in the figures
    "weights": (
        paper.SETTING,
        paper.MANY,
        {
            "c1": partial(fuse_mixtures, rule="C1"),
            "c2": partial(fuse_mixtures, rule="C2"),
            "all": partial(fuse_mixtures, terms="all"),
        },
    ),
    # Half and twice as many components as in the figures
    "mixands_6": (paper.SETTING, with_components(6), {"c3": fuse_mixtures}),
    "mixands_24": (paper.SETTING, with_components(24), {"c3": fuse_mixtures}),
    # Half and twice the length from which a component is split
    "split_2": (
        paper.SETTING,
        {**paper.MANY, "split_threshold": 2.5},
        {"c3": fuse_mixtures},
    ),
    "split_10": (
        paper.SETTING,
        {**paper.MANY, "split_threshold": 10.0},
        {"c3": fuse_mixtures},
    ),
    "fixes": (FIXES, paper.MANY, {"c3": fuse_mixtures}),
}
"""A setting, the options of its filters, and the fusion rules that are tried with them."""


def multiply_beliefs(
    own: GaussianMixture, received: list[GaussianMixture]
) -> GaussianMixture:
    """Multiply beliefs, which counts shared information twice."""
    m, P = own.moments()
    mean, cov = received[0].moments()
    # The received belief acts as an independent observation of the target, with
    # J = cov⁻¹ and the gain G J, G = P[:, t] (I + J P_tt)⁻¹.
    J = np.linalg.inv(cov)
    G = P[:, :6] @ np.linalg.inv(np.eye(6) + J @ P[:6, :6])
    fused_mean = m + G @ J @ (mean - m[:6])
    fused_cov = P - G @ J @ P[:6]
    # Rounding must not leave it asymmetric.
    return GaussianMixture.gaussian(fused_mean, 0.5 * (fused_cov + fused_cov.T))


def run_row(
    s: dict, options: dict, truth: np.ndarray, inputs: tuple
) -> dict[str, float]:
    """A filter's means over agents and the epochs from 2 to 20 h, and each agent's errors."""
    states = paper.run_filter(s, options, *inputs)
    scores = [
        paper.score_epoch(x.mixtures, true)
        for x, true in zip(states, truth, strict=True)
    ]
    # Means over agents and the epochs before the ephemeris
    early = [scores[k] for k in paper.EARLY]
    means = {
        m: float(np.mean([f[m].mean() for f in early])) for m in (*paper.ERRORS, "nees")
    }
    # How much the reported standard deviation falls at the ephemeris
    variances = [scores[paper.HOURS.index(h)]["variance_tp"].mean() for h in (20, 22)]
    means["std_ratio"] = float(np.sqrt(variances[1] / variances[0]))
    # Each agent's squared errors of the target, position and velocity
    for hour, values in zip(EARLY_HOURS, early, strict=True):
        for a in (0, 1):
            means[f"target{a + 1}_{hour}"] = float(values["error_tp"][a])
            means[f"speed{a + 1}_{hour}"] = float(values["error_tv"][a])
    return means


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """All choices on one set of data."""
    # The draws of the study `orbit`: its first child is that of the paper's scene.
    child = seed.spawn(1)[0]
    metrics = {}
    for name, (s, options, rules) in CHOICES.items():
        truth, *inputs = paper.simulate(s, np.random.default_rng(child))
        # Every choice is compared with the same filters without fusion.
        rows = {"none": run_row(s, options, truth, tuple(inputs))}
        for rule, fusion in rules.items():
            rows[rule] = run_row(s, {**options, "fusion": fusion}, truth, tuple(inputs))
        metrics |= {
            f"{name}_{rule}_{m}": v for rule, r in rows.items() for m, v in r.items()
        }
    truth, *inputs = paper.simulate(paper.SETTING, np.random.default_rng(child))
    # The null: single Gaussians that are multiplied
    null = run_row(
        paper.SETTING, {**paper.ONE, "fusion": multiply_beliefs}, truth, tuple(inputs)
    )
    metrics["added_nees"] = null["nees"]
    return {name: float(paper.SIX.format(v)) for name, v in metrics.items()}


PARTS = ("target", "speed")
METRICS = (
    *paper.ERRORS,
    "nees",
    "std_ratio",
    *(f"{part}{a}_{h}" for h in EARLY_HOURS for a in (1, 2) for part in PARTS),
)
columns = [
    f"{name}_{rule}_{m}"
    for name, (_, _, rules) in CHOICES.items()
    for rule in ("none", *rules)
    for m in METRICS
] + ["added_nees"]
parameters = {
    "setting": paper.SETTING,
    "choices": {name: ["none", *rules] for name, (_, _, rules) in CHOICES.items()},
}
code = (*paper.run_code, with_components, multiply_beliefs, run_row)
scenarios = paper.scenarios
seeds = paper.seeds
rtol = 1e-3
# The last bit decides which of 24 nearly equal components are merged, and the later hours with it.
max_outliers = 2


def run_live(seed: np.random.SeedSequence) -> dict[str, float]:
    """Run the null and the one choice that is quick enough to run wherever the study is read."""
    # Few components make it quick.
    s, options, rules = CHOICES["mixands_6"]
    truth, *inputs = paper.simulate(s, np.random.default_rng(seed.spawn(1)[0]))
    fused = {**options, "fusion": rules["c3"]}
    chosen_options = {
        "none": options,
        "c3": fused,
        "added": {**paper.ONE, "fusion": multiply_beliefs},
    }
    rows = {
        name: run_row(s, chosen, truth, tuple(inputs))
        for name, chosen in chosen_options.items()
    }
    values = {
        f"mixands_6_{name}_{m}": rows[name][m]
        for name in ("none", "c3")
        for m in METRICS
    }
    values["added_nees"] = rows["added"]["nees"]
    return {name: float(paper.SIX.format(v)) for name, v in values.items()}


def load_checked() -> Stored:
    """Return the stored study, after that part of two trials has run again and agrees."""
    study = stored(PAPER, NAME)
    quick = {
        m: v for m, v in study.columns.items() if m.startswith(("mixands_6_", "added_"))
    }
    check(replace(study, columns=quick), run_live, indices=[0, 1], rtol=rtol)
    return study
