"""How well can the pendulum be estimated? Cartesian filters, filters in the chart, and a bound.

Three cases. ``still`` has no process noise, as in the paper; ``noisy`` has some; in
``mirror`` the sensor measures only \\|x\\|, so that the posterior has two modes for ever.
All ensembles start on the manifold. The paper's filters have its printed input, those of
the study `pendulum`. True swings start from draws of the prior that every filter has, so
that the posterior's mean is the best estimate on average: the bound. That of ``still``
is a grid of initial conditions, that of the others particles in the chart.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from bookkit import studies
from distfilt.coupling import retract
from distfilt.metrics import crps
from distfilt.models import pendulum_angle, pendulum_chart, pendulum_states
from distfilt.updates import (
    enkf,
    etkf,
    etpf,
    resample,
    with_augmentation,
    with_projection,
    with_retraction,
)
from distfilt.validation import skip_validation

pendulum = studies.script("pendulum")

NAME = "pendulum-bound"
PAPER = "das"

scenarios = pendulum.scenarios
setting = pendulum.setting
RUNS = 32
PARTICLES = 4000
CELLS = 161
REACH = 0.45
DT = pendulum.DT
STEPS = pendulum.STEPS
TIMES = pendulum.TIMES
# Scores begin after the prior's offset has died out.
LATE = np.flatnonzero(TIMES > pendulum.SCORE_FROM + 1e-9)
LENGTH = setting["length"]
N = setting["members"]
START = np.array([np.deg2rad(setting["start_angle"]), setting["start_rate"]])
NOISE = pendulum.NOISE
KICK = np.array([setting["noise_position"], setting["noise_velocity"]])
PRIOR = (START, setting["prior_std"])
MIRROR = (np.array([0.0, 0.0]), np.array([0.8, 0.5]))

rod = pendulum.rod
motion = pendulum.MOTION
cartesian = pendulum.swing
# The same pendulum by its angle and rate, which have no constraint
chart = pendulum_angle(
    length=LENGTH,
    gravity=setting["gravity"],
    step=setting["integration_step"],
)
PAPERS = ("OTF", "OTMA", "OTNLeq", "OTNLeqMA")
# The same without a remedy and with both, for the square of the printed cost
augmented_etpf = with_augmentation(etpf, rod, std=setting["constraint_std"])
SQUARED = {
    "OTF_squared": etpf,
    "OTNLeqMA_squared": with_projection(augmented_etpf, rod, **pendulum.projection),
}
CARTESIAN = {
    **{name: pendulum.UPDATES[name] for name in PAPERS},
    **SQUARED,
    # Transport that is not the paper's has the squared distance too.
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


def draw_data(
    rng: np.random.Generator, noisy: bool, prior=PRIOR
) -> tuple[np.ndarray, ...]:
    """Draw true chart states (T, 2) and observations (T, 2); return the prior's mean too."""
    centre, std = prior
    state = centre + std * rng.standard_normal(2)
    truth = np.empty((STEPS, 2))
    for k in range(STEPS):
        # In the case without noise the draws are made all the same.
        state = chart.step(state, 0.0, DT) + noisy * KICK * rng.standard_normal(2)
        truth[k] = state
    noise = np.sqrt(NOISE[0, 0]) * rng.standard_normal((STEPS, 2))
    return truth, to_cartesian(truth)[:, :2] + noise, centre


def simulate_many(seeds) -> tuple[np.ndarray, np.ndarray]:
    """Draw many runs of the noisy case: true chart states and observations, (T, R, 2)."""
    generators = [np.random.default_rng(seed) for seed in seeds]
    # The draws of `draw_data`, in its order
    first = np.stack([rng.standard_normal(2) for rng in generators])
    kicks = np.empty((STEPS, len(generators), 2))
    for k in range(STEPS):
        kicks[k] = [rng.standard_normal(2) for rng in generators]
    errors = np.stack([rng.standard_normal((STEPS, 2)) for rng in generators], axis=1)
    state = PRIOR[0] + PRIOR[1] * first
    truth = np.empty((STEPS, len(generators), 2))
    for k in range(STEPS):
        state = chart.step(state, 0.0, DT) + KICK * kicks[k]
        truth[k] = state
    noise = np.sqrt(NOISE[0, 0]) * errors
    return truth, to_cartesian(truth)[..., :2] + noise


