"""Satellites find another one and themselves: the study behind chapter 8.

A trial draws one truth and one set of readings, and runs every filter on them. Epochs are the
paper's, 2 to 10 h and 20 to 24 h; each epoch's readings are followed by one exchange. Four
scenarios: the paper's, "late" with nothing to see before 20 h, and three and five agents.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from distfilt.filters import MixtureFilter
from distfilt.mixtures import (
    GaussianMixture,
    PartialFusion,
    average,
    fuse,
    fuse_in_turn,
    fuse_moments,
    kept_by_relevance,
    runnalls,
)
from distfilt.models import Model, occulted, orbits, rsw_frame
from distfilt.network import graphs
from distfilt.published import scenario
from distfilt.sensors import ephemeris, line_of_sight, stack

NAME = "orbit"
PAPER = "semeraro"

SCENARIO = scenario("semeraro", "table-3")
TABLE = SCENARIO.reading()
HOURS = tuple(int(h) for h in TABLE["hours"])
ARCSECOND = np.pi / 180 / 3600


def turned(state: np.ndarray, degrees: float) -> list[float]:
    """A state turned about the Earth's axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return (np.kron(np.eye(2), [[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ state).tolist()


SETTING = {
    "target": TABLE["target"].tolist(),
    "agents": [TABLE["agent_1"].tolist(), TABLE["agent_2"].tolist()],
    "target_std": TABLE["target_std"].tolist(), "agent_std": TABLE["agent_std"].tolist(),
    "angle_std": TABLE["angle_std"], "fix_std": TABLE["fix_std"].tolist(),
    "noise_std": TABLE["noise_std"].tolist(),
    "form": TABLE["form"], "first_angle": HOURS[0], "fix_at": TABLE["fix_at"], "widen": 1.0,
}
LATE = {
    **SETTING, "first_angle": TABLE["late_first_angle"], "fix_at": 0,
    "widen": TABLE["late_widen"],
}
MORE = [turned(TABLE["agent_1"], degrees) for degrees in TABLE["more_turns"]]
THREE = {**SETTING, "agents": [*SETTING["agents"], *MORE[:1]]}
FIVE = {**SETTING, "agents": [*SETTING["agents"], *MORE]}


def lean(own: GaussianMixture, heard: list[GaussianMixture], rule: str) -> GaussianMixture:
    """Matched terms, what is heard being reduced to a few mixands for the shapes."""
    exact = PartialFusion(own, heard)
    few = [runnalls(m, TABLE["heard_mixands"]) for m in heard]
    return exact.weigh(exact.shapes(received=few), rule=rule)


def printed(own: GaussianMixture, heard: list[GaussianMixture]) -> GaussianMixture:
    """Algorithm 1: both marginals reduced by (41) and Runnalls' rule, all terms, C3."""
    exact = PartialFusion(own, heard)
    pairs = ((exact.target, heard[0]), (heard[0], exact.target))
    few = [
        runnalls(kept_by_relevance(a, b, threshold=TABLE["relevance"]), TABLE["heard_mixands"])
        for a, b in pairs
    ]
    shapes = exact.shapes(terms="all", marginal=few[0], received=few[1:])
    return exact.weigh(shapes, rule="C3")


def arithmetic(own: GaussianMixture, heard: list[GaussianMixture]) -> GaussianMixture:
    """The arithmetic average."""
    return average(own, runnalls(heard[0], TABLE["heard_mixands"]))


