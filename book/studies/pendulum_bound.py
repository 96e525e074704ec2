"""How well can the pendulum be known? Cartesian filters, filters in the chart, and a bound.

Three cases. ``still`` has no process noise, as in the paper; ``noisy`` has some; in
``mirror`` the sensor sees only \\|x\\|, so that the posterior has two modes for ever.
All ensembles start on the manifold. True swings start from draws of the prior that
every filter is given, so that the posterior's mean is the best estimate on average: the
bound. That of ``still`` is a grid of initial conditions, that of the others particles
in the chart.
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
augmented_etpf = with_augmentation(etpf, rod, std=setting["constraint_std"])
how = {"variant": setting["variant"], "regularisation": setting["regularisation"]}
CARTESIAN = {
    "OTF": etpf,
    "OTMA": augmented_etpf,
    "OTNLeq": with_projection(etpf, rod, **how),
    "OTNLeqMA": with_projection(augmented_etpf, rod, **how),
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


def to_cartesian(q: np.ndarray) -> np.ndarray:
    """Cartesian states of chart coordinates."""
    return pendulum_states(q, length=LENGTH)


def data(rng: np.random.Generator, noisy: bool, prior=PRIOR) -> tuple[np.ndarray, ...]:
    """Draw true chart states (T, 2) and observations (T, 2); return the prior's mean too."""
    centre, std = prior
    state = centre + std * rng.standard_normal(2)
    truth = np.empty((STEPS, 2))
    for k in range(STEPS):
        state = chart.step(state, 0.0, DT) + noisy * KICK * rng.standard_normal(2)
        truth[k] = state
    seen = to_cartesian(truth)[:, :2] + np.sqrt(NOISE[0, 0]) * rng.standard_normal(
        (STEPS, 2)
    )
    return truth, seen, centre


def simulate_many(seeds) -> tuple[np.ndarray, np.ndarray]:
    """Draw many runs of the noisy case: true chart states and observations, (T, R, 2)."""
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
    return truth, to_cartesian(truth)[..., :2] + np.sqrt(NOISE[0, 0]) * errors.swapaxes(
        0, 1
    )


def run_ensembles(updates, members, model, see, readings, noise, noisy, rng):
    """Analysis members of filters with one model, {name: (T, N, d)}."""
    inner = {name: update for name, update in updates.items()}
    x = np.stack([members] * len(inner))
    analysis = np.full((STEPS, *x.shape), np.nan)
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
            analysis[k] = x
    return dict(zip(inner, np.moveaxis(analysis, 1, 0), strict=True))


def run_ekf(readings, centre, noisy, rng):
    """Run the extended Kalman filter in the chart; draws of its Gaussian stand for members."""
    m = centre
    p = setting["prior_std"] ** 2 * np.eye(2)
    draws_over_time = []
    draws = rng.standard_normal((N, 2))
    # Draws with mean zero and unit sample covariance
    draws = (draws - draws.mean(axis=0)) @ np.linalg.inv(
        np.linalg.cholesky(np.cov(draws.T))
    ).T
    for y in readings:
        f = chart.jacobian(m, 0.0, DT)
        m = chart.step(m, 0.0, DT)
        p = f @ p @ f.T + noisy * np.diag(KICK**2)
        # Jacobian of the position in the angle
        h = LENGTH * np.array([[np.cos(m[0]), 0.0], [-np.sin(m[0]), 0.0]])
        gain = np.linalg.solve(h @ p @ h.T + NOISE, h @ p).T
        m = m + gain @ (y - to_cartesian(m)[:2])
        p = (np.eye(2) - gain @ h) @ p
        p = 0.5 * (p + p.T)
        draws_over_time.append(m + draws @ np.linalg.cholesky(p).T)
    return np.array(draws_over_time)


CACHE: dict[int, tuple[np.ndarray, np.ndarray]] = {}
"""Results of `motion_grid`. A function with a cache could not be sent to a worker."""


def motion_grid() -> tuple[np.ndarray, np.ndarray]:
    """A grid of initial conditions (G, 2), and where each is at every time, (T, G, 2)."""
    if CELLS in CACHE:
        return CACHE[CELLS]
    side = REACH * np.linspace(-1, 1, CELLS)
    grid = START + np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    x = grid
    path = np.empty((STEPS, len(grid), 2), dtype=np.float32)
    for k in range(STEPS):
        x = path[k] = chart.transition(x.copy(), 0.0, DT)
    CACHE[CELLS] = grid, path
    return grid, path


def grid_bound(readings, centre, rng):
    """Draw from the posterior of the motion without noise, (T, 400, 2)."""
    grid, path = motion_grid()
    # Initial conditions far outside the prior are left out.
    logs = -0.5 * ((grid - centre) ** 2).sum(axis=1) / setting["prior_std"] ** 2
    likely = np.flatnonzero(logs > -18)
    logs = logs[likely]
    draws = []
    for k, y in enumerate(readings):
        states = path[k, likely].astype(np.float64)
        residual = (
            LENGTH * np.column_stack([np.sin(states[:, 0]), np.cos(states[:, 0])]) - y
        )
        logs = logs - 0.5 * (residual**2).sum(axis=1) / NOISE[0, 0]
        w = np.exp(logs - logs.max())
        # Quantiles of the weights: 400 draws without chance
        levels = (np.arange(400) + 0.5) / 400
        indices = np.searchsorted(np.cumsum(w) / w.sum(), levels)
        draws.append(states[np.minimum(indices, len(states) - 1)])
    return np.array(draws)


