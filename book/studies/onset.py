"""When do filters leave the pendulum? Figs. 3 to 5 with inputs that the paper does not print.

The runs are the first of the study `starts`, with its printed input. The null is OTF
with the multiplier's form of the equations: the same motion on the circle, the same
members and observations, but no instability. From the circle OTF and OTNLeqMA run with
wider priors too, and all algorithms run with half and twice the members from both starts.
"""

from __future__ import annotations

import numpy as np

from bookkit import studies
from distfilt.models import pendulum as motion
from distfilt.models import pendulum_chart, pendulum_states

starts = studies.script("starts")
pendulum = starts.pendulum
setting = starts.setting

NAME = "onset"
PAPER = "das"
scenarios = starts.scenarios

WIDER = (2, 3, 5)
"""Factors of the prior's standard deviation."""
SIZES = (25, 100)
"""Numbers of members beside the study's own."""
SCORES = ("constraint", "farthest", *starts.DEPARTURES)
FOUR = ("OTF", "OTMA", "OTNLeq", "OTNLeqMA")

# (14) and (15) before the constraint was used in the second one
steady = motion(
    length=setting["length"],
    gravity=setting["gravity"],
    step=setting["integration_step"],
    form="multiplier",
)


def widen(members: np.ndarray, factor: float) -> np.ndarray:
    """Multiply the distances of members on the circle from the true start, in the chart."""
    start = np.array([np.deg2rad(setting["start_angle"]), setting["start_rate"]])
    # θ₀ + k (θ_i - θ₀), and the same for the rate
    chart = start + factor * (pendulum_chart(members) - start)
    return pendulum_states(chart, length=setting["length"])


def score_cases(
    case: str, names: tuple[str, ...], run, model=pendulum.swing
) -> dict[str, float]:
    """Run filters on one run's truth, observations and members; return their scores."""
    truth, observations, members = run
    members_over_time = pendulum.run_filters(observations, members, names, model=model)
    metrics = {}
    for k, name in enumerate(names):
        # Of (T, F, N, 4)
        filter_members = members_over_time[:, k]
        with np.errstate(all="ignore"):
            # Errors of runs that overflow are not finite.
            constraint, _, farthest = starts.score(filter_members, truth)
            values = {"constraint": constraint, "farthest": farthest}
            values |= starts.describe_departure(filter_members, truth)
        metrics |= {f"{case}_{name}_{key}": float(v) for key, v in values.items()}
    return metrics


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Run the null, wider priors and other sizes."""
    metrics = {}
    for start in ("off", "on"):
        # The null: the same motion on the circle, without the instability off it
        run = starts.draw_start(start, seed)
        metrics |= score_cases(f"{start}_multiplier", ("OTF",), run, steady)
        # Truth and observations are the same for all sizes.
        for size in SIZES:
            run = starts.draw_start(start, seed, size)
            metrics |= score_cases(f"{start}_size{size}", FOUR, run)
    # Off the circle a wider prior would only begin farther from the constraint.
    truth, observations, members = starts.draw_start("on", seed)
    for factor in WIDER:
        run = truth, observations, widen(members, factor)
        metrics |= score_cases(f"wide{factor}", ("OTF", "OTNLeqMA"), run)
    return metrics


parameters = {name: np.asarray(setting[name]).tolist() for name in setting}
parameters |= {"wider": list(WIDER), "sizes": list(SIZES)}
CASES = (
    *(f"{start}_multiplier_OTF" for start in ("off", "on")),
    *(f"{s}_size{n}_{name}" for s in ("off", "on") for n in SIZES for name in FOUR),
    *(f"wide{k}_{name}" for k in WIDER for name in ("OTF", "OTNLeqMA")),
)
columns = tuple(f"{case}_{key}" for case in CASES for key in SCORES)
code = (
    widen,
    score_cases,
    starts.draw_on_circle,
    starts.draw_start,
    starts.score,
    starts.describe_departure,
    pendulum.draw_data,
    pendulum.run_filters,
)
seeds = starts.seeds[:24]
rtol = 1e-4
# A run that has lost the swing multiplies the last bit until it decides.
max_outliers = 5
