"""The five algorithms of Das and Bhattacharya on their pendulum, and retraction: Figs. 3 to 5.

A trial is one run: a true swing, its observations and one first ensemble for all
algorithms. The paper's algorithms have its printed cost, the Euclidean distance, and
(12) as the update of each sample that its sentence names. OTProj reports a projection
of OTF's members and continues without it, so it needs no run of its own. Retraction,
which is not in the paper, has the squared distance and runs three times: as it is, with
rejuvenation, and with the second-order correction.
"""

from __future__ import annotations

import warnings
from functools import partial

import numpy as np

from bookkit.published import scenario
from distfilt.coupling import norm_constraint, project, retract
from distfilt.filters import ParticleCollapse
from distfilt.models import pendulum, pendulum_states
from distfilt.updates import etpf, with_augmentation, with_projection, with_retraction
from distfilt.validation import skip_validation

# The study counts the runs that lose the truth.
warnings.filterwarnings("ignore", category=ParticleCollapse)

NAME = "pendulum"
PAPER = "das"

setting = scenario("das", "pendulum")
scenarios = (setting,)
DT = setting["dt_observe"]
STEPS = round(setting["end_time"] / DT)
TIMES = DT * np.arange(1, STEPS + 1)
SCORE_FROM = setting["score_from"]
NOISE = setting["noise_variance"] * np.eye(2)
# Indices of the positions and of their velocities
MOTION = ([0, 1], [2, 3])
REJUVENATION = 0.2
"""Bandwidth of rejuvenation; the paper's algorithms draw nothing."""
LIMIT = 0.3
"""Position error in metres at which a run has diverged: three deviations of the prior."""

# x² + y² = L², the paper's g
rod = norm_constraint([0, 1], length=setting["length"])
# (14) and (15) as printed
swing = pendulum(
    length=setting["length"],
    gravity=setting["gravity"],
    step=setting["integration_step"],
)
# (3) to (5) with the printed cost
printed_etpf = partial(etpf, cost=setting["cost"])
# (6) to (11), and (12) in the interpretation of the scenario
projection = {
    "variant": setting["variant"],
    "regularisation": setting["regularisation"],
}
# (13)
augmented_etpf = with_augmentation(printed_etpf, rod, std=setting["constraint_std"])
UPDATES = {
    "OTF": printed_etpf,
    "OTMA": augmented_etpf,
    "OTNLeq": with_projection(printed_etpf, rod, **projection),
    "OTNLeqMA": with_projection(augmented_etpf, rod, **projection),
    # Not in the paper: each member to its closest point of the circle
    "retraction": with_retraction(etpf, rod, motion=MOTION),
    "rejuvenated": with_retraction(
        partial(etpf, rejuvenation=REJUVENATION), rod, motion=MOTION
    ),
    "corrected": with_retraction(partial(etpf, correct=True), rod, motion=MOTION),
}
ON_CIRCLE = ("retraction", "rejuvenated", "corrected")
ALGORITHMS = ("OTF", "OTProj", "OTMA", "OTNLeq", "OTNLeqMA", *ON_CIRCLE)


