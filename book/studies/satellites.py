"""Satellites of SGP4 tracked with a model of two bodies and oblateness, by two observers.

The truth is the motion that SGP4 gives the element sets of its own verification file, all shifted
to one epoch. A target is observed by directions from two others on high orbits, whose places are
known. The filter's model has no drag, no Sun, no Moon and no harmonics beyond J2: white
acceleration of strength sigma stands for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from importlib.resources import files

import numpy as np
from sgp4.api import Satrec

from distfilt import filters, network
from distfilt.models import Model, occulted, orbit, rsw_frame
from distfilt.sensors import Sensor

NAME = "satellites"
PAPER = "together"

STEP = 1200.0
HOURS = 24
ANGLE_STD = 2e-5  # rad
PRIOR_STD = (5.0, 5.0)  # km, m/s
# Strengths of the process noise, m/s^(3/2)
SIGMAS = {"none": 0.0, "low": 1e-4, "middle": 1e-3, "high": 1e-2, "highest": 1e-1}
ROWS = ("alone", "intersection", "all")
# Element sets that orbit for a day above the atmosphere, with a period of at most a week
LOWEST = 120.0
LONGEST = 7 * 1440.0
# Scores are averaged from here on, in h.
AFTER = 6.0
# Observers are nearly circular and far out.
OBSERVERS = (9998, 14128, 24208, 25954, 26900, 28129, 28626)
TIMES = STEP * np.arange(round(HOURS * 3600 / STEP) + 1)


def read_elements() -> dict[int, Satrec]:
    """Return the satellites of the verification file that fit the study, by number."""
    lines = (files("sgp4") / "SGP4-VER.TLE").read_text().splitlines()
    satellites = {}
    orbits = set()
    for first, second in zip(lines[:-1], lines[1:], strict=True):
        if not (first.startswith("1 ") and second.startswith("2 ")):
            continue
        # Behind column 69 the file has times for its own test.
        satellite = Satrec.twoline2rv(first[:69], second[:69])
        period = 2 * np.pi / satellite.no_kozai
        errors, states = move(satellite, TIMES)
        height = np.linalg.norm(states[:, :3], axis=1).min() - orbit.RADIUS
        # The file has some satellites twice, under other numbers too.
        elements = (satellite.no_kozai, satellite.mo)
        if elements in orbits or errors.any():
            continue
        if height > LOWEST and period < LONGEST:
            satellites[satellite.satnum] = satellite
            orbits.add(elements)
    return satellites


def move(satellite: Satrec, times):
    """Return SGP4's errors (T,) and states (T, 6), in km and m/s, after its epoch."""
    days = np.full(len(times), satellite.jdsatepoch)
    fractions = satellite.jdsatepochF + times / 86400
    errors, positions, velocities = satellite.sgp4_array(days, fractions)
    return errors, np.concatenate([positions, 1e3 * velocities], axis=1)


def transition(x, t, dt):
    """Move states (..., 6) by two bodies and oblateness."""
    return orbit.propagate(x, dt, longest=300.0)


def derivative(x, t, dt):
    """Derivative of the transition by central differences, (..., 6, 6)."""
    shifts = 1e-2 * np.eye(6)
    states = x[..., None, :]
    ends = transition(np.stack([states + shifts, states - shifts]), t, dt)
    return np.swapaxes((ends[0] - ends[1]) / 2e-2, -1, -2)


def noise_cov(t, dt, sigma):
    """Covariance of white acceleration, σ² [dt³/3, dt²/2; dt²/2, dt], in km and m/s."""
    block = np.array([[1e-6 * dt**3 / 3, 1e-3 * dt**2 / 2], [1e-3 * dt**2 / 2, dt]])
    return sigma**2 * np.kron(block, np.eye(3))


def direction(x, place):
    """Right ascension and declination of states (..., 6) from a place."""
    offset = x[..., :3] - place
    declination = np.arcsin(offset[..., 2] / np.linalg.norm(offset, axis=-1))
    ascension = np.arctan2(offset[..., 1], offset[..., 0])
    return np.stack([ascension, declination], axis=-1)


def observe(truth, places, rng):
    """Return the events of both observers (2, T, 3) where the Earth is not between."""
    events = []
    for agent, path in enumerate(places):
        for t, x, place in zip(TIMES[1:], truth[1:], path[1:], strict=True):
            noise = ANGLE_STD * rng.standard_normal(2)
            if occulted(x[:3], place):
                continue
            sensor = Sensor(
                2,
                partial(direction, place=place),
                ANGLE_STD**2 * np.eye(2),
                periods=(2 * np.pi, None),
                kind="direction",
            )
            value = direction(x, place) + noise
            events.append(filters.Observation(t, agent, value, sensor))
    return events


