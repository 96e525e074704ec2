"""Two satellites find a third one and themselves: the study behind chapter 8.

A trial draws one truth and one set of readings, and runs every filter on them. Epochs are the
paper's, 2 to 10 h and 20 to 24 h; each epoch's readings are followed by one exchange.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from distfilt.filters.mixture import MixtureFilter
from distfilt.mixtures import GaussianMixture, PartialFusion, average, fuse, fuse_moments, runnalls
from distfilt.models.orbit import orbits, rsw_frame
from distfilt.network import graphs
from distfilt.published import scenario
from distfilt.sensors import stack
from distfilt.sensors.orbital import ephemeris, line_of_sight

NAME = "orbit"
PAPER = "semeraro"

TABLE = scenario("semeraro", "table-3").reading()
HOURS = tuple(int(h) for h in TABLE["hours"])
ARCSECOND = np.pi / 180 / 3600
SETTING = {
    **{name: TABLE[name].tolist() for name in (
        "target", "agent_1", "agent_2", "target_std", "agent_std")},
    "angle_std": TABLE["angle_std"], "fix_std": TABLE["fix_std"].tolist(),
    "noise_std": TABLE["noise_std"].tolist(),
    "form": TABLE["form"], "first_angle": HOURS[0], "fix_at": TABLE["fix_at"], "widen": 1.0,
}
LATE = {
    **SETTING, "first_angle": TABLE["late_first_angle"], "fix_at": 0,
    "widen": TABLE["late_widen"],
}


def lean(own: GaussianMixture, heard: list[GaussianMixture]) -> GaussianMixture:
    """Matched terms with C2, what is heard being reduced to six mixands for the shapes."""
    exact = PartialFusion(own, heard)
    few = [runnalls(m, 6) for m in heard]
    return exact.weigh(exact.shapes(received=few), rule="C2")


SCALE = np.tile([1, 1, 1, 6.8, 6.8, 6.8], 2)
SPLITS = {"stretch": TABLE["stretch"], "scale": SCALE}
KEPT = {"size": TABLE["mixands"], "most": TABLE["mixands"]}
LATE_KEPT = {"size": TABLE["late_mixands"], "most": TABLE["late_mixands"]}
ROWS = {
    "none": {**SPLITS, **KEPT},
    "matched": {**SPLITS, **KEPT, "agreement": partial(fuse, rule="C2")},
    "one_none": {"size": 1, "most": 1},
    "one_ci": {"size": 1, "most": 1, "agreement": fuse_moments},
    "average": {**SPLITS, **KEPT,
                "agreement": lambda own, heard: average(own, heard[0])},
}
LATE_ROWS = {
    "none": {**SPLITS, **LATE_KEPT},
    "matched": {**SPLITS, **LATE_KEPT, "agreement": lean},
    "one_none": {"size": 1, "most": 1},
    "one_ci": {"size": 1, "most": 1, "agreement": fuse_moments},
}
METRICS = ("tp1", "tp2", "ep1", "ep2", "tv", "ev", "nees")


def sensors(s: dict) -> list:
    """Each agent's: two angles of the target, then the target's full state."""
    fix = ephemeris(position_std=s["fix_std"][0], velocity_std=s["fix_std"][1])
    eye = line_of_sight(std=s["angle_std"] * ARCSECOND, form=s["form"])
    return [stack([eye, fix])] * 2


def data(s: dict, rng: np.random.Generator) -> tuple:
    """Truth (8, 18), readings (8, 2, 8) with NaN where there is none, and the first beliefs."""
    start = np.concatenate([s["target"], s["agent_1"], s["agent_2"]])
    stds = [np.array(s["target_std"]) * s["widen"], np.array(s["agent_std"])]
    covs, gaps = [], []
    for k, std in enumerate((stds[0], stds[1], stds[1])):
        frame = np.kron(np.eye(2), rsw_frame(start[6 * k : 6 * k + 6]))
        root = frame * std
        covs.append(root @ root.T)
        gaps.append(root @ rng.standard_normal(6))
    first = start + np.concatenate(gaps)
    model = orbits(3, position_std=s["noise_std"][0], velocity_std=s["noise_std"][1])
    truth, x, t = [], start, 0.0
    for hour in HOURS:
        x = model.sample_step(x, t, 3600.0 * hour - t, rng=rng)
        truth.append(x)
        t = 3600.0 * hour
    truth = np.array(truth)
    seen = np.full((len(HOURS), 2, 8), np.nan)
    eye = line_of_sight(std=s["angle_std"] * ARCSECOND, form=s["form"])
    for k, hour in enumerate(HOURS):
        fix = truth[k, :6] + rng.standard_normal(6) * np.repeat(s["fix_std"], 3)
        for a in (0, 1):
            own = np.concatenate([truth[k, :6], truth[k, 6 + 6 * a : 12 + 6 * a]])
            angles = eye.predict(own) + s["angle_std"] * ARCSECOND * rng.standard_normal(2)
            if hour >= s["first_angle"]:
                seen[k, a, :2] = angles
            if hour == s["fix_at"]:
                seen[k, a, 2:] = fix
    return truth, seen, first, covs


def block(parts: list) -> np.ndarray:
    """Block diagonal of 6 by 6 matrices."""
    out = np.zeros((6 * len(parts), 6 * len(parts)))
    for k, part in enumerate(parts):
        out[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = part
    return out


def beliefs(first: np.ndarray, covs: list) -> list[GaussianMixture]:
    """Each agent's first belief about [target; ego]; the error about the target is shared."""
    return [
        GaussianMixture.gaussian(
            np.concatenate([first[:6], first[6 + 6 * a : 12 + 6 * a]]),
            block([covs[0], covs[1 + a]]),
        )
        for a in (0, 1)
    ]


