"""How well can the pendulum be known? Cartesian filters, filters in the chart, and a bound.

Three cases. ``still`` has no process noise, as in the paper; ``noisy`` has some; in ``mirror`` the
sensor sees only \\|x\\|, so that the posterior has two modes for ever. All ensembles start on the
manifold. True swings start from draws of the prior that every filter is given, so that the
posterior's mean is the best estimate on average: the bound. That of ``still`` is a grid of initial
conditions, that of the others particles in the chart.
"""

# ruff: noqa: SIM300
from __future__ import annotations

import warnings
from functools import partial

import numpy as np

from bookkit.published import scenario
from distfilt.coupling import norm_constraint, retract
from distfilt.filters import ParticleCollapse
from distfilt.metrics import crps
from distfilt.models import pendulum, pendulum_angle, pendulum_chart, pendulum_states
from distfilt.updates import (
    enkf,
    etkf,
    etpf,
    resample,
    with_augmentation,
    with_projection,
    with_retraction,
)

# The study counts the runs that lose the truth.
warnings.filterwarnings("ignore", category=ParticleCollapse)

NAME = "pendulum-bound"
PAPER = "das"

setting = scenario("das", "pendulum")
RUNS = 48
PARTICLES = 4000
CELLS = 161
REACH = 0.45
DT = setting["dt_observe"]
STEPS = round(setting["end_time"] / DT)
TIMES = DT * np.arange(1, STEPS + 1)
LATE = np.flatnonzero(TIMES > setting["score_from"] + 1e-9)
LENGTH = setting["length"]
N = setting["members"]
START = np.array([np.deg2rad(setting["start_angle"]), setting["start_rate"]])
NOISE = setting["noise_variance"] * np.eye(2)
KICK = np.array([setting["noise_position"], setting["noise_velocity"]])
PRIOR = (START, setting["prior_std"])
MIRROR = (np.array([0.0, 0.0]), np.array([0.8, 0.5]))

rod = norm_constraint([0, 1], length=LENGTH)
motion = ([0, 1], [2, 3])
options = {
    "length": LENGTH,
    "gravity": setting["gravity"],
    "step": setting["integration_step"],
}
cartesian = pendulum(**options)
chart = pendulum_angle(**options)
seen_too = with_augmentation(etpf, rod, std=setting["constraint_std"])
how = {"variant": setting["variant"], "regularisation": setting["regularisation"]}
CARTESIAN = {
    "OTF": etpf,
    "OTMA": seen_too,
    "OTNLeq": with_projection(etpf, rod, **how),
    "OTNLeqMA": with_projection(seen_too, rod, **how),
    "OT_retracted": with_retraction(etpf, rod, motion=motion),
    "EnKF_retracted": with_retraction(enkf, rod, motion=motion),
    "EnKF": enkf,
}
CHART = {
    "root_chart": etkf,
    "EnKF_chart": enkf,
    "OT_chart": etpf,
    "OT2_chart": partial(etpf, correct=True),
}
MIRRORED = {
    "EnKF_chart": enkf,
    "OT_chart": partial(etpf, rejuvenation=0.1),
}
FILTERS = (*CARTESIAN, *CHART, "EKF_chart", "bound")


def place(q: np.ndarray) -> np.ndarray:
    """Cartesian states of chart coordinates."""
    return pendulum_states(q, length=LENGTH)


def data(rng: np.random.Generator, noisy: bool, prior=PRIOR) -> tuple[np.ndarray, ...]:
    """True chart states (T, 2) from a draw of the prior, readings (T, 2), the prior's centre."""
    centre, std = prior
    state = centre + std * rng.standard_normal(2)
    truth = np.empty((STEPS, 2))
    for k in range(STEPS):
        state = chart.step(state, 0.0, DT) + noisy * KICK * rng.standard_normal(2)
        truth[k] = state
    seen = place(truth)[:, :2] + np.sqrt(NOISE[0, 0]) * rng.standard_normal((STEPS, 2))
    return truth, seen, centre


def many(seeds) -> tuple[np.ndarray, np.ndarray]:
    """The noisy case of many runs at once: true chart states (T, R, 2) and readings (T, R, 2)."""
    drawn = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        drawn.append(
            [rng.standard_normal(shape) for shape in (2, (STEPS, 2), (STEPS, 2))]
        )
    first, kicks, errors = (np.stack(x) for x in zip(*drawn, strict=True))
    state = PRIOR[0] + PRIOR[1] * first
    truth = np.empty((STEPS, len(first), 2))
    for k in range(STEPS):
        state = truth[k] = chart.step(state, 0.0, DT) + KICK * kicks[:, k]
    return truth, place(truth)[..., :2] + np.sqrt(NOISE[0, 0]) * errors.swapaxes(0, 1)


