"""Satellites estimate a target and themselves: the study behind chapter 8.

A trial draws truths and observations, and runs every filter on them. Epochs are the
paper's, 2 to 10 h and 20 to 24 h; each epoch's observations are followed by one
exchange. Five scenes: the paper's two agents; the late one, in which beliefs bend;
three and five agents; and three variations of the choices that the paper leaves open.
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
from distfilt.models import Model, occulted, orbits, rsw_frame
from distfilt.network import graphs
from distfilt.sensors import Sensor, angles_only, ephemeris, stack

NAME = "orbit"
PAPER = "semeraro"
# Table 3 of the paper, with the assumptions of the scenario
TABLE = scenario("semeraro", "table-3").track_reads()
HOURS = tuple(int(h) for h in TABLE["hours"])
# Epochs before the ephemeris of 22 h
EARLY = [k for k, hour in enumerate(HOURS) if hour < TABLE["fix_at"]]
ARCSECOND = np.pi / 180 / 3600

Beliefs = list[GaussianMixture]
"""Each agent's belief about [target; ego]."""
Scores = dict[str, np.ndarray]
"""Metrics of one epoch by name, each (A,)."""


def rotate_state(state: np.ndarray, degrees: float) -> list[float]:
    """Return position and velocity turned about the Earth's axis."""
    c = np.cos(np.radians(degrees))
    s = np.sin(np.radians(degrees))
    # Position and velocity turn by the same matrix, since the frame is inertial.
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    rotated = state.reshape(2, 3) @ turn.T
    return [float(v) for v in rotated.ravel()]


# ----------------------------------------------------------------------------------- the scenes

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
# A wider prior and no observation for many hours: beliefs bend.
LATE = {
    **SETTING,
    "first_angle": TABLE["late_first_angle"],
    "fix_at": 0,
    "widen": TABLE["late_widen"],
}
MORE_AGENTS = [rotate_state(TABLE["agent_1"], d) for d in TABLE["more_agents"]]
CROWD = PAIR + MORE_AGENTS
# Agent 1 with the sign that Table 3 prints
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


# ------------------------------------------------------------------------------ rows of filters


def fuse_reduced(own: GaussianMixture, received: Beliefs) -> GaussianMixture:
    """Fuse matched terms with C2, received mixtures reduced to six components for the shapes."""
    fusion = PartialFusion(own, received)
    # The weights use the whole mixtures; only the shapes come from the reduced ones.
    reduced = [runnalls(mixture, 6) for mixture in received]
    shapes = fusion.component_shapes(received=reduced)
    return fusion.assign_weights(shapes, rule="C2")


def average_pair(own: GaussianMixture, received: Beliefs) -> GaussianMixture:
    """Return the arithmetic average with the one agent that is received."""
    return average_mixtures(own, received[0])


# Kilometres that a kilometre or a metre per second counts as
SCALE = [1.0, 1.0, 1.0, 6.8, 6.8, 6.8]
# Mixtures: a component is split where its forecast is stretched beyond the threshold.
MANY = {
    "split_threshold": TABLE["stretch"],
    "split_scale": np.tile(SCALE, 2),
    "n_components": TABLE["mixands"],
    "max_components": TABLE["mixands"],
}
MORE = {
    **MANY,
    "n_components": TABLE["late_mixands"],
    "max_components": TABLE["late_mixands"],
}
ONE = {"n_components": 1, "max_components": 1}
# Rules for more than two agents: received mixtures are fused one after the other.
PAIRWISE = partial(fuse_mixtures, n_components=TABLE["mixands"])
SEQUENTIAL = partial(fuse_sequentially, pair=PAIRWISE)
EQUAL_MOMENTS = partial(fuse_moments, omega="equal")
HALF_MOMENTS = partial(fuse_sequentially, pair=fuse_moments, omega=0.5)
SINGLE = {
    "one_none": ONE,
    "one_ci": {**ONE, "fusion": EQUAL_MOMENTS},
    "increments": {"increments": True},
}
"""Filters of one Gaussian."""
CROWDED = {
    "none": MANY,
    "turn": {**MANY, "fusion": SEQUENTIAL},
    **SINGLE,
    "half": {**ONE, "fusion": HALF_MOMENTS},
}
ROWS = {
    "": {
        "none": MANY,
        # Weights by C2 or by C3 on matched terms, by C3 on all terms
        "c2": {**MANY, "fusion": partial(fuse_mixtures, rule="C2")},
        "c3": {**MANY, "fusion": fuse_mixtures},
        "all": {**MANY, "fusion": partial(fuse_mixtures, terms="all")},
        "moments": {**MANY, "fusion": fuse_moments},
        "average": {**MANY, "fusion": average_pair},
        **SINGLE,
        # The ephemeris is sent as an increment, although both agents have it.
        "twice": {"increments": True, "shared_components": ()},
    },
    "late": {
        "none": MORE,
        "c2": {**MORE, "fusion": fuse_reduced},
        "c3": {**MORE, "fusion": fuse_mixtures},
        "moments": {**MORE, "fusion": fuse_moments},
        **SINGLE,
        "many_increments": {**MORE, "increments": True},
    },
    "three": {
        **CROWDED,
        # All beliefs in one pass, with equal exponents
        "pass": {**MANY, "fusion": partial(fuse_mixtures, omega="equal")},
    },
    "five": CROWDED,
    **{name: SINGLE for name in ("arctan", "sign", "fixes")},
}
"""Each scene's filters by name, with their options."""
JOINT = {"bound": ONE}
JOINT_LATE = {"bound": ONE, "joint": {**MORE, "split_scale": np.tile(SCALE, 3)}}


