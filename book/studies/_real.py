"""The programs of chapter 14 on published files, which are not in this repository.

``python book/tools/real.py`` runs them on the files in the folder ``DISTFILT_DATA``, and stores the
errors in ``data/real``. Without the files the stored errors are shown, and nothing is run.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pandas as pd

from bookkit import datasets, studies
from bookkit.folders import data_root
from distfilt.filters import GaussianFilter
from distfilt.models import planar_odometry
from distfilt.network import graphs
from distfilt.sensors import wrap

landmarks = studies.example("landmarks")
radios = studies.example("radios")

# Robots and landmarks: the sets of UTIAS, and parts of two others in the text form of range-aided
# problems. All settings were chosen on the first two minutes of the first set.
LANDMARK_SETS = (
    "MRCLAM_Dataset6",
    "MRCLAM_Dataset7",
    "mrclam3b.pyfg",
    "mrclam5a.pyfg",
)
GUESS = {"odometry": (0.02, 0.0, 0.02), "sight": (0.06, 0.025), "lag": 0.0}
TUNED = {"odometry": (0.16, 0.0, 0.16), "sight": (0.102, 0.0425), "lag": 0.3}
TUNING_SECONDS = 120.0
SECONDS = 300.0
"""So much of each set is scored, from its beginning."""
# Sightings as good as the truth of the first set shows (`compare_with_truth`): not to be had on a
# robot, and no result for that set
COMPARED = {**TUNED, "sight": (0.13, 0.01), "lag": 0.05}
WAYS = {"first guess": GUESS, "tuned": TUNED, "compared with the truth": COMPARED}
# Range and angle of view of a camera, in m rad, as on the page
FIELD = 5.0 * 1.4

# Ranges to anchors and to each other, by set: standard deviation of a range in m, and length of a
# cell of odometry in s. Nothing is tuned: it is the program's own noise, or that in the files of
# the second and third set, whose radios are less accurate.
RADIO_SETS = {
    "tiers.pyfg": (radios.RANGE_STD, 0.05),
    "plaza2.pyfg": (0.5, 0.1),
    "plaza1.pyfg": (0.5, 0.1),
}
START_STD = (0.1, 0.1, 0.03)


def read(name: str) -> datasets.Dataset | None:
    """Return a published set, its offsets as sightings; None if the reader does not have it."""
    path = datasets.locate(name)
    if path is None:
        return None
    if name.endswith(".pyfg"):
        return datasets.read_pyfg(path).polar()
    return datasets.read_utias(path, unknown="drop")


def follow(data: datasets.Dataset, setting: dict[str, Any]):
    """Return the steps, the states after them, and the log-likelihood of the sightings.

    A sighting that the gate rejects counts with the density of "anywhere in view".
    """
    with warnings.catch_warnings():
        # A gate that keeps rejecting warns; the share of rejections is in the table.
        warnings.simplefilter("ignore", RuntimeWarning)
        found = list(landmarks.locate(data, setting))
    steps = [step for step, _ in found]
    states = [state for _, state in found]
    rejected = sum(float(state.rejected[0]) for state in states)
    evidence = sum(float(state.log_likelihood[0]) for state in states)
    return steps, states, evidence - np.log(FIELD) * rejected


def score_landmark_set(
    data: datasets.Dataset, setting: dict[str, Any]
) -> dict[str, float]:
    """Return errors, NEES and NIS of the program with landmarks."""
    steps, states, _ = follow(data, setting)
    means = np.stack([state.means[0] for state in states])
    covs = np.stack([state.covariances[0] for state in states])
    times = landmarks.DT * np.array(steps)
    poses = datasets.score_poses(data, times, means, covs).mean()
    places = datasets.score_landmarks(data, means[-1], covs[-1]).mean()
    observed = sum(float(state.n_observed[0]) for state in states)
    return {
        "seconds": times[-1],
        "sightings": len(data.of_kind("range_bearing")),
        "rejected": sum(int(state.rejected[0]) for state in states),
        "position": np.sqrt(poses["position"]),
        "heading": np.sqrt(poses["heading"]),
        "nees": poses["nees"],
        "landmark": np.sqrt(places["place"]),
        "landmark_nees": places["place_nees"],
        "nis": sum(float(state.nis[0]) for state in states) / observed,
    }


CANDIDATES: dict[str, tuple[float, ...]] = {
    "lag": (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
    "sight": (1.0, 1.3, 1.7, 2.2, 3.0),
    "odometry": (1.0, 2.0, 4.0, 8.0, 16.0),
}
"""The lag in s; the others as factors of the first guess, as on the page."""


def tune(data: datasets.Dataset) -> list[dict[str, Any]]:
    """Return the log-likelihood of each candidate on one set, one parameter after the other."""
    setting = dict(GUESS)
    rows: list[dict[str, Any]] = []
    for name, candidates in CANDIDATES.items():
        fits = []
        for candidate in candidates:
            value: Any = candidate
            if name != "lag":
                value = tuple(candidate * np.array(setting[name]))
            *_, fit = follow(data, {**setting, name: value})
            fits.append((fit, value))
            rows.append({"parameter": name, "candidate": candidate, "fit": fit})
        _, setting[name] = max(fits)
    return rows


def score_radio_set(
    name: str, data: datasets.Dataset, options: dict[str, Any]
) -> dict[str, float]:
    """Return errors and NEES of the program with ranges; all landmarks are known anchors."""
    std, dt = RADIO_SETS[name]
    n = len(data.robots)
    ranges = datasets.list_observations(data, "range", std, anchors=data.landmarks)
    first = data.begin
    start = data.start_poses(first, std=START_STD, rng=np.random.default_rng(0))
    model = planar_odometry(*data.body_rates(dt), sigma=radios.DRIFT)
    graph = graphs.complete(n) if n > 1 else None
    f = GaussianFilter(
        model, [None] * n, graph, gate_probability=0.999, **(options if n > 1 else {})
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        events = [o for o in ranges if o.t > first]
        run = f.run(f.start(start, t=first), None, events)
    estimates = (run[part].values for part in ("time", "mean", "covariance"))
    errors = datasets.score_poses(data, *estimates)
    mean = errors.mean()
    hearers = n if options.get("share_observations") else 1
    return {
        "seconds": float(run["time"][-1]),
        "ranges": len(events),
        "rejected": float(run["rejected"].sum()) / hearers,
        "position": np.sqrt(mean["position"]),
        "heading": np.sqrt(mean["heading"]),
        "nees": mean["nees"],
    }


def run_landmark_set(name: str, data: datasets.Dataset) -> list[dict[str, Any]]:
    """Return a row for each way of running the program with landmarks."""
    part = data.before(SECONDS)
    return [
        {"set": name, "way": way} | score_landmark_set(part, setting)
        for way, setting in WAYS.items()
    ]


def compare_with_truth(data: datasets.Dataset) -> list[dict[str, Any]]:
    """Return how each robot's sightings of landmarks differ from the true geometry.

    The lag is that with the least spread of the bearings; spreads are 1.48 times the median of the
    distances from the median, the standard deviation of a Gaussian.
    """
    seen = data.of_kind("range_bearing")
    seen = seen[~seen["subject"].isin(data.robots)]
    rows = []
    for k, robot in enumerate(data.robots):
        own = seen[seen["robot"] == robot]
        places = data.landmarks.loc[own["subject"]].to_numpy()
        fits = []
        for lag in np.arange(-2, 11) / 20:
            poses = data.true_poses(own["time"].to_numpy() - lag)[:, k]
            offset = places - poses[:, :2]
            angle = np.arctan2(offset[:, 1], offset[:, 0]) - poses[:, 2]
            ranges = own["range"] - np.hypot(*offset.T)
            bearings = wrap(np.nan_to_num(own["bearing"] - angle))
            known = ~np.isnan(poses).any(axis=1)
            fits.append((_spread(bearings[known]), float(lag), ranges[known]))
        bearing_spread, lag, gaps = min(fits, key=lambda fit: fit[0])
        lead, turn_ratio = compare_odometry(data, k)
        rows.append(
            {
                "robot": robot,
                "sightings": len(own),
                "lag": lag,
                "bearing": bearing_spread,
                "range": _spread(gaps),
                "range_far": float(np.mean(np.abs(gaps - np.median(gaps)) > 0.3)),
                "odometry_lead": lead,
                "turn_ratio": turn_ratio,
            }
        )
    return rows


def compare_odometry(data: datasets.Dataset, robot: int) -> tuple[float, float]:
    """Return by how much the odometry is early, in s, and the true turns over the logged ones.

    The lead is that with the least median difference of logged and true turn rates.
    """
    dt = landmarks.DT
    times, rates = data.body_rates(dt)
    logged = rates[:-1, 3 * robot + 2]
    heading = data.true_poses(times)[:, robot, 2]
    true = np.diff(heading) / dt
    fits = []
    for lead in range(-3, 8):
        # The motion that the odometry announces comes `lead` steps later.
        later = np.roll(true, -lead)
        known = ~np.isnan(later)
        difference = float(np.median(np.abs(later[known] - logged[known])))
        turning = known & (np.abs(logged) > 0.1)
        ratio = float(np.median(later[turning] / logged[turning]))
        fits.append((difference, lead * dt, ratio))
    _, lead_time, ratio = min(fits)
    return lead_time, ratio


def _spread(values: Any) -> float:
    """Return the standard deviation of the Gaussian with the same median distance."""
    return 1.48 * float(np.median(np.abs(values - np.median(values))))


def run_radio_set(name: str, data: datasets.Dataset) -> list[dict[str, Any]]:
    """Return a row for each rule; one robot alone has all observations."""
    rules = radios.RULES if len(data.robots) > 1 else {"all observations": {}}
    return [
        {"set": name, "way": rule} | score_radio_set(name, data, options)
        for rule, options in rules.items()
    ]


def stored(name: str) -> pd.DataFrame:
    """Return a stored table of errors, ``landmarks``, ``radios`` or ``tuning``."""
    return pd.read_csv(data_root() / "real" / f"{name}.csv")


def largest_difference() -> float:
    """Return the largest relative difference of errors run again, 0 without the files.

    Of the shortest set with landmarks, and all of its ways.
    """
    name = LANDMARK_SETS[-1]
    data = read(name)
    if data is None:
        return 0.0
    again = pd.DataFrame(run_landmark_set(name, data)).set_index(["set", "way"])
    before = stored("landmarks").set_index(["set", "way"]).loc[again.index]
    return float(np.abs(again / before[again.columns] - 1).max(axis=None))
