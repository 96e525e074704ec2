"""Satellites find a target and themselves: the study behind chapter 8.

A trial draws truths and readings, and runs every filter on them. Epochs are the paper's, 2 to 10 h
and 20 to 24 h; each epoch's readings are followed by one exchange. Five scenes: the paper's two
agents; the late one, in which beliefs bend; three and five agents; and three variations of what
the paper leaves open.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from bookkit.published import scenario
from bookkit.studies import Stored, check, stored
from distfilt.filters import InformationIncrementFilter, MixtureFilter, MixtureState
from distfilt.mixtures import (
    GaussianMixture,
    PartialFusion,
    average_mixtures,
    fuse_mixtures,
    fuse_moments,
    fuse_sequentially,
    runnalls,
    target_fusion,
)
from distfilt.models import occulted, orbits, rsw_frame
from distfilt.network import graphs
from distfilt.sensors import angles_only, ephemeris, stack

NAME = "orbit"
PAPER = "semeraro"
TABLE = scenario("semeraro", "table-3").reading()
HOURS = tuple(int(h) for h in TABLE["hours"])
EARLY = [k for k, h in enumerate(HOURS) if h < TABLE["fix_at"]]
ARCSECOND = np.pi / 180 / 3600


def around(place: np.ndarray, degrees: float) -> list[float]:
    """A state turned about the Earth's axis."""
    c = np.cos(np.radians(degrees))
    s = np.sin(np.radians(degrees))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return [float(v) for v in (place.reshape(2, 3) @ turn.T).ravel()]


PAIR = [TABLE["agent_1"].tolist(), TABLE["agent_2"].tolist()]
SETTING = {
    "target": TABLE["target"].tolist(),
    "agents": PAIR,
    "target_std": TABLE["target_std"].tolist(),
    "agent_std": TABLE["agent_std"].tolist(),
    "angle_std": TABLE["angle_std"],
    "fix_std": TABLE["fix_std"].tolist(),
    "noise_std": TABLE["noise_std"].tolist(),
    "form": TABLE["form"],
    "first_angle": HOURS[0],
    "fix_at": TABLE["fix_at"],
    "one_fix": True,
    "widen": 1.0,
}
LATE = {
    **SETTING,
    "first_angle": TABLE["late_first_angle"],
    "fix_at": 0,
    "widen": TABLE["late_widen"],
}
CROWD = [*PAIR, *(around(TABLE["agent_1"], d) for d in TABLE["more_agents"])]
MIRRORED = [-PAIR[0][0], *PAIR[0][1:]]
SCENES = {
    "": SETTING,
    "late": LATE,
    "three": {**SETTING, "agents": CROWD[:3]},
    "five": {**SETTING, "agents": CROWD},
    "arctan": {**SETTING, "form": "arctan2"},
    "sign": {**SETTING, "agents": [MIRRORED, PAIR[1]]},
    "fixes": {**SETTING, "one_fix": False},
}


def lean(own: GaussianMixture, heard: list[GaussianMixture]) -> GaussianMixture:
    """Matched terms with C2, what is heard being reduced to six mixands for the shapes."""
    exact = PartialFusion(own, heard)
    return exact.assign_weights(
        exact.component_shapes(received=[runnalls(m, 6) for m in heard]), rule="C2"
    )


def mean_of(own: GaussianMixture, heard: list[GaussianMixture]) -> GaussianMixture:
    """The arithmetic average with the one agent that is heard."""
    return average_mixtures(own, heard[0])


SCALE = [1.0, 1.0, 1.0, 6.8, 6.8, 6.8]
MANY = {
    "split_threshold": TABLE["stretch"],
    "split_scale": np.tile(SCALE, 2),
    "n_components": TABLE["mixands"],
    "max_components": TABLE["mixands"],
}
MORE = {**MANY, "n_components": TABLE["late_mixands"], "max_components": TABLE["late_mixands"]}
ONE = {"n_components": 1, "max_components": 1}
IN_TURN = partial(
    fuse_sequentially, pair=partial(fuse_mixtures, n_components=TABLE["mixands"])
)
SINGLE = {
    "one_none": ONE,
    "one_ci": {**ONE, "fusion": partial(fuse_moments, omega="equal")},
    "news": {"news": True},
}
CROWDED = {
    "none": MANY,
    "turn": {**MANY, "fusion": IN_TURN},
    **SINGLE,
    "half": {
        **ONE,
        "fusion": partial(fuse_sequentially, pair=fuse_moments, omega=0.5),
    },
}
ROWS = {
    "": {
        "none": MANY,
        "c2": {**MANY, "fusion": partial(fuse_mixtures, rule="C2")},
        "c3": {**MANY, "fusion": fuse_mixtures},
        "all": {**MANY, "fusion": partial(fuse_mixtures, terms="all")},
        "moments": {**MANY, "fusion": fuse_moments},
        "average": {**MANY, "fusion": mean_of},
        **SINGLE,
        "twice": {"news": True, "shared_components": ()},
    },
    "late": {
        "none": MORE,
        "c2": {**MORE, "fusion": lean},
        "c3": {**MORE, "fusion": fuse_mixtures},
        "moments": {**MORE, "fusion": fuse_moments},
        **SINGLE,
        "many_news": {**MORE, "news": True},
    },
    "three": {
        **CROWDED,
        "pass": {**MANY, "fusion": partial(fuse_mixtures, omega="equal")},
    },
    "five": CROWDED,
    **{name: SINGLE for name in ("arctan", "sign", "fixes")},
}
"""What each scene's filters are made of."""