SCALE = np.tile([1, 1, 1, 6.8, 6.8, 6.8], 2)
SPLITS = {"stretch": TABLE["stretch"], "scale": SCALE}
MIXED = {**SPLITS, "size": TABLE["mixands"], "most": TABLE["mixands"]}
LATE_MIXED = {**SPLITS, "size": TABLE["late_mixands"], "most": TABLE["late_mixands"]}
ONE = {"size": 1, "most": 1}
C2, C3 = partial(lean, rule="C2"), partial(lean, rule="C3")
ROWS = {
    "none": MIXED,
    "c3": {**MIXED, "agreement": C3},
    "printed": {**MIXED, "agreement": printed},
    "c2": {**MIXED, "agreement": C2},
    "moments": {**MIXED, "agreement": fuse_moments},
    "average": {**MIXED, "agreement": arithmetic},
    "one_none": ONE,
    "one_ci": {**ONE, "agreement": fuse_moments},
    "ukf_ci": {**ONE, "agreement": fuse_moments, "rule": "unscented"},
}
LATE_ROWS = {
    "none": LATE_MIXED,
    "c3": {**LATE_MIXED, "agreement": C3},
    "c2": {**LATE_MIXED, "agreement": C2},
    "moments": {**LATE_MIXED, "agreement": fuse_moments},
    "one_none": ONE,
    "one_ci": {**ONE, "agreement": fuse_moments},
}


def backwards(own: GaussianMixture, heard: list[GaussianMixture]) -> GaussianMixture:
    """Half and half each time, the agents in falling order."""
    return fuse_in_turn(own, heard[::-1], omega=0.5, pair=fuse_moments)


MANY_ROWS = {
    "none": ONE,
    "pass": {**ONE, "agreement": partial(fuse_moments, omega="equal")},
    "half": {**ONE, "agreement": partial(fuse_in_turn, omega=0.5, pair=fuse_moments)},
}


def by_turns(own: GaussianMixture, heard: list[GaussianMixture]) -> GaussianMixture:
    """Mixtures one after another, matched terms with C3, reduced between."""
    few = [runnalls(m, TABLE["heard_mixands"]) for m in heard]
    return fuse_in_turn(own, few, pair=partial(fuse, size=TABLE["mixands"]))


THREE_ROWS = {
    **MANY_ROWS, "back": {**ONE, "agreement": backwards},
    "c3": {**MIXED, "agreement": by_turns},
}
SCENARIOS = {
    "": (SETTING, ROWS), "late_": (LATE, LATE_ROWS),
    "three_": (THREE, THREE_ROWS), "five_": (FIVE, MANY_ROWS),
}
METRICS = ("tp", "ep", "nees", "tv", "ev", "tp1", "tp2")
"""Means over agents of squared errors, km², of NEES, of squared errors, (m/s)²; and each one's."""


def metrics(prefix: str) -> tuple[str, ...]:
    """What is stored of a scenario: of the paper's everything, of the others three means."""
    return METRICS[:3] if prefix else METRICS


def bodies(s: dict, count: int) -> Model:
    """What the filters take for the motion: steps of twice the truth's, 3 cm off after a day."""
    r, v = s["noise_std"]
    return orbits(count, position_std=r, velocity_std=v, longest=TABLE["filter_step"])


def sensors(s: dict) -> list:
    """Each agent's: two angles of the target, then the target's full state."""
    fix = ephemeris(position_std=s["fix_std"][0], velocity_std=s["fix_std"][1])
    eye = line_of_sight(std=s["angle_std"] * ARCSECOND, form=s["form"])
    return [stack([eye, fix])] * len(s["agents"])


