"""The paper's pendulum from two starts: members off the circle, and members on it.

Section 5 of Das and Bhattacharya draws members that meet the constraint; Section 6 says
only that initial conditions differ. The first start is that of the study `pendulum`.
For the second, angle and angular rate are drawn, with the prior's deviation for the
centre and about it, and every member starts on the circle. Both starts of a trial have
one true swing and the same readings.
"""

# ruff: noqa: SIM300
from __future__ import annotations

import warnings

import numpy as np

from bookkit import studies
from distfilt.coupling import project
from distfilt.filters import ParticleCollapse
from distfilt.models import pendulum_states

pendulum = studies.script("pendulum")
setting = pendulum.setting
STEPS = pendulum.STEPS
TIMES = pendulum.TIMES

warnings.filterwarnings("ignore", category=ParticleCollapse)

NAME = "starts"
PAPER = "das"

FILTERS = ("OTF", "OTMA", "OTNLeq", "OTNLeqMA")
ALGORITHMS = ("OTF", "OTProj", "OTMA", "OTNLeq", "OTNLeqMA")
SCORES = ("constraint", "position", "farthest")


def on_circle(rng: np.random.Generator) -> np.ndarray:
    """First members (N, 4) whose angle and rate are drawn, about a centre that is drawn too."""
    size = setting["prior_std"]
    start = np.array([np.deg2rad(setting["start_angle"]), setting["start_rate"]])
    centre = start + size * rng.standard_normal(2)
    chart = centre + size * rng.standard_normal((setting["members"], 2))
    return pendulum_states(chart, length=setting["length"])


def scores(members: np.ndarray, truth: np.ndarray) -> tuple[float, ...]:
    """RMS of the constraint's error and of the position's, and the largest position error."""
    gap = members.mean(axis=-2) - truth
    missed = np.hypot(*(gap + truth)[:, :2].T) - setting["length"]
    away = np.hypot(gap[:, 0], gap[:, 1])
    late = TIMES > setting["score_from"] + 1e-9
    judged = TIMES > 1 + 1e-9
    farthest = away[judged].max() if np.isfinite(away).all() else np.inf
    return np.sqrt((missed**2).mean()), np.sqrt((away[late] ** 2).mean()), farthest


def run_start(start: str, seed: np.random.SeedSequence) -> dict[str, float]:
    """The paper's five algorithms from one start."""
    rng, rng_circle = (np.random.default_rng(s) for s in seed.spawn(2))
    truth, readings, members = pendulum.data(rng)
    if start == "on":
        members = on_circle(rng_circle)
    analysis = dict(
        zip(
            FILTERS,
            np.moveaxis(pendulum.run(readings, members, FILTERS), 1, 0),
            strict=True,
        )
    )
    out = {}
    with np.errstate(all="ignore"):
        finite = np.isfinite(analysis["OTF"]).all(axis=(1, 2))
        analysis["OTProj"] = analysis["OTF"].copy()
        analysis["OTProj"][finite] = project(
            analysis["OTF"][finite], pendulum.rod, **pendulum.how
        )
        for name in ALGORITHMS:
            values = zip(SCORES, scores(analysis[name], truth), strict=True)
            out |= {f"{start}_{name}_{key}": float(value) for key, value in values}
    return out


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """The paper's five algorithms from both starts, with one true swing and the same readings."""
    fresh_seed = np.random.SeedSequence(seed.entropy, spawn_key=seed.spawn_key)
    return run_start("off", seed) | run_start("on", fresh_seed)


parameters = {name: np.asarray(setting[name]).tolist() for name in setting}
columns = tuple(
    f"{s}_{a}_{k}" for s in ("off", "on") for a in ALGORITHMS for k in SCORES
)
code = (on_circle, scores, pendulum.data, pendulum.run)
seeds = np.random.SeedSequence(3024).spawn(400)
rtol = 1e-4
# A run that has lost the swing multiplies the last bit until it decides.
max_outliers = 40