def make_filter(row: str, sigma: float) -> filters.GaussianFilter:
    """Return the filter of a row with a strength of the process noise."""
    noise = partial(noise_cov, sigma=sigma)
    model = Model(6, transition, noise, derivative=derivative)
    rules = {
        "alone": {"share_observations": False},
        "intersection": {
            "share_observations": False,
            "fusion": network.covariance_intersection,
        },
        "all": {"share_observations": True},
    }
    graph = network.graphs.complete(2)
    return filters.GaussianFilter(model, [None, None], graph, **rules[row])


def score(run, truth) -> dict[str, float]:
    """Return position error and NEES a component after the first hours."""
    late = run["time"].values >= 3600 * AFTER
    steps = np.rint(run["time"].values[late] / STEP).astype(int)
    error = run["mean"].values[late] - truth[steps, None]
    cov = run["covariance"].values[late]
    weighted = np.linalg.solve(cov, error[..., None])[..., 0]
    return {
        "rmse": float(np.sqrt((error[..., :3] ** 2).sum(axis=-1).mean())),
        "nees": float((error * weighted).sum(axis=-1).mean()) / 6,
    }


def run_filters(truth, places, rng, rows) -> dict[str, float]:
    """Return the scores of some rows, with all strengths, on one pair's observations."""
    events = observe(truth, places, rng)
    std = np.repeat(PRIOR_STD, 3)
    mean = truth[0] + std * rng.standard_normal(6)
    values = {}
    for row in rows:
        for name, sigma in SIGMAS.items():
            f = make_filter(row, sigma)
            start = f.start((mean, np.diag(std**2)))
            try:
                scores = score(f.run(start, TIMES[1:], events), truth)
            except filters.FilterError:
                # The estimate has left the region in which the model is defined.
                scores = {"rmse": 1e6, "nees": 1e6}
            values |= {f"{row}_{name}_{key}": v for key, v in scores.items()}
    return values


def trial(seed: np.random.SeedSequence, rows: Sequence[str] = ROWS) -> dict[str, float]:
    """Scores of one target of SGP4, and of the same target in the filter's own motion."""
    satellites = read_elements()
    numbers = sorted(satellites)
    number = numbers[seed.spawn_key[-1] % len(numbers)]
    rng = np.random.default_rng(seed)
    pair = rng.choice([k for k in OBSERVERS if k != number], 2, replace=False)
    places = [move(satellites[k], TIMES)[1][:, :3] for k in pair.tolist()]
    truth = move(satellites[number], TIMES)[1]
    model_truth = [truth[0]]
    for _ in TIMES[1:]:
        model_truth.append(transition(model_truth[-1], 0.0, STEP))
    model_truth = np.array(model_truth)
    miss = (truth - model_truth)[-1, :3] @ rsw_frame(truth[-1])
    one_step = transition(truth[:-1], 0.0, STEP)[:, 3:] - truth[1:, 3:]
    own, other = rng.spawn(2)
    values = {
        "number": float(number),
        "period": 2 * np.pi / satellites[number].no_kozai,
        "eccentricity": satellites[number].ecco,
        "height": np.linalg.norm(truth[:, :3], axis=1).min() - orbit.RADIUS,
        "miss": float(np.linalg.norm(miss)),
        "kick": float(np.sqrt((one_step**2).sum(axis=1).mean())),
    }
    values |= run_filters(truth, places, own, rows)
    # The control: the same orbit by the filter's own model.
    f = make_filter("all", 0.0)
    std = np.repeat(PRIOR_STD, 3)
    mean = truth[0] + std * other.standard_normal(6)
    events = observe(model_truth, places, other)
    run = f.run(f.start((mean, np.diag(std**2))), TIMES[1:], events)
    control = score(run, model_truth)
    values |= {f"control_{key}": value for key, value in control.items()}
    return {name: float(f"{value:.6g}") for name, value in values.items()}


columns = ["number", "period", "eccentricity", "height", "miss", "kick"]
columns += [f"{r}_{s}_{m}" for r in ROWS for s in SIGMAS for m in ("rmse", "nees")]
columns += ["control_rmse", "control_nees"]
parameters = {
    "step": STEP,
    "hours": HOURS,
    "after": AFTER,
    "angle_std": ANGLE_STD,
    "prior_std": PRIOR_STD,
    "sigmas": SIGMAS,
    "lowest": LOWEST,
    "longest": LONGEST,
    "observers": OBSERVERS,
}
code = [read_elements, move, transition, derivative, noise_cov, direction, observe]
code += [make_filter, score, run_filters]
seeds = np.random.SeedSequence(1402).spawn(23)
rtol = 1e-3