def data(s: dict, rng: np.random.Generator) -> tuple:
    """Truth (8, 6 + 6 A), readings (8, A, 8) with NaN where there is none, and first beliefs."""
    start = np.concatenate([s["target"], *s["agents"]])
    stds = [np.array(s["target_std"]) * s["widen"]]
    stds += [np.array(s["agent_std"])] * len(s["agents"])
    covs, gaps = [], []
    for k, std in enumerate(stds):
        frame = np.kron(np.eye(2), rsw_frame(start[6 * k : 6 * k + 6]))
        root = frame * std
        covs.append(root @ root.T)
        gaps.append(root @ rng.standard_normal(6))
    first = start + np.concatenate(gaps)
    model = orbits(len(stds), position_std=s["noise_std"][0], velocity_std=s["noise_std"][1])
    truth, x, t = [], start, 0.0
    for hour in HOURS:
        x = model.sample_step(x, t, 3600.0 * hour - t, rng=rng)
        truth.append(x)
        t = 3600.0 * hour
    truth = np.array(truth)
    seen = np.full((len(HOURS), len(s["agents"]), 8), np.nan)
    eye = line_of_sight(std=s["angle_std"] * ARCSECOND, form=s["form"], hidden=occulted)
    for k, hour in enumerate(HOURS):
        fix = truth[k, :6] + rng.standard_normal(6) * np.repeat(s["fix_std"], 3)
        for a in range(len(s["agents"])):
            angles = eye.predict(own(truth[k], a))
            angles = angles + s["angle_std"] * ARCSECOND * rng.standard_normal(2)
            if hour >= s["first_angle"]:
                seen[k, a, :2] = angles
            if hour == s["fix_at"]:
                seen[k, a, 2:] = fix
    return truth, seen, first, covs


def own(x: np.ndarray, agent: int) -> np.ndarray:
    """What an agent estimates: the target's state and its own."""
    return np.concatenate([x[:6], x[6 + 6 * agent : 12 + 6 * agent]])