def sensor(s: dict) -> object:
    """An agent's: two angles of the target, then the target's full state."""
    fix = ephemeris(position_std=s["fix_std"][0], velocity_std=s["fix_std"][1])
    return stack([angles_only(std=s["angle_std"] * ARCSECOND, form=s["form"]), fix])


def data(s: dict, rng: np.random.Generator) -> tuple:
    """Truth (8, 6 + 6 A), readings (8, A, 8) with NaN where there is none, the first beliefs."""
    bodies = np.array([s["target"], *s["agents"]])
    covs = []
    gaps = []
    for k, body in enumerate(bodies):
        std = np.array(s["agent_std"]) if k else np.array(s["target_std"]) * s["widen"]
        root = np.kron(np.eye(2), rsw_frame(body)) * std
        covs.append(root @ root.T)
        gaps.append(root @ rng.standard_normal(6))
    first = (bodies + gaps).ravel()
    model = moving(s, len(bodies))
    truth = []
    x = bodies.ravel()
    t = 0.0
    for hour in HOURS:
        x = model.sample_step(x, t, 3600.0 * hour - t, rng=rng)
        truth.append(x)
        t = 3600.0 * hour
    return np.array(truth), readings(s, np.array(truth), rng), first, covs


def readings(s: dict, truth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What the agents see, (8, A, 8): no angles before the first or through the Earth."""
    agents = len(s["agents"])
    seen = np.full((len(HOURS), agents, 8), np.nan)
    eye = angles_only(std=s["angle_std"] * ARCSECOND, form=s["form"])
    for k, hour in enumerate(HOURS):
        noise = rng.standard_normal((agents, 6)) * np.repeat(s["fix_std"], 3)
        for a in range(agents):
            own = truth[k, [*range(6), *range(6 + 6 * a, 12 + 6 * a)]]
            angles = eye.predict(own) + s[
                "angle_std"
            ] * ARCSECOND * rng.standard_normal(2)
            if hour >= s["first_angle"] and not occulted(own[:3], own[6:9]):
                seen[k, a, :2] = angles
            if hour == s["fix_at"]:
                seen[k, a, 2:] = truth[k, :6] + noise[0 if s["one_fix"] else a]
    return seen


def moving(s: dict, bodies: int) -> object:
    """The model of several bodies."""
    return orbits(
        bodies, position_std=s["noise_std"][0], velocity_std=s["noise_std"][1]
    )


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
            np.concatenate([first[:6], first[6 * a : 6 * a + 6]]),
            block([covs[0], covs[a]]),
        )
        for a in range(1, len(covs))
    ]


def network(s: dict, options: dict) -> MixtureFilter:
    """A row's filter; everybody hears everybody."""
    n = len(s["agents"])
    chosen = dict(options)
    kind = MixtureFilter
    if chosen.pop("news", False):
        kind = InformationIncrementFilter
        chosen = {"shared_components": range(2, 8) if s["one_fix"] else (), **chosen}
    if "fusion" in chosen:
        chosen["fusion"] = partial(
            target_fusion, target_dim=6, fuse=chosen["fusion"]
        )
    return kind(
        moving(s, 2),
        [sensor(s)] * n,
        graphs.complete(n),
        target_dim=6,
        names=tuple(str(a + 1) for a in range(n)),
        **chosen,
    )


def run(
    s: dict, options: dict, seen: np.ndarray, first: np.ndarray, covs: list
) -> list[MixtureState]:
    """The states of a row's filter, one an epoch."""
    f = network(s, options)
    state = f.start(beliefs(first, covs))
    out = []
    for k, hour in enumerate(HOURS):
        state = f.step(state, 3600.0 * hour, list(seen[k]))
        out.append(state)
    return out


def bound(
    s: dict, options: dict, seen: np.ndarray, first: np.ndarray, covs: list
) -> list[list[GaussianMixture]]:
    """One joint filter of all bodies with everybody's readings, as the agents' marginals."""
    n = len(s["agents"])
    eye = {"std": s["angle_std"] * ARCSECOND, "form": s["form"]}
    fix = ephemeris(position_std=s["fix_std"][0], velocity_std=s["fix_std"][1])
    fixes = 1 if s["one_fix"] else n
    every = stack(
        [angles_only(observer=6 * a, **eye) for a in range(1, n + 1)] + [fix] * fixes
    )
    f = MixtureFilter(moving(s, n + 1), [every], target_dim=6, **options)
    state = f.start([GaussianMixture.gaussian(first, block(covs))])
    out = []
    for k, hour in enumerate(HOURS):
        y = np.concatenate([seen[k, :, :2].ravel(), seen[k, :fixes, 2:].ravel()])
        state = f.step(state, 3600.0 * hour, [y])
        joint = state.mixtures[0]
        out.append(
            [
                joint.marginal([*range(6), *range(6 * a, 6 * a + 6)])
                for a in range(1, n + 1)
            ]
        )
    return out


def normalised(gap: np.ndarray, cov: np.ndarray) -> float:
    """NEES per component."""
    unit = np.sqrt(np.diag(cov))
    return float(
        gap / unit @ np.linalg.solve(cov / np.outer(unit, unit), gap / unit) / gap.size
    )


def scored(mixtures: list[GaussianMixture], truth: np.ndarray) -> dict[str, np.ndarray]:
    """One epoch's metrics, each (A,): squares in km² and (m/s)², NEES per component, nats."""
    out: dict[str, list[float]] = {}
    pairs = [m.moments() for m in mixtures]
    middle = np.mean([mean[:3] for mean, _ in pairs], axis=0)
    for a, (belief, (mean, cov)) in enumerate(zip(mixtures, pairs, strict=True)):
        true = truth[[*range(6), *range(6 + 6 * a, 12 + 6 * a)]]
        gap = mean - true
        var = np.diag(cov)
        values = {
            f"{what}{i}": float(of[at : at + 3].sum())
            for what, of in (("error_", gap**2), ("claim_", var))
            for i, at in (("tp", 0), ("tv", 3), ("ep", 6), ("ev", 9))
        } | {
            "nees_t": normalised(gap[:6], cov[:6, :6]),
            "nees_e": normalised(gap[6:], cov[6:, 6:]),
            "nees": normalised(gap, cov),
            "apart": float(((mean[:3] - middle) ** 2).sum()),
            "score": float(belief.log_density(true)),
        }
        for name, value in values.items():
            out.setdefault(name, []).append(value)
    return {name: np.array(value) for name, value in out.items()}


ERRORS = ("error_tp", "error_tv", "error_ep", "error_ev")
CLAIMS = ("claim_tp", "claim_tv", "claim_ep", "claim_ev")
METRICS = (*ERRORS, "nees_t", "nees_e", "nees", "apart", "score")
FEATURED = ("none", "c3")
"""Rows of the paper's scene of which what each agent errs and claims is kept too."""
JOINT = {"bound": ONE}
JOINT_LATE = {"bound": ONE, "joint": {**MORE, "split_scale": np.tile(SCALE, 3)}}
SIX = "{:.6g}"


def joints(scene: str) -> dict:
    """The joint filters of a scene."""
    return JOINT_LATE if scene == "late" else JOINT


def kept(scene: str, name: str, found: list[dict[str, np.ndarray]]) -> dict[str, float]:
    """A row's numbers: at each epoch, or where the scene's question lies."""
    out: dict[str, float] = {}
    if scene in ("", "late"):
        for hour, values in zip(HOURS, found, strict=True):
            if scene == "late" and hour < LATE["first_angle"]:
                continue
            out |= {f"{m}_{hour}": float(values[m].mean()) for m in METRICS}
            if scene == "" and name in FEATURED:
                out |= {f"{m}_{hour}": float(values[m].mean()) for m in CLAIMS}
                out |= {
                    f"{m}{a + 1}_{hour}": float(values[m][a])
                    for m in ERRORS
                    for a in (0, 1)
                }
        return out
    fix = found[HOURS.index(TABLE["fix_at"])]
    out = {m: float(np.mean([found[k][m].mean() for k in EARLY])) for m in METRICS}
    return out | {f"{m}_fix": float(fix[m].mean()) for m in ("error_tp", "nees_t")}


def watched(scene: str, seed: np.random.SeedSequence) -> dict[str, float]:
    """All rows of one scene on one set of data."""
    s = SCENES[scene]
    truth, *rest = data(s, np.random.default_rng(seed))
    out: dict[str, float] = {}
    for name, options in ROWS[scene].items():
        states = run(s, options, *rest)
        found = [
            scored(x.mixtures, true) for x, true in zip(states, truth, strict=True)
        ]
        out |= {f"{name}_{m}": v for m, v in kept(scene, name, found).items()}
        out[f"{name}_floats"] = float(states[-1].ledger.scalars.sum())
    for name, options in joints(scene).items():
        pairs = zip(bound(s, options, *rest), truth, strict=True)
        found = [scored(mixtures, true) for mixtures, true in pairs]
        out |= {f"{name}_{m}": v for m, v in kept(scene, name, found).items()}
    # Agents that agree to a millimetre agree.
    exact = {m: 0.0 if "_apart" in m and v < 1e-12 else v for m, v in out.items()}
    return {
        f"{scene}_{m}" if scene else m: float(SIX.format(v)) for m, v in exact.items()
    }


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """All scenes; those of the paper's agents and their variations share their draws."""
    paper, late, crowd = seed.spawn(3)
    draws = {"late": late, "three": crowd, "five": crowd}
    out: dict[str, float] = {}
    for scene in SCENES:
        out |= watched(scene, draws.get(scene, paper))
    return out


def named(scene: str) -> list[str]:
    """A scene's columns."""
    blank = [dict.fromkeys((*METRICS, *CLAIMS), np.zeros(2))] * len(HOURS)
    out = [
        f"{name}_{m}"
        for name in (*ROWS[scene], *joints(scene))
        for m in (
            *kept(scene, name, blank),
            *(["floats"] if name in ROWS[scene] else []),
        )
    ]
    return [f"{scene}_{m}" if scene else m for m in out]


columns = [m for scene in SCENES for m in named(scene)]
parameters = {
    "scenes": SCENES,
    "rows": {scene: [*rows, *joints(scene)] for scene, rows in ROWS.items()},
}
code = (
    lean,
    mean_of,
    sensor,
    data,
    readings,
    beliefs,
    network,
    run,
    bound,
    scored,
    kept,
    watched,
)
scenarios = (scenario("semeraro", "table-3"),)
seeds = np.random.SeedSequence(480).spawn(48)
rtol = 1e-3
# Agents that agree differ by rounding.
atol = 1e-9
# Which mixands are kept hangs on the last bit, and with it what angles find out late.
odd = 2

LIVE = {
    "": ("none", "c3", "one_ci", "news", "bound"),
    "late": ("news",),
    "five": ("news",),
}
"""Rows that are quick enough to run again wherever the stored study is read."""


def again(seed: np.random.SeedSequence) -> dict[str, float]:
    """The rows `LIVE` of a trial."""
    first, late, crowd = seed.spawn(3)
    draws = {"late": late, "five": crowd}
    out = {}
    for scene, names in LIVE.items():
        s = SCENES[scene]
        start = f"{scene}_" if scene else ""
        truth, *rest = data(s, np.random.default_rng(draws.get(scene, first)))
        for name in names:
            if name == "bound":
                beliefs = bound(s, ONE, *rest)
            else:
                beliefs = [state.mixtures for state in run(s, ROWS[scene][name], *rest)]
            found = [scored(b, true) for b, true in zip(beliefs, truth, strict=True)]
            values = {
                f"{start}{name}_{m}": v for m, v in kept(scene, name, found).items()
            }
            out |= {
                m: 0.0 if "_apart" in m and v < 1e-12 else v for m, v in values.items()
            }
    return {m: float(SIX.format(v)) for m, v in out.items()}


def checked() -> Stored:
    """The stored study, once the quick rows of two of its seeds have run again and agree."""
    whole = stored(PAPER, NAME)
    blank = [dict.fromkeys((*METRICS, *CLAIMS), np.zeros(2))]
    quick = {
        f"{scene}_{name}_{m}" if scene else f"{name}_{m}"
        for scene, names in LIVE.items()
        for name in names
        for m in kept(scene, name, blank * len(HOURS))
    }
    part = replace(
        whole, columns={m: v for m, v in whole.columns.items() if m in quick}
    )
    check(part, again, indices=[0, 1], rtol=rtol)
    return whole