def run_ensembles(updates, members, model, predict, observations, noise, noisy, rng):
    """Return analysis members of filters with one model, {name: (T, N, d)}."""
    x = np.stack([members] * len(updates))
    analysis = np.full((STEPS, *x.shape), np.nan)
    # Positions come before velocities, in both kinds of states.
    kick = np.repeat(KICK, x.shape[-1] // 2)
    with skip_validation(), np.errstate(all="ignore"):
        for k, y in enumerate(observations):
            x = model.transition(x, 0.0, DT)
            # The same process noise for all filters
            if noisy:
                x = x + kick * rng.standard_normal(x.shape[1:])
            for f, update in enumerate(updates.values()):
                if not np.isfinite(x[f]).all():
                    continue
                try:
                    x[f] = update(x[f], predict(x[f]), y, noise, rng=rng)
                except (ValueError, RuntimeError, ArithmeticError):
                    # A swing that is lost may overflow, or have no coupling.
                    x[f] = np.nan
            analysis[k] = x
    return dict(zip(updates, np.moveaxis(analysis, 1, 0), strict=True))


def run_ekf(observations, centre, noisy, rng):
    """Run the extended Kalman filter in the chart; draws of its Gaussian stand for members."""
    m = centre
    p = setting["prior_std"] ** 2 * np.eye(2)
    draws_over_time = []
    draws = rng.standard_normal((N, 2))
    # Draws with mean zero and unit sample covariance
    anomalies = draws - draws.mean(axis=0)
    draws = np.linalg.solve(np.linalg.cholesky(np.cov(draws.T)), anomalies.T).T
    for y in observations:
        # F P F' + Q
        f = chart.jacobian(m, 0.0, DT)
        m = chart.step(m, 0.0, DT)
        p = f @ p @ f.T + noisy * np.diag(KICK**2)
        # Jacobian of the position in the angle
        h = LENGTH * np.array([[np.cos(m[0]), 0.0], [-np.sin(m[0]), 0.0]])
        gain = np.linalg.solve(h @ p @ h.T + NOISE, h @ p).T
        m = m + gain @ (y - to_cartesian(m)[:2])
        # (I - K H) P, made symmetric
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
    offsets = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1)
    grid = START + offsets.reshape(-1, 2)
    x = grid
    # Single precision halves the memory; the grid is coarser by far.
    path = np.empty((STEPS, len(grid), 2), dtype=np.float32)
    for k in range(STEPS):
        x = chart.transition(x.copy(), 0.0, DT)
        path[k] = x
    CACHE[CELLS] = grid, path
    return grid, path


def grid_bound(observations, centre):
    """Draw from the posterior of the motion without noise, (T, 400, 2)."""
    grid, path = motion_grid()
    # Initial conditions far outside the prior are left out.
    logs = -0.5 * ((grid - centre) ** 2).sum(axis=1) / setting["prior_std"] ** 2
    likely = np.flatnonzero(logs > -18)
    logs = logs[likely]
    draws = []
    for k, y in enumerate(observations):
        states = path[k, likely].astype(np.float64)
        angle = states[:, 0]
        residual = LENGTH * np.column_stack([np.sin(angle), np.cos(angle)]) - y
        # log p(x_0) plus the logarithms of all likelihoods so far
        logs = logs - 0.5 * (residual**2).sum(axis=1) / NOISE[0, 0]
        w = np.exp(logs - logs.max())
        # Quantiles of the weights: 400 draws without chance
        levels = (np.arange(400) + 0.5) / 400
        indices = np.searchsorted(np.cumsum(w) / w.sum(), levels)
        draws.append(states[np.minimum(indices, len(states) - 1)])
    return np.array(draws)


def particle_bound(observations, members, predict, noise, rng):
    """Run a bootstrap filter with many particles in the chart, (T, P, 2)."""
    x = members
    draws = []
    for y in observations:
        # Its process noise separates copies, so no jitter is needed.
        x = chart.transition(x, 0.0, DT) + KICK * rng.standard_normal(x.shape)
        logs = -0.5 * ((predict(x) - y) ** 2).sum(axis=1) / noise[0, 0]
        w = np.exp(logs - logs.max())
        x = x[resample(w / w.sum(), rng=rng)]
        draws.append(x)
    return np.array(draws)


