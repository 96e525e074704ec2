"""When does the filter that ignores the constraint leave the pendulum? Figs. 3 and 4, swept.

The runs are the first of the study `starts`. From both of its starts OTF runs with the
equations as printed, whose extension off the circle is unstable, and with the
multiplier's form, which is the null: the same motion on the circle, the same members
and readings. From the circle OTF and OTNLeqMA run with wider priors too, since the
paper prints none.
"""

from __future__ import annotations

import numpy as np

from bookkit import studies
from distfilt.models import pendulum as motion
from distfilt.models import pendulum_chart, pendulum_states

starts = studies.script("starts")
pendulum = starts.pendulum
setting = starts.setting
TIMES = starts.TIMES

NAME = "onset"
PAPER = "das"

LIMITS = (0.2, 0.3, 0.5)
"""Position errors in metres at which a run counts as diverged."""
WIDER = (2, 3, 5)
"""Factors of the prior's standard deviation."""
steady = motion(
    length=setting["length"],
    gravity=setting["gravity"],
    step=setting["integration_step"],
    form="multiplier",
)


def widen(members: np.ndarray, factor: float) -> np.ndarray:
    """Members on the circle whose distances from the true start are multiplied, in the chart."""
    start = np.array([np.deg2rad(setting["start_angle"]), setting["start_rate"]])
    chart = start + factor * (pendulum_chart(members) - start)
    return pendulum_states(chart, length=setting["length"])


def departures(name: str, members: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """How errors grow and lean, and when the position is first farther off than each limit."""
    scores = pendulum.scores(name, members, truth)
    distance = np.hypot(*(members.mean(axis=-2) - truth)[:, :2].T)
    values = {
        key: scores[f"{name}_{key}"] for key in ("constraint", "growth", "ratio_yx")
    }
    for limit in LIMITS:
        departed = TIMES[(TIMES > 1 + 1e-9) & ~(distance <= limit)]
        values[f"onset_{round(100 * limit)}cm"] = (
            float(departed[0]) if departed.size else np.nan
        )
    return values


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Both starts, both forms of the equations, and wider priors."""
    rng, rng_circle = (np.random.default_rng(s) for s in seed.spawn(2))
    truth, readings, off = pendulum.data(rng)
    on = starts.on_circle(rng_circle)
    metrics = {}
    cases = {
        f"{start}_{form}": (members, ("OTF",), model)
        for start, members in (("off", off), ("on", on))
        for form, model in (("printed", pendulum.swing), ("multiplier", steady))
    } | {f"wide{k}": (widen(on, k), ("OTF", "OTNLeqMA"), pendulum.swing) for k in WIDER}
    for case, (members, names, model) in cases.items():
        members_over_time = pendulum.run(readings, members, names, model=model)
        for k, name in enumerate(names):
            values = departures(name, members_over_time[:, k], truth)
            metrics |= {f"{case}_{name}_{key}": value for key, value in values.items()}
    return metrics


parameters = {name: np.asarray(setting[name]).tolist() for name in setting}
parameters |= {"limits": list(LIMITS), "wider": list(WIDER)}
SCORES = (
    "constraint",
    "growth",
    "ratio_yx",
    *(f"onset_{round(100 * limit)}cm" for limit in LIMITS),
)
CASES = (
    *(f"{s}_{f}_OTF" for s in ("off", "on") for f in ("printed", "multiplier")),
    *(f"wide{k}_{name}" for k in WIDER for name in ("OTF", "OTNLeqMA")),
)
columns = tuple(f"{case}_{key}" for case in CASES for key in SCORES)
code = (
    widen,
    departures,
    starts.on_circle,
    pendulum.data,
    pendulum.run,
    pendulum.scores,
)
seeds = starts.seeds[:40]
rtol = 1e-4
# A run that has lost the swing multiplies the last bit until it decides.
max_outliers = 8