def particle_bound(readings, members, see, noise, rng):
    """Run a bootstrap filter with many particles in the chart, (T, P, 2)."""
    x = members
    draws = []
    for y in readings:
        x = chart.transition(x, 0.0, DT) + KICK * rng.standard_normal(x.shape)
        logs = -0.5 * ((see(x) - y) ** 2).sum(axis=1) / noise[0, 0]
        w = np.exp(logs - logs.max())
        x = x[resample(w / w.sum(), rng=rng)]
        draws.append(x)
    return np.array(draws)


def mean_crps(members: np.ndarray, truth: np.ndarray) -> float:
    """Return the CRPS of one component, mean over time, of about 200 members at most."""
    thinned = members[:, :: max(1, members.shape[1] // 200)]
    return float(np.mean([crps(m, t) for m, t in zip(thinned, truth, strict=True)]))


def scores(name, members, truth) -> dict[str, float]:
    """Return the scores of one filter's members, in the chart (T, N, 2) or Cartesian (T, N, 4)."""
    target = to_cartesian(truth)[LATE]
    late_members = members[LATE]
    in_chart = members.shape[-1] == 2
    states = to_cartesian(late_members) if in_chart else late_members
    mean = states.mean(axis=1)
    if not np.isfinite(mean).all():
        return {f"{name}_{key}": np.nan for key in SCORES}
    length_error = np.abs(np.hypot(mean[:, 0], mean[:, 1]) - LENGTH)
    if in_chart or "retracted" in name:
        mean = retract(mean, rod, motion=motion)
        length_error = np.abs(np.hypot(mean[:, 0], mean[:, 1]) - LENGTH)
    length_error = np.where(
        length_error < 1e-14, 0.0, length_error
    )  # rounding is no number to store
    error = mean - target
    q = late_members if in_chart else pendulum_chart(late_members)
    # The angle's error, wrapped to (-π, π]
    chart_error = (q.mean(axis=1) - truth[LATE] + np.pi) % (2 * np.pi) - np.pi
    spread = q.std(axis=1, ddof=1)
    angle = np.sqrt((chart_error[:, 0] ** 2).mean())
    values = {
        "constraint": np.sqrt((length_error**2).mean()),
        "position": np.sqrt((error[:, :2] ** 2).sum(axis=1).mean()),
        "velocity": np.sqrt((error[:, 2:] ** 2).sum(axis=1).mean()),
        "honest": np.sqrt((spread[:, 0] ** 2).mean()) / angle,
        "nees": float(
            np.mean((chart_error[:, 0] / np.maximum(spread[:, 0], 1e-12)) ** 2)
        ),
        "crps": mean_crps(q[..., :1], truth[LATE, :1]),
    }
    return {f"{name}_{key}": float(value) for key, value in values.items()}


def run_case(noisy: bool, rng: np.random.Generator) -> dict[str, float]:
    """Run all filters once, in a case whose whole position is observed."""
    truth, seen, centre = data(rng, noisy)
    first = centre + setting["prior_std"] * rng.standard_normal((PARTICLES, 2))
    analysis = run_ensembles(
        CARTESIAN,
        to_cartesian(first[:N]),
        cartesian,
        lambda x: x[:, :2],
        seen,
        NOISE,
        noisy,
        rng,
    )
    see = lambda q: to_cartesian(q)[:, :2]  # noqa: E731
    analysis |= run_ensembles(CHART, first[:N], chart, see, seen, NOISE, noisy, rng)
    analysis["EKF_chart"] = run_ekf(seen, centre, noisy, rng)
    analysis["bound"] = (
        particle_bound(seen, first, see, NOISE, rng)
        if noisy
        else grid_bound(seen, centre, rng)
    )
    values: dict[str, float] = {}
    for name in FILTERS:
        values |= scores(name, analysis[name], truth)
    return values


def run_mirror(rng: np.random.Generator) -> dict[str, float]:
    """Return the CRPS of x when only |x| is observed, from a prior about the vertical."""
    truth, seen, _ = data(rng, True, MIRROR)
    readings = np.abs(seen[:, :1])
    noise = NOISE[:1, :1]
    first = MIRROR[0] + MIRROR[1] * rng.standard_normal((PARTICLES, 2))
    see = lambda q: np.abs(to_cartesian(q)[:, :1])  # noqa: E731
    analysis = run_ensembles(
        MIRRORED, first[:N], chart, see, readings, noise, True, rng
    )
    analysis["bound"] = particle_bound(readings, first, see, noise, rng)
    x = to_cartesian(truth)[LATE, :1]
    return {
        f"{name}_crps": mean_crps(to_cartesian(q[LATE])[..., :1], x)
        for name, q in analysis.items()
    }


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """One run of every case."""
    streams = [np.random.default_rng(s) for s in seed.spawn(3)]
    cases = {
        "still": run_case(False, streams[0]),
        "noisy": run_case(True, streams[1]),
        "mirror": run_mirror(streams[2]),
    }
    return {
        f"{name}_{key}": v
        for name, values in cases.items()
        for key, v in values.items()
    }


def noisy_part(seed: np.random.SeedSequence) -> dict[str, float]:
    """The noisy case of a trial alone, which takes a fifth of its time."""
    values = run_case(True, np.random.default_rng(seed.spawn(3)[1]))
    return {f"noisy_{key}": value for key, value in values.items()}


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
    run_ensembles,
    run_ekf,
    motion_grid,
    grid_bound,
    particle_bound,
    mean_crps,
    scores,
    run_case,
    run_mirror,
)
seeds = np.random.SeedSequence(4096).spawn(RUNS)
rtol = 1e-3
# Folded observations leave two swings; the last bit decides which one a small ensemble keeps.
max_outliers = 8