def ensembles(updates, members, model, see, readings, noise, noisy, rng):
    """Analysis members of filters with one model, {name: (T, N, d)}."""
    inner = {name: update for name, update in updates.items()}
    x = np.stack([members] * len(inner))
    out = np.full((STEPS, *x.shape), np.nan)
    kick = np.repeat(KICK, x.shape[-1] // 2)
    with np.errstate(all="ignore"):
        for k, y in enumerate(readings):
            x = model.transition(x, 0.0, DT)
            if noisy:
                x = x + kick * rng.standard_normal(x.shape[1:])
            for f, update in enumerate(inner.values()):
                if np.isfinite(x[f]).all():
                    try:
                        x[f] = update(x[f], see(x[f]), y, noise, rng=rng)
                    except (ValueError, RuntimeError, ArithmeticError):
                        x[f] = np.nan
            out[k] = x
    return dict(zip(inner, np.moveaxis(out, 1, 0), strict=True))


def extended(readings, centre, noisy, rng):
    """The extended Kalman filter in the chart; draws of its Gaussian stand for members."""
    m = centre
    p = setting["prior_std"] ** 2 * np.eye(2)
    out = []
    draws = rng.standard_normal((N, 2))
    draws = (draws - draws.mean(axis=0)) @ np.linalg.inv(
        np.linalg.cholesky(np.cov(draws.T))
    ).T
    for y in readings:
        f = chart.jacobian(m, 0.0, DT)
        m = chart.step(m, 0.0, DT)
        p = f @ p @ f.T + noisy * np.diag(KICK**2)
        h = LENGTH * np.array([[np.cos(m[0]), 0.0], [-np.sin(m[0]), 0.0]])
        gain = np.linalg.solve(h @ p @ h.T + NOISE, h @ p).T
        m = m + gain @ (y - place(m)[:2])
        p = (np.eye(2) - gain @ h) @ p
        p = 0.5 * (p + p.T)
        out.append(m + draws @ np.linalg.cholesky(p).T)
    return np.array(out)


KEPT: dict[int, tuple[np.ndarray, np.ndarray]] = {}
"""What `paths` found. A function with a cache of its own could not be sent to a worker."""


def paths() -> tuple[np.ndarray, np.ndarray]:
    """A grid of initial conditions (G, 2), and where each is at every time, (T, G, 2)."""
    if CELLS in KEPT:
        return KEPT[CELLS]
    side = REACH * np.linspace(-1, 1, CELLS)
    grid = START + np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    x = grid
    out = np.empty((STEPS, len(grid), 2), dtype=np.float32)
    for k in range(STEPS):
        x = out[k] = chart.transition(x.copy(), 0.0, DT)
    KEPT[CELLS] = grid, out
    return grid, out


def grid_bound(readings, centre, rng):
    """Draws of the posterior of the motion without noise, (T, 400, 2)."""
    grid, path = paths()
    logs = -0.5 * ((grid - centre) ** 2).sum(axis=1) / setting["prior_std"] ** 2
    kept = np.flatnonzero(logs > -18)
    logs = logs[kept]
    out = []
    for k, y in enumerate(readings):
        here = path[k, kept].astype(np.float64)
        gap = LENGTH * np.column_stack([np.sin(here[:, 0]), np.cos(here[:, 0])]) - y
        logs = logs - 0.5 * (gap**2).sum(axis=1) / NOISE[0, 0]
        w = np.exp(logs - logs.max())
        levels = (np.arange(400) + 0.5) / 400
        picked = np.searchsorted(np.cumsum(w) / w.sum(), levels)
        out.append(here[np.minimum(picked, len(here) - 1)])
    return np.array(out)


def particle_bound(readings, members, see, noise, rng):
    """A bootstrap filter with many particles in the chart, (T, P, 2)."""
    x = members
    out = []
    for y in readings:
        x = chart.transition(x, 0.0, DT) + KICK * rng.standard_normal(x.shape)
        logs = -0.5 * ((see(x) - y) ** 2).sum(axis=1) / noise[0, 0]
        w = np.exp(logs - logs.max())
        x = x[resample(w / w.sum(), rng=rng)]
        out.append(x)
    return np.array(out)


def score(members: np.ndarray, truth: np.ndarray) -> float:
    """CRPS of one component, mean over time; of at most 200 members or a few more."""
    some = members[:, :: max(1, members.shape[1] // 200)]
    return float(np.mean([crps(m, t) for m, t in zip(some, truth, strict=True)]))


def scores(name, members, truth) -> dict[str, float]:
    """Of one filter's members, in the chart (T, N, 2) or Cartesian (T, N, 4)."""
    aim = place(truth)[LATE]
    own = members[LATE]
    flat = members.shape[-1] == 2
    states = place(own) if flat else own
    mean = states.mean(axis=1)
    if not np.isfinite(mean).all():
        return {f"{name}_{key}": np.nan for key in SCORES}
    missed = np.abs(np.hypot(mean[:, 0], mean[:, 1]) - LENGTH)
    if flat or "retracted" in name:
        mean = retract(mean, rod, motion=motion)
        missed = np.abs(np.hypot(mean[:, 0], mean[:, 1]) - LENGTH)
    missed = np.where(missed < 1e-14, 0.0, missed)  # rounding is no number to store
    gap = mean - aim
    q = own if flat else pendulum_chart(own)
    off = (q.mean(axis=1) - truth[LATE] + np.pi) % (2 * np.pi) - np.pi
    spread = q.std(axis=1, ddof=1)
    angle = np.sqrt((off[:, 0] ** 2).mean())
    found = {
        "constraint": np.sqrt((missed**2).mean()),
        "position": np.sqrt((gap[:, :2] ** 2).sum(axis=1).mean()),
        "velocity": np.sqrt((gap[:, 2:] ** 2).sum(axis=1).mean()),
        "honest": np.sqrt((spread[:, 0] ** 2).mean()) / angle,
        "nees": float(np.mean((off[:, 0] / np.maximum(spread[:, 0], 1e-12)) ** 2)),
        "crps": score(q[..., :1], truth[LATE, :1]),
    }
    return {f"{name}_{key}": float(value) for key, value in found.items()}


def case(noisy: bool, rng: np.random.Generator) -> dict[str, float]:
    """All filters on one run of the two cases with a whole position."""
    truth, seen, centre = data(rng, noisy)
    first = centre + setting["prior_std"] * rng.standard_normal((PARTICLES, 2))
    found = ensembles(
        CARTESIAN,
        place(first[:N]),
        cartesian,
        lambda x: x[:, :2],
        seen,
        NOISE,
        noisy,
        rng,
    )
    see = lambda q: place(q)[:, :2]  # noqa: E731
    found |= ensembles(CHART, first[:N], chart, see, seen, NOISE, noisy, rng)
    found["EKF_chart"] = extended(seen, centre, noisy, rng)
    found["bound"] = (
        particle_bound(seen, first, see, NOISE, rng)
        if noisy
        else grid_bound(seen, centre, rng)
    )
    out: dict[str, float] = {}
    for name in FILTERS:
        out |= scores(name, found[name], truth)
    return out


def mirror(rng: np.random.Generator) -> dict[str, float]:
    """CRPS of x when only its absolute value is seen, from a prior around the vertical."""
    truth, seen, _ = data(rng, True, MIRROR)
    readings = np.abs(seen[:, :1])
    noise = NOISE[:1, :1]
    first = MIRROR[0] + MIRROR[1] * rng.standard_normal((PARTICLES, 2))
    see = lambda q: np.abs(place(q)[:, :1])  # noqa: E731
    found = ensembles(MIRRORED, first[:N], chart, see, readings, noise, True, rng)
    found["bound"] = particle_bound(readings, first, see, noise, rng)
    x = place(truth)[LATE, :1]
    return {
        f"{name}_crps": score(place(q[LATE])[..., :1], x) for name, q in found.items()
    }


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """One run of every case."""
    streams = [np.random.default_rng(s) for s in seed.spawn(3)]
    cases = {
        "still": case(False, streams[0]),
        "noisy": case(True, streams[1]),
        "mirror": mirror(streams[2]),
    }
    return {
        f"{which}_{key}": v
        for which, found in cases.items()
        for key, v in found.items()
    }


def noisy_part(seed: np.random.SeedSequence) -> dict[str, float]:
    """The noisy case of a trial alone, which takes a fifth of its time."""
    found = case(True, np.random.default_rng(seed.spawn(3)[1]))
    return {f"noisy_{key}": value for key, value in found.items()}


SCORES = ("constraint", "position", "velocity", "honest", "nees", "crps")
parameters = {
    **{name: np.asarray(setting[name]).tolist() for name in setting},
    "bound_runs": RUNS,
    "particles": PARTICLES,
    "cells": CELLS,
    "reach": REACH,
    "mirror_prior": [v.tolist() for v in MIRROR],
}
columns = (
    *(f"{c}_{f}_{s}" for c in ("still", "noisy") for f in FILTERS for s in SCORES),
    *(f"mirror_{f}_crps" for f in (*MIRRORED, "bound")),
)
code = (
    data,
    ensembles,
    extended,
    paths,
    grid_bound,
    particle_bound,
    score,
    scores,
    case,
    mirror,
)
seeds = np.random.SeedSequence(4096).spawn(RUNS)
rtol = 1e-3
# Folded readings leave two swings, and which of them small ensembles keep hangs on the last bit.
max_outliers = 8