def joint_rows(scene: str) -> dict:
    """Return the joint filters of a scene, by name."""
    return JOINT_LATE if scene == "late" else JOINT


# ----------------------------------------------------------------------------------------- data


def target_and_ego(agent: int) -> list[int]:
    """Return the components of [target; one ego] in [target; all egos]; egos count from 0."""
    # Six components a body, the target first
    first = 6 + 6 * agent
    return list(range(6)) + list(range(first, first + 6))


def agent_sensor(s: dict) -> Sensor:
    """Return an agent's sensor: two angles of the target, then the target's full state."""
    angles = angles_only(std=s["angle_std"] * ARCSECOND, form=s["form"])
    position_std, velocity_std = s["fix_std"]
    return stack(
        [angles, ephemeris(position_std=position_std, velocity_std=velocity_std)]
    )


def orbit_model(s: dict, bodies: int) -> Model:
    """Return the model of several bodies."""
    position_std, velocity_std = s["noise_std"]
    return orbits(bodies, position_std=position_std, velocity_std=velocity_std)


def simulate(s: dict, rng: np.random.Generator) -> tuple:
    """Draw truth (8, 6 + 6 A), observations (8, A, 8), prior mean (6 + 6 A,) and covariances.

    A missing observation is NaN; there is one prior covariance, (6, 6), for each body.
    """
    bodies = np.array([s["target"], *s["agents"]])
    covs = []
    errors = []
    for k, body in enumerate(bodies):
        std = np.array(s["agent_std"])
        # The target comes first; its deviations are those of Table 3, widened or not.
        if k == 0:
            std = np.array(s["target_std"]) * s["widen"]
        # Deviations are given along the radial, transverse and normal directions.
        root = np.kron(np.eye(2), rsw_frame(body)) * std
        covs.append(root @ root.T)
        errors.append(root @ rng.standard_normal(6))
    prior_mean = (bodies + errors).ravel()
    # One trajectory of all bodies, with process noise between the epochs
    model = orbit_model(s, len(bodies))
    states = []
    x = bodies.ravel()
    t = 0.0
    for hour in HOURS:
        x = model.sample_step(x, t, 3600.0 * hour - t, rng=rng)
        states.append(x)
        t = 3600.0 * hour
    truth = np.array(states)
    return truth, observe(s, truth, rng), prior_mean, covs


