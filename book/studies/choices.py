"""The paper's pendulum under other choices: release angle, pretended noise, the reading of (12).

The runs are the first of the study `starts`. From both of its starts measurement
augmentation runs with four deviations of the pretended observation, and projection with
the two interpretations of (12) that move members towards the constraint. OTF also runs
from 30° in place of 60°.
"""

from __future__ import annotations

import numpy as np

from bookkit import studies
from distfilt.updates import etpf, with_augmentation, with_projection

starts = studies.script("starts")
pendulum = starts.pendulum
setting = starts.setting

NAME = "choices"
PAPER = "das"

STDS = (0.02, 0.05, 0.1, 0.2)
"""Deviations of the pretended reading of the squared length, in m²; columns have thousandths."""
VARIANTS = ("shift", "particle")
UPDATES = {
    f"OTMA_{round(1000 * std)}": with_augmentation(etpf, pendulum.rod, std=std)
    for std in STDS
}
for _variant in VARIANTS:
    _how = {**pendulum.how, "variant": _variant}
    UPDATES[f"OTNLeq_{_variant}"] = with_projection(etpf, pendulum.rod, **_how)
    UPDATES[f"OTNLeqMA_{_variant}"] = with_projection(
        pendulum.augmented_etpf, pendulum.rod, **_how
    )
SCORES = (*starts.SCORES, "normal")


def scores(members: np.ndarray, truth: np.ndarray) -> tuple[float, ...]:
    """Those of `starts`, and the spread of the members' lengths in the first second."""
    lengths = np.hypot(members[:20, :, 0], members[:20, :, 1])
    return *starts.scores(members, truth), lengths.std(axis=1).mean()


def run_start(start: str, seed: np.random.SeedSequence) -> dict[str, float]:
    """All updates on one run, from one of the starts."""
    rng, rng_circle = (np.random.default_rng(s) for s in seed.spawn(2))
    truth, readings, members = pendulum.data(rng)
    if start == "on":
        members = starts.on_circle(rng_circle)
    analysis = pendulum.run(readings, members, tuple(UPDATES), UPDATES)
    return {
        f"{start}_{name}_{key}": float(value)
        for k, name in enumerate(UPDATES)
        for key, value in zip(SCORES, scores(analysis[:, k], truth), strict=True)
    }


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Both starts, and OTF released from 30°."""
    truth, readings, members = pendulum.data(
        np.random.default_rng(seed.spawn(2)[0]), 30.0
    )
    low = pendulum.run(readings, members, ("OTF",))[:, 0]
    columns = {
        f"low_OTF_{key}": float(v)
        for key, v in zip(SCORES, scores(low, truth), strict=True)
    }
    for start in ("off", "on"):
        fresh = np.random.SeedSequence(seed.entropy, spawn_key=seed.spawn_key)
        columns |= run_start(start, fresh)
    return columns


parameters = {name: np.asarray(setting[name]).tolist() for name in setting}
parameters |= {"stds": list(STDS), "variants": list(VARIANTS)}
columns = (
    *(f"low_OTF_{key}" for key in SCORES),
    *(
        f"{start}_{name}_{key}"
        for start in ("off", "on")
        for name in UPDATES
        for key in SCORES
    ),
)
code = (run_start, scores, starts.scores, starts.on_circle, pendulum.data, pendulum.run)
seeds = starts.seeds[:60]
rtol = 1e-4
# A run that has lost the swing multiplies the last bit until it decides.
max_outliers = 12