def draw_data(
    rng: np.random.Generator,
    degrees: float = setting["start_angle"],
    n_members: int = setting["members"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw true states (T, 4), observations (T, 2), and initial members (N, 4)."""
    start = [np.deg2rad(degrees), setting["start_rate"]]
    state = pendulum_states(start, length=setting["length"])
    std = setting["prior_std"]
    # The centre is off the truth by one draw, the members off the centre by others.
    centre = state + std * rng.standard_normal(4)
    members = centre + std * rng.standard_normal((n_members, 4))
    truth = np.empty((STEPS, 4))
    for k in range(STEPS):
        state = swing.step(state, 0.0, DT)
        truth[k] = state
    # (16): the position with noise
    noise = np.sqrt(NOISE[0, 0]) * rng.standard_normal((STEPS, 2))
    return truth, truth[:, :2] + noise, members


def run_filters(
    observations: np.ndarray,
    members: np.ndarray,
    names=tuple(UPDATES),
    updates=UPDATES,
    draws=0,
    model=swing,
) -> np.ndarray:
    """Run several filters side by side; return members (T, F, N, 4), NaN after a failure.

    `draws` seeds the draws of rejuvenation; no other update here draws.
    """
    rng = np.random.default_rng(draws)
    filters = [updates[name] for name in names]
    x = np.stack([members] * len(filters))
    analysis = np.full((len(observations), *x.shape), np.nan)
    is_alive = np.ones(len(filters), dtype=bool)
    with skip_validation(), np.errstate(all="ignore"):
        for k, y in enumerate(observations):
            # One call moves the members of all filters.
            x = model.transition(x, 0.0, DT)
            for f in np.flatnonzero(is_alive):
                try:
                    x[f] = filters[f](x[f], x[f, :, :2], y, NOISE, rng=rng)
                    is_alive[f] = np.isfinite(x[f]).all()
                except (ValueError, RuntimeError, ArithmeticError):
                    # A swing that is lost may overflow, or have no coupling.
                    is_alive[f] = False
                if not is_alive[f]:
                    # Something finite for the model, which is not recorded
                    x[f] = members
            analysis[k] = np.where(is_alive[:, None, None], x, np.nan)
    return analysis


def add_projection(analysis: dict[str, np.ndarray]) -> None:
    """Add OTProj's members, the projection of OTF's, to the members by name."""
    members = analysis["OTF"].copy()
    finite = np.isfinite(members).all(axis=(1, 2))
    members[finite] = project(members[finite], rod, **projection)
    analysis["OTProj"] = members


def report_mean(members: np.ndarray, name: str) -> np.ndarray:
    """Return the reported state: the mean, retracted for filters on the manifold."""
    mean = members.mean(axis=-2)
    if name in ON_CIRCLE and np.isfinite(mean).all():
        return retract(mean, rod, motion=MOTION)
    return mean


def measure_length_error(mean: np.ndarray) -> np.ndarray:
    """Return | |x| - L | of reported states; rounding is no number to store."""
    error = np.abs(np.hypot(mean[:, 0], mean[:, 1]) - setting["length"])
    return np.where(error < 1e-14, 0.0, error)


def mean_nees(members: np.ndarray, error: np.ndarray) -> float:
    """Return the position's NEES by the members' covariance, mean over time."""
    positions = members[..., :2]
    anomalies = positions - positions.mean(axis=1, keepdims=True)
    covariance = anomalies.mT @ anomalies / (members.shape[1] - 1)
    # A collapsed ensemble has no covariance to invert.
    if not np.isfinite(covariance).all() or np.linalg.det(covariance).min() < 1e-30:
        return np.nan
    solved = np.linalg.solve(covariance, error[:, :2, None])[..., 0]
    # e' P⁻¹ e over the two components
    return float((error[:, :2] * solved).sum(axis=1).mean() / 2)


def find_onset(distance: np.ndarray, limit: float = LIMIT) -> float:
    """Return the first time after 1 s at which a position error exceeds the limit, or NaN."""
    # Written so that NaN, after a failure, exceeds it.
    times = TIMES[(TIMES > 1 + 1e-9) & ~(distance <= limit)]
    return float(times[0]) if times.size else np.nan


def measure_growth(length_error: np.ndarray) -> float:
    """Return the mean length error of the last second over that of the second second."""
    early = length_error[(TIMES > 1 + 1e-9) & (TIMES < 2 + 1e-9)]
    return float(length_error[TIMES > 9 + 1e-9].mean() / early.mean())


def measure_lean(error: np.ndarray) -> float:
    """Return the RMS error of y over that of x, after three seconds."""
    mean_square = (error[TIMES > 3 + 1e-9, :2] ** 2).mean(axis=0)
    return float(np.sqrt(mean_square[1] / mean_square[0]))


def score(name: str, members: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Return errors, spreads and divergence of one filter's members (T, N, 4)."""
    mean = report_mean(members, name)
    length_error = measure_length_error(mean)
    error = mean - truth
    distance = np.hypot(error[:, 0], error[:, 1])
    # Errors and spreads after the prior's offset has died out
    late = TIMES > SCORE_FROM + 1e-9
    variance = members[late].var(axis=1, ddof=1).mean(axis=0)
    onset = find_onset(distance)
    values = {
        "constraint": np.sqrt((length_error**2).mean()),
        "position": np.sqrt((distance[late] ** 2).mean()),
        "velocity": np.sqrt((error[late, 2:] ** 2).sum(axis=1).mean()),
        "spread": np.sqrt(variance[:2].sum()),
        "nees": mean_nees(members[late], error[late]),
        "diverged": float(np.isfinite(onset)),
        "finite": float(np.isfinite(error).all()),
    }
    return {f"{name}_{key}": float(value) for key, value in values.items()}


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """All algorithms on one run."""
    truth, observations, members = draw_data(np.random.default_rng(seed))
    draws = np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, 0))
    members_over_time = run_filters(observations, members, draws=draws)
    by_filter = np.moveaxis(members_over_time, 1, 0)
    analysis = dict(zip(UPDATES, by_filter, strict=True))
    scores = {}
    with np.errstate(all="ignore"):
        add_projection(analysis)
        for name in ALGORITHMS:
            scores |= score(name, analysis[name], truth)
    return scores


parameters = {name: np.asarray(setting[name]).tolist() for name in setting}
parameters |= {"rejuvenation": REJUVENATION, "limit": LIMIT}
SCORES = (
    "constraint",
    "position",
    "velocity",
    "spread",
    "nees",
    "diverged",
    "finite",
)
columns = tuple(f"{name}_{key}" for name in ALGORITHMS for key in SCORES)
code = (
    draw_data,
    run_filters,
    add_projection,
    report_mean,
    measure_length_error,
    mean_nees,
    find_onset,
    score,
)
seeds = np.random.SeedSequence(2024).spawn(setting["runs"])
rtol = 1e-4
# Once a run has lost the swing the last bit decides its path, and whether it overflows.
max_outliers = 10