def observe(s: dict, truth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw observations (8, A, 8): no angles before the first or through the Earth."""
    n_agents = len(s["agents"])
    observed = np.full((len(HOURS), n_agents, 8), np.nan)
    std = s["angle_std"] * ARCSECOND
    sensor = angles_only(std=std, form=s["form"])
    # All noise of an epoch is drawn, also of observations that are then missing.
    for k, hour in enumerate(HOURS):
        noise = rng.standard_normal((n_agents, 6)) * np.repeat(s["fix_std"], 3)
        for a in range(n_agents):
            state = truth[k, target_and_ego(a)]
            angles = sensor.predict(state) + std * rng.standard_normal(2)
            visible = not occulted(state[:3], state[6:9])
            if hour >= s["first_angle"] and visible:
                observed[k, a, :2] = angles
            if hour == s["fix_at"]:
                # One ephemeris for all agents, or one of each agent's own.
                error = noise[0 if s["one_fix"] else a]
                observed[k, a, 2:] = truth[k, :6] + error
    return observed


def block_diagonal(blocks: list[np.ndarray]) -> np.ndarray:
    """Return the block diagonal of 6 by 6 matrices."""
    n = 6 * len(blocks)
    matrix = np.zeros((n, n))
    for k, block in enumerate(blocks):
        part = slice(6 * k, 6 * k + 6)
        matrix[part, part] = block
    return matrix


def prior_beliefs(mean: np.ndarray, covs: list[np.ndarray]) -> Beliefs:
    """Return each agent's prior of [target; ego]; the error of the target is shared."""
    return [
        GaussianMixture.gaussian(
            mean[target_and_ego(a)], block_diagonal([covs[0], covs[a + 1]])
        )
        for a in range(len(covs) - 1)
    ]


# --------------------------------------------------------------------------------------- filters


def make_filter(s: dict, options: dict) -> MixtureFilter:
    """Return a row's filter on a complete graph."""
    n = len(s["agents"])
    chosen = dict(options)
    kind = MixtureFilter
    if chosen.pop("increments", False):
        kind = InformationIncrementFilter
        # One ephemeris is the same observation for all agents.
        shared = range(2, 8) if s["one_fix"] else ()
        chosen = {"shared_components": shared, **chosen}
    if "fusion" in chosen:
        rule = chosen["fusion"]
        chosen["fusion"] = partial(target_fusion, target_dim=6, fuse=rule)
    return kind(
        orbit_model(s, 2),
        [agent_sensor(s)] * n,
        graphs.complete(n),
        target_dim=6,
        names=tuple(str(a + 1) for a in range(n)),
        **chosen,
    )


def run_filter(
    s: dict,
    options: dict,
    observed: np.ndarray,
    prior_mean: np.ndarray,
    covs: list[np.ndarray],
) -> list[MixtureState]:
    """Return the states of a row's filter, one an epoch."""
    # One step forecasts to an epoch, conditions, and exchanges one message.
    f = make_filter(s, options)
    state = f.start(prior_beliefs(prior_mean, covs))
    states = []
    for k, hour in enumerate(HOURS):
        state = f.step(state, 3600.0 * hour, list(observed[k]))
        states.append(state)
    return states


def run_joint(
    s: dict,
    options: dict,
    observed: np.ndarray,
    prior_mean: np.ndarray,
    covs: list[np.ndarray],
) -> list[Beliefs]:
    """Run one joint filter of all bodies and observations; return the agents' marginals."""
    n = len(s["agents"])
    std = s["angle_std"] * ARCSECOND
    # Agent a's state follows the target's and those of the agents before it.
    angles = [
        angles_only(observer=6 * a, std=std, form=s["form"]) for a in range(1, n + 1)
    ]
    position_std, velocity_std = s["fix_std"]
    fix = ephemeris(position_std=position_std, velocity_std=velocity_std)
    fixes = 1 if s["one_fix"] else n
    sensor = stack(angles + [fix] * fixes)
    f = MixtureFilter(orbit_model(s, n + 1), [sensor], target_dim=6, **options)
    prior = GaussianMixture.gaussian(prior_mean, block_diagonal(covs))
    state = f.start([prior])
    beliefs = []
    for k, hour in enumerate(HOURS):
        # All angles, then the ephemeris, once or once for each agent
        parts = [observed[k, :, :2].ravel(), observed[k, :fixes, 2:].ravel()]
        state = f.step(state, 3600.0 * hour, [np.concatenate(parts)])
        joint = state.mixtures[0]
        beliefs.append([joint.marginal(target_and_ego(a)) for a in range(n)])
    return beliefs


# --------------------------------------------------------------------------------------- scoring

PARTS = {"tp": 0, "tv": 3, "ep": 6, "ev": 9}
"""Target's position and velocity, ego's position and velocity: where they begin."""
ERRORS = ("error_tp", "error_tv", "error_ep", "error_ev")
VARIANCES = ("variance_tp", "variance_tv", "variance_ep", "variance_ev")
"""Reported variances."""
METRICS = (*ERRORS, "nees_t", "nees_e", "nees", "apart", "score")
FEATURED = ("none", "c3")
"""Rows of the paper's scene for which each agent's errors and variances are stored."""
SIX = "{:.6g}"


def nees_per_component(error: np.ndarray, cov: np.ndarray) -> float:
    """Return the NEES of an error, over its number of components."""
    # Units differ by orders of magnitude: solve with the correlation matrix.
    std = np.sqrt(np.diag(cov))
    scaled = error / std
    correlation = cov / np.outer(std, std)
    return float(scaled @ np.linalg.solve(correlation, scaled) / error.size)


def score_epoch(beliefs: Beliefs, truth: np.ndarray) -> Scores:
    """Return one epoch's metrics, each (A,): squares in km² and (m/s)², NEES, nats."""
    scores: dict[str, list[float]] = {}
    moments = [belief.moments() for belief in beliefs]
    centre = np.mean([mean[:3] for mean, _ in moments], axis=0)
    for a, (belief, (mean, cov)) in enumerate(zip(beliefs, moments, strict=True)):
        # Squares are summed over the three components of each part.
        true = truth[target_and_ego(a)]
        error = mean - true
        sums = {"error": error**2, "variance": np.diag(cov)}
        values = {
            f"{kind}_{part}": float(squares[first : first + 3].sum())
            for kind, squares in sums.items()
            for part, first in PARTS.items()
        }
        values["nees_t"] = nees_per_component(error[:6], cov[:6, :6])
        values["nees_e"] = nees_per_component(error[6:], cov[6:, 6:])
        values["nees"] = nees_per_component(error, cov)
        # Squared distance of the target's mean from the agents' average
        values["apart"] = float(((mean[:3] - centre) ** 2).sum())
        values["score"] = float(belief.log_density(true))
        for name, value in values.items():
            scores.setdefault(name, []).append(value)
    return {name: np.array(value) for name, value in scores.items()}


def score_all(beliefs: list[Beliefs], truth: np.ndarray) -> list[Scores]:
    """Return the metrics of all epochs."""
    return [score_epoch(b, true) for b, true in zip(beliefs, truth, strict=True)]


def row_columns(scene: str, name: str, scores: list[Scores]) -> dict[str, float]:
    """Return the numbers that are stored of a row: of each epoch, or means over the early ones."""
    columns: dict[str, float] = {}
    if scene in ("", "late"):
        for hour, values in zip(HOURS, scores, strict=True):
            if scene == "late" and hour < LATE["first_angle"]:
                continue
            columns |= {f"{m}_{hour}": float(values[m].mean()) for m in METRICS}
            if scene == "" and name in FEATURED:
                columns |= {f"{m}_{hour}": float(values[m].mean()) for m in VARIANCES}
                columns |= {
                    f"{m}{a + 1}_{hour}": float(values[m][a])
                    for m in ERRORS
                    for a in (0, 1)
                }
        return columns
    # Other scenes store means over agents and the epochs before the ephemeris.
    early = [scores[k] for k in EARLY]
    for m in METRICS:
        columns[m] = float(np.mean([values[m].mean() for values in early]))
    fix = scores[HOURS.index(TABLE["fix_at"])]
    for m in ("error_tp", "nees_t"):
        columns[f"{m}_fix"] = float(fix[m].mean())
    return columns


def column_name(scene: str, name: str, metric: str) -> str:
    """Return the name of a column; those of the paper's scene have no prefix."""
    return f"{scene}_{name}_{metric}" if scene else f"{name}_{metric}"


def round_columns(columns: dict[str, float]) -> dict[str, float]:
    """Return six digits of each number; agents that agree to a millimetre agree."""
    rounded = {}
    for name, value in columns.items():
        agree = "_apart" in name and value < 1e-12
        rounded[name] = 0.0 if agree else float(SIX.format(value))
    return rounded


# ---------------------------------------------------------------------------------------- trials


def run_scene(scene: str, seed: np.random.SeedSequence) -> dict[str, float]:
    """Return the columns of all rows of one scene, on one set of data."""
    s = SCENES[scene]
    # All filters of a scene use the same truth and observations.
    truth, *data = simulate(s, np.random.default_rng(seed))
    columns: dict[str, float] = {}
    for name, options in ROWS[scene].items():
        states = run_filter(s, options, *data)
        scores = score_all([state.mixtures for state in states], truth)
        for m, value in row_columns(scene, name, scores).items():
            columns[column_name(scene, name, m)] = value
        sent = float(states[-1].ledger.scalars.sum())
        columns[column_name(scene, name, "floats")] = sent
    # The joint filter sends nothing: it has all observations.
    for name, options in joint_rows(scene).items():
        scores = score_all(run_joint(s, options, *data), truth)
        for m, value in row_columns(scene, name, scores).items():
            columns[column_name(scene, name, m)] = value
    return round_columns(columns)


def scene_seeds(seed: np.random.SeedSequence) -> dict[str, np.random.SeedSequence]:
    """Return each scene's seed; those of the paper's agents and their variations share it."""
    # Three and five agents share data, so that the effect of the number shows.
    paper, late, crowd = seed.spawn(3)
    seeds = dict.fromkeys(SCENES, paper)
    return seeds | {"late": late, "three": crowd, "five": crowd}


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Return the columns of all scenes."""
    columns: dict[str, float] = {}
    for scene, part in scene_seeds(seed).items():
        columns |= run_scene(scene, part)
    return columns


def blank_scores() -> list[Scores]:
    """Return metrics of zero, of which only the names matter."""
    return [dict.fromkeys((*METRICS, *VARIANCES), np.zeros(2))] * len(HOURS)


def scene_columns(scene: str) -> list[str]:
    """Return the names of a scene's columns."""
    names = []
    for name in ROWS[scene]:
        metrics = [*row_columns(scene, name, blank_scores()), "floats"]
        names += [column_name(scene, name, m) for m in metrics]
    for name in joint_rows(scene):
        metrics = row_columns(scene, name, blank_scores())
        names += [column_name(scene, name, m) for m in metrics]
    return names


columns = [name for scene in SCENES for name in scene_columns(scene)]
parameters = {
    "scenes": SCENES,
    "rows": {scene: [*rows, *joint_rows(scene)] for scene, rows in ROWS.items()},
}
# The functions behind one run, which other studies of these orbits use too
run_code = (
    simulate,
    observe,
    prior_beliefs,
    make_filter,
    run_filter,
    score_epoch,
)
code = (
    *run_code,
    fuse_reduced,
    average_pair,
    agent_sensor,
    run_joint,
    row_columns,
    run_scene,
)
scenarios = (scenario("semeraro", "table-3"),)
seeds = np.random.SeedSequence(480).spawn(48)
rtol = 1e-3
# Agents that agree differ by rounding.
atol = 1e-9
# The last bit decides which components are merged, and with them the effect of late angles.
max_outliers = 2


# --------------------------------------------------------------------------------- a quick check

LIVE = {
    "": ("none", "c3", "one_ci", "increments", "bound"),
    "late": ("increments",),
    "five": ("increments",),
}
"""Rows that are quick enough to run again wherever the stored study is read."""


def run_live(seed: np.random.SeedSequence) -> dict[str, float]:
    """Return the columns of the rows `LIVE` of a trial."""
    seeds = scene_seeds(seed)
    columns = {}
    for scene, names in LIVE.items():
        s = SCENES[scene]
        truth, *data = simulate(s, np.random.default_rng(seeds[scene]))
        # The data are those of the trial, for the quick rows only.
        for name in names:
            if name == "bound":
                beliefs = run_joint(s, ONE, *data)
            else:
                states = run_filter(s, ROWS[scene][name], *data)
                beliefs = [state.mixtures for state in states]
            scores = score_all(beliefs, truth)
            for m, value in row_columns(scene, name, scores).items():
                columns[column_name(scene, name, m)] = value
    return round_columns(columns)


def load_checked() -> Stored:
    """Return the stored study, after the quick rows of two trials have run again and agree."""
    study = stored(PAPER, NAME)
    # The names of the columns that the quick rows fill
    quick = {
        column_name(scene, name, m)
        for scene, names in LIVE.items()
        for name in names
        for m in row_columns(scene, name, blank_scores())
    }
    part = {m: values for m, values in study.columns.items() if m in quick}
    check(replace(study, columns=part), run_live, indices=[0, 1], rtol=rtol)
    return study