def scored(mixtures: list, truth: np.ndarray) -> list[float]:
    """The metrics of one epoch: squared errors in km² and (m/s)², NEES per component."""
    out: list[float] = []
    t, e, speed, nees = [], [], [], []
    for a, belief in enumerate(mixtures):
        mean, cov = belief.moments()
        gap = mean - np.concatenate([truth[:6], truth[6 + 6 * a : 12 + 6 * a]])
        t.append(float(gap[:3] @ gap[:3]))
        e.append(float(gap[6:9] @ gap[6:9]))
        speed.append([gap[3:6] @ gap[3:6], gap[9:] @ gap[9:]])
        unit = np.sqrt(np.diag(cov))
        nees.append(gap / unit @ np.linalg.solve(cov / np.outer(unit, unit), gap / unit) / 12)
    out += [*t, *e, *np.mean(speed, axis=0), float(np.mean(nees))]
    return [float(v) for v in out]


def network(s: dict, options: dict) -> MixtureFilter:
    """A row's filter."""
    model = orbits(2, position_std=s["noise_std"][0], velocity_std=s["noise_std"][1])
    return MixtureFilter(
        [model] * 2, sensors(s), graphs.path(2), target_dim=6, names=("1", "2"), **options
    )


def run(s: dict, options: dict, seen: np.ndarray, first: np.ndarray, covs: list) -> list:
    """The states of a row's filter, one an epoch."""
    f = network(s, options)
    state, out = f.start(beliefs(first, covs)), []
    for k, hour in enumerate(HOURS):
        state = f.step(state, 3600.0 * hour, list(seen[k]))
        out.append(state)
    return out


def bound(s: dict, seen: np.ndarray, first: np.ndarray, covs: list) -> list:
    """One joint filter of all three bodies with everybody's readings, as pairs of marginals."""
    eye = {"std": s["angle_std"] * ARCSECOND, "form": s["form"]}
    fix = ephemeris(position_std=s["fix_std"][0], velocity_std=s["fix_std"][1])
    both = stack([line_of_sight(observer=6, **eye), line_of_sight(observer=12, **eye), fix])
    model = orbits(3, position_std=s["noise_std"][0], velocity_std=s["noise_std"][1])
    f = MixtureFilter([model], [both], target_dim=6, size=1, most=1)
    state, out = f.start([GaussianMixture.gaussian(first, block(covs))]), []
    for k, hour in enumerate(HOURS):
        y = np.concatenate([seen[k, 0, :2], seen[k, 1, :2], seen[k, 0, 2:]])
        state = f.step(state, 3600.0 * hour, [y])
        joint = state.mixtures[0]
        out.append([joint.marginal([*range(6), *range(6 + 6 * a, 12 + 6 * a)]) for a in (0, 1)])
    return out


def study(s: dict, rows: dict, seed: np.random.SeedSequence, prefix: str) -> dict[str, float]:
    """All rows of one scenario on one set of data."""
    truth, seen, first, covs = data(s, np.random.default_rng(seed))
    found = {name: [state.mixtures for state in run(s, options, seen, first, covs)]
             for name, options in rows.items()}
    found["bound"] = bound(s, seen, first, covs)
    out = {}
    for name, pairs in found.items():
        for k, hour in enumerate(HOURS):
            values = scored(pairs[k], truth[k])
            out |= {f"{prefix}{name}_{hour}_{m}": v for m, v in zip(METRICS, values, strict=True)}
    return out


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """The paper's scenario and the late one."""
    first, second = seed.spawn(2)
    return {**study(SETTING, ROWS, first, ""), **study(LATE, LATE_ROWS, second, "late_")}


parameters = {"setting": SETTING, "late": LATE, "rows": list(ROWS), "late_rows": list(LATE_ROWS)}
columns = tuple(
    f"{prefix}{name}_{hour}_{m}"
    for prefix, rows in (("", ROWS), ("late_", LATE_ROWS))
    for name in (*rows, "bound")
    for hour in HOURS
    for m in METRICS
)
code = (lean, sensors, data, beliefs, scored, network, run, bound, study)
seeds = np.random.SeedSequence(480).spawn(32)
rtol = 1e-3