def mean_crps(members: np.ndarray, truth: np.ndarray) -> float:
    """Return the CRPS of one component, mean over time, of about 200 members at most."""
    thinned = members[:, :: max(1, members.shape[1] // 200)]
    return float(np.mean([crps(m, t) for m, t in zip(thinned, truth, strict=True)]))


def score(name, members, truth) -> dict[str, float]:
    """Return the scores of one filter's members, in the chart (T, N, 2) or Cartesian (T, N, 4)."""
    target = to_cartesian(truth)[LATE]
    late_members = members[LATE]
    in_chart = members.shape[-1] == 2
    states = to_cartesian(late_members) if in_chart else late_members
    mean = states.mean(axis=1)
    if not np.isfinite(mean).all():
        return {f"{name}_{key}": np.nan for key in SCORES}
    # The mean of members on the circle is inside, so it is put back for the report.
    if in_chart or "retracted" in name:
        mean = retract(mean, rod, motion=motion)
    length_error = pendulum.measure_length_error(mean)
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
        "spread_ratio": np.sqrt((spread[:, 0] ** 2).mean()) / angle,
        "nees": float(
            np.mean((chart_error[:, 0] / np.maximum(spread[:, 0], 1e-12)) ** 2)
        ),
        "crps": mean_crps(q[..., :1], truth[LATE, :1]),
    }
    return {f"{name}_{key}": float(value) for key, value in values.items()}


def predict_position(q: np.ndarray) -> np.ndarray:
    """Return the position of chart states."""
    return to_cartesian(q)[:, :2]


def predict_size(q: np.ndarray) -> np.ndarray:
    """Return |x| of chart states."""
    return np.abs(to_cartesian(q)[:, :1])


def run_case(noisy: bool, rng: np.random.Generator) -> dict[str, float]:
    """Run all filters once, in a case whose whole position is observed."""
    truth, observations, centre = draw_data(rng, noisy)
    first = centre + setting["prior_std"] * rng.standard_normal((PARTICLES, 2))
    analysis = run_ensembles(
        CARTESIAN,
        to_cartesian(first[:N]),
        cartesian,
        lambda x: x[:, :2],
        observations,
        NOISE,
        noisy,
        rng,
    )
    # The same first members and observations in the chart
    analysis |= run_ensembles(
        CHART, first[:N], chart, predict_position, observations, NOISE, noisy, rng
    )
    analysis["EKF_chart"] = run_ekf(observations, centre, noisy, rng)
    if noisy:
        bound = particle_bound(observations, first, predict_position, NOISE, rng)
    else:
        bound = grid_bound(observations, centre)
    analysis["bound"] = bound
    values: dict[str, float] = {}
    for name in FILTERS:
        values |= score(name, analysis[name], truth)
    return values


def run_mirror(rng: np.random.Generator) -> dict[str, float]:
    """Return the CRPS of x when only |x| is observed, from a prior about the vertical."""
    truth, observations, _ = draw_data(rng, True, MIRROR)
    # Only |x| is measured.
    sizes = np.abs(observations[:, :1])
    noise = NOISE[:1, :1]
    # About the vertical both swings are equally likely.
    first = MIRROR[0] + MIRROR[1] * rng.standard_normal((PARTICLES, 2))
    analysis = run_ensembles(
        MIRRORED, first[:N], chart, predict_size, sizes, noise, True, rng
    )
    analysis["bound"] = particle_bound(sizes, first, predict_size, noise, rng)
    x = to_cartesian(truth)[LATE, :1]
    return {
        f"{name}_crps": mean_crps(to_cartesian(q[LATE])[..., :1], x)
        for name, q in analysis.items()
    }


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Run every case once."""
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
    """Run the noisy case of a trial alone, which takes a part of its time."""
    values = run_case(True, np.random.default_rng(seed.spawn(3)[1]))
    return {f"noisy_{key}": value for key, value in values.items()}


SCORES = ("constraint", "position", "velocity", "spread_ratio", "nees", "crps")
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
    draw_data,
    run_ensembles,
    run_ekf,
    motion_grid,
    grid_bound,
    particle_bound,
    mean_crps,
    score,
    run_case,
    run_mirror,
)
seeds = np.random.SeedSequence(4096).spawn(RUNS)
rtol = 1e-3
# Folded observations leave two swings; the last bit decides which one a small ensemble keeps.
max_outliers = 6
