"""Lorenz-63 with three maps and three sizes of ensemble: the study behind chapter 3's comparison.

All three components are observed through noise of variance 4, every 0.1 units of time.
Each trial has one truth, one series of observations and one set of first members for
all filters.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from distfilt.models import lorenz63, simulate
from distfilt.triangular import affine, separable
from distfilt.updates import transport_map_update

NAME = "lorenz-63"
PAPER = "grange"

MEMBERS = (100, 400, 1000)
DT = 0.1
STEPS = 150
BURN = 30
VARIANCE = 4.0
PENALTY = 0.01
MAPS = {
    "affine": affine.fit,
    "one": partial(separable.fit, order=1, regularisation=PENALTY),
    "two": partial(separable.fit, order=2, regularisation=PENALTY),
}


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Root-mean-square errors and spreads of every map and size, averaged over time."""
    rng, source = (np.random.default_rng(s) for s in seed.spawn(2))
    model = lorenz63(step=0.02)
    start = rng.standard_normal(3) + [1.5, -1.5, 25.5]
    times = DT * np.arange(1, 101 + STEPS)
    # The first hundred times bring the state onto the attractor.
    path = simulate(model, start, times, rng=rng)
    first = path[99]
    truth = path[100:]
    seen = truth + np.sqrt(VARIANCE) * rng.standard_normal(truth.shape)
    cloud = first + np.sqrt(VARIANCE) * rng.standard_normal((MEMBERS[-1], 3))
    draws = source.spawn(len(MEMBERS))
    values = {}
    for n, stream in zip(MEMBERS, draws, strict=True):
        state = stream.bit_generator.state
        for name, fit in MAPS.items():
            # All maps of one size draw the same numbers.
            stream.bit_generator.state = state
            values.update(scores(f"{name}_{n}", fit, cloud[:n], truth, seen, stream))
    return values


def scores(name, fit, members, truth, seen, rng):
    """One filter: mean over time of its error and of its spread."""
    model = lorenz63(step=0.02)
    errors = []
    spreads = []
    noise = VARIANCE * np.eye(3)
    for k, y in enumerate(seen):
        members = model.step(members, 0.0, DT)
        members = transport_map_update(members, members, y, noise, rng=rng, fit=fit)
        if k >= BURN:
            gap = members.mean(axis=0) - truth[k]
            errors.append(np.sqrt((gap**2).mean()))
            spreads.append(np.sqrt(members.var(axis=0, ddof=1).mean()))
    return {f"{name}_rmse": np.mean(errors), f"{name}_spread": np.mean(spreads)}


parameters = {
    "members": list(MEMBERS),
    "dt": DT,
    "steps": STEPS,
    "burn": BURN,
    "variance": VARIANCE,
    "penalty": PENALTY,
    "maps": list(MAPS),
}
columns = tuple(
    f"{m}_{n}_{what}" for n in MEMBERS for m in MAPS for what in ("rmse", "spread")
)
code = (scores,)
seeds = np.random.SeedSequence(363).spawn(60)
rtol = 1e-6