def block(parts: list) -> np.ndarray:
    """Block diagonal of 6 by 6 matrices."""
    out = np.zeros((6 * len(parts), 6 * len(parts)))
    for k, part in enumerate(parts):
        out[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = part
    return out


def beliefs(first: np.ndarray, covs: list) -> list[GaussianMixture]:
    """Each agent's first belief about [target; ego]; the error about the target is shared."""
    return [
        GaussianMixture.gaussian(own(first, a), block([covs[0], covs[1 + a]]))
        for a in range(len(covs) - 1)
    ]


def scored(mixtures: list, truth: np.ndarray) -> list[float]:
    """The metrics of one epoch."""
    t, rest = [], []
    for a, belief in enumerate(mixtures):
        mean, cov = belief.moments()
        gap = mean - own(truth, a)
        unit = np.sqrt(np.diag(cov))
        nees = gap / unit @ np.linalg.solve(cov / np.outer(unit, unit), gap / unit) / 12
        t.append(gap[:3] @ gap[:3])
        rest.append([gap[6:9] @ gap[6:9], nees, gap[3:6] @ gap[3:6], gap[9:] @ gap[9:]])
    return [float(v) for v in (np.mean(t), *np.mean(rest, axis=0), *t[:2])]


def network(s: dict, options: dict) -> MixtureFilter:
    """A row's filter."""
    model = bodies(s, 2)
    agents = len(s["agents"])
    return MixtureFilter(
        [model] * agents, sensors(s), graphs.complete(agents), target_dim=6,
        names=[str(k + 1) for k in range(agents)], **options,
    )


def run(s: dict, options: dict, seen: np.ndarray, first: np.ndarray, covs: list) -> list:
    """The states of a row's filter, one an epoch."""
    f = network(s, options)
    state, out = f.start(beliefs(first, covs)), []
    for k, hour in enumerate(HOURS):
        state = f.step(state, 3600.0 * hour, list(seen[k]))
        out.append(state)
    return out


def bound(
    s: dict, seen: np.ndarray, first: np.ndarray, covs: list, options: dict = ONE
) -> list:
    """One joint filter of all bodies with everybody's readings, as each agent's marginals."""
    agents = range(len(s["agents"]))
    eyes = [
        line_of_sight(std=s["angle_std"] * ARCSECOND, form=s["form"], observer=6 + 6 * a)
        for a in agents
    ]
    fix = ephemeris(position_std=s["fix_std"][0], velocity_std=s["fix_std"][1])
    model = bodies(s, len(agents) + 1)
    f = MixtureFilter([model], [stack([*eyes, fix])], target_dim=6, **options)
    state, out = f.start([GaussianMixture.gaussian(first, block(covs))]), []
    for k, hour in enumerate(HOURS):
        y = np.concatenate([*seen[k, :, :2], seen[k, 0, 2:]])
        state = f.step(state, 3600.0 * hour, [y])
        joint = state.mixtures[0]
        out.append([joint.marginal(own(np.arange(first.size), a)) for a in agents])
    return out


def told(belief: GaussianMixture, j: np.ndarray, eta: np.ndarray) -> GaussianMixture:
    """A single Gaussian that has heard news, information about its first 6 components."""
    mean, cov = belief.means[0], belief.covs[0]
    cross = cov[:, :6]
    right = np.column_stack([eta - j @ mean[:6], j @ cross.T])
    both = np.linalg.solve(np.eye(6) + j @ cov[:6, :6], right)
    new = cov - cross @ both[:, 1:]
    return GaussianMixture.gaussian(mean + cross @ both[:, 0], 0.5 * (new + new.T))


def information(belief: GaussianMixture) -> tuple[np.ndarray, np.ndarray]:
    """The target's information matrix and vector of a single Gaussian."""
    part = belief.marginal(range(6))
    j = np.linalg.inv(part.covs[0])
    return j, j @ part.means[0]


def news(s: dict, seen: np.ndarray, first: np.ndarray, covs: list) -> list:
    """Single Gaussians that exchange what each reading told, but nothing of the shared fix."""
    f = network(s, ONE)
    state, out = f.start(beliefs(first, covs)), []
    for k, hour in enumerate(HOURS):
        before = f.step(state, 3600.0 * hour, [None] * len(s["agents"]))
        after = f.step(before, 3600.0 * hour, list(seen[k]))
        gains = [
            [a - b for a, b in zip(information(p), information(q), strict=True)]
            for p, q in zip(after.mixtures, before.mixtures, strict=True)
        ]
        heard = list(after.mixtures)
        for a in range(len(heard)):
            for b, gain in enumerate(gains):
                if b != a and hour != s["fix_at"]:
                    heard[a] = told(heard[a], *gain)
        state = type(after)(after.t, after.ledger, None, tuple(heard))
        out.append(list(state.mixtures))
    return out


JOINT = {**LATE_MIXED, "scale": np.tile(SCALE[:6], 3)}


def study(s: dict, rows: dict, seed: np.random.SeedSequence, prefix: str) -> dict[str, float]:
    """All rows of one scenario on one set of data."""
    truth, *drawn = data(s, np.random.default_rng(seed))
    found = {
        name: [state.mixtures for state in run(s, options, *drawn)]
        for name, options in rows.items()
    }
    found["bound"] = bound(s, *drawn)
    found["news"] = news(s, *drawn)
    if s["widen"] > 1:
        found["joint"] = bound(s, *drawn, options=JOINT)
    out = {}
    for name, agents in found.items():
        for k, hour in enumerate(HOURS):
            values = dict(zip(METRICS, scored(agents[k], truth[k]), strict=True))
            out |= {f"{prefix}{name}_{hour}_{m}": values[m] for m in metrics(prefix)}
    return out


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """The four scenarios."""
    out = {}
    for (prefix, (s, rows)), child in zip(
        SCENARIOS.items(), seed.spawn(len(SCENARIOS)), strict=True
    ):
        out |= study(s, rows, child, prefix)
    return out


parameters = {
    "settings": {name or "paper": s for name, (s, _) in SCENARIOS.items()},
    "rows": {name or "paper": list(rows) for name, (_, rows) in SCENARIOS.items()},
}
columns = tuple(
    f"{prefix}{name}_{hour}_{m}"
    for prefix, (s, rows) in SCENARIOS.items()
    for name in (*rows, "bound", "news", *(["joint"] if s["widen"] > 1 else []))
    for hour in HOURS
    for m in metrics(prefix)
)
code = (
    turned, lean, printed, arithmetic, backwards, by_turns, bodies, sensors, data, own, beliefs,
    scored, network, run, bound, told, information, news, study,
)
seeds = np.random.SeedSequence(480).spawn(32)
scenarios = (SCENARIO,)
rtol = 1e-3
