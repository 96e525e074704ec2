"""Robots that measure distances to each other: what they send against what they gain.

The sets are generated in the form of range-aided mapping problems, with slipping wheels,
scaled odometry, constant errors of radios, echoes and gaps. All rows have the same data.
"""

from __future__ import annotations

import runpy
import tempfile
import warnings
from functools import partial
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from bookkit import datasets
from distfilt import filters, mixtures, network
from distfilt.models import Model, planar_odometry
from distfilt.sensors import Sensor

NAME = "radios"
PAPER = "together"

EXAMPLE = Path(__file__).parents[1] / "examples" / "radios.py"
names = runpy.run_path(str(EXAMPLE))
# Without the interpreter's own names, which do not travel to other processes
example = {name: names[name] for name in names if not name.startswith("__")}

DURATION = 60.0
# Standard deviation of a radio's constant error, and of a range if it is estimated
BIAS_STD = 0.2
RANGE_STD_WITH_BIAS = 0.12
GATE = 0.999
# Scores are averaged from here on, in s.
AFTER = 10.0
ROWS = (
    "none",
    "naive",
    "intersection",
    "increments",
    "all",
    "partial",
    "all_biases",
)
# Which rows estimate the constant errors of radios: how many of them an agent holds
BIASES = {"partial": 1, "all_biases": 4}


def read_set(seed: np.random.Generator) -> datasets.Dataset:
    """Generate a set, and read it from its file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "radios.pyfg"
        datasets.write_pyfg(path, rng=seed, duration=DURATION)
        return datasets.read_pyfg(path)


def add_bias(observation, dim, component, std):
    """Return a range whose sensor adds a component of the state, with another noise."""
    plain = observation.sensor
    variance = plain.noise_cov - example["RANGE_STD"] ** 2 + std**2

    def h(x):
        return plain.predict(x[..., :dim]) + x[..., [component]]

    return observation.replace(sensor=Sensor(1, h, variance, kind="range"))


def make_filter(row: str, model: Model, n: int) -> filters.Filter:
    """Return the filter of a row for n robots, all of which hear each other."""
    graph = network.graphs.complete(n)
    none = [None] * n
    gate = {"gate_probability": GATE}
    if row in ("all", "all_biases"):
        return filters.GaussianFilter(model, none, graph, **gate)
    if row == "increments":
        return filters.InformationIncrementFilter(
            model, none, graph, target_dim=3 * n, **gate
        )
    if row == "partial":
        fuse = partial(
            mixtures.target_fusion, target_dim=3 * n, fuse=mixtures.fuse_moments
        )
        single = {"n_components": 1, "max_components": 1}
        return filters.MixtureFilter(
            model, none, graph, target_dim=3 * n, fusion=fuse, **single, **gate
        )
    rule = {
        "none": None,
        "naive": network.naive_fusion,
        "intersection": network.covariance_intersection,
    }[row]
    return filters.GaussianFilter(
        model, none, graph, share_observations=False, fusion=rule, **gate
    )


def run_row(data: datasets.Dataset, row: str):
    """Return the record of one filter on one set."""
    n = len(data.robots)
    n_biases = BIASES.get(row, 0)
    model = planar_odometry(
        *data.body_rates(), sigma=example["DRIFT"], n_constants=n_biases
    )
    observations = example["list_ranges"](data)
    mean, cov = data.prior_poses()
    if n_biases:
        first = 3 * n
        observations = [
            add_bias(
                o, first, first + (o.agent if n_biases == n else 0), RANGE_STD_WITH_BIAS
            )
            for o in observations
        ]
        mean = np.append(mean, np.zeros(n_biases))
        cov = block_diag(cov, BIAS_STD**2 * np.eye(n_biases))
    f = make_filter(row, model, n)
    truth = {str(k): partial(true_component, data, k) for k in range(3 * n)}
    start = f.start((mean, cov))
    return f.run(start, None, observations, truth=truth)


def true_component(data: datasets.Dataset, k: int, t: float) -> float:
    """Return one component of all robots' true poses."""
    return float(data.true_state(t)[k])


def score(run, n: int) -> dict[str, float]:
    """Return the error of positions, NEES a component, rejections and numbers sent."""
    late = run.sel(time=slice(AFTER, None))
    squared = late["squared_error"].values[..., : 3 * n]
    squared = squared.reshape(*squared.shape[:-1], n, 3)[..., :2]
    return {
        "rmse": float(np.sqrt(2 * squared.mean())),
        "nees": float(late["nees"].mean()) / (3 * n),
        "rejected": float(run["rejected"].sum()) / float(run.sizes["agent"]),
        "scalars": float(run["scalars"].sum()) / DURATION / n,
    }


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """Scores of all rows on one generated set."""
    data = read_set(np.random.default_rng(seed))
    values = {}
    for row in ROWS:
        with warnings.catch_warnings():
            # Rows that lose their target warn; their scores say it too.
            warnings.simplefilter("ignore", RuntimeWarning)
            run = run_row(data, row)
        scores = score(run, len(data.robots))
        values |= {f"{row}_{name}": value for name, value in scores.items()}
    return {name: float(f"{value:.6g}") for name, value in values.items()}


def fit(data: datasets.Dataset, place: float, heading: float, std: float) -> float:
    """Return the log-likelihood of all ranges under one filter, by the noise it assumes.

    A range outside the gate counts with the density of "anywhere up to 12 m".
    """
    anchors = data.of_kind("survey").set_index("subject")
    ranges = datasets.list_observations(data, "range", std, anchors=anchors)
    model = planar_odometry(*data.body_rates(), sigma=(place, heading))
    f = filters.GaussianFilter(
        model, [None], gate_probability=GATE, record_evidence=True
    )
    events = [o.replace(agent=0) for o in ranges]
    run = f.run(f.start(data.prior_poses()), None, events)
    rejected = float(run["rejected"].sum())
    return float(run["log_likelihood"].sum()) - np.log(12.0) * rejected


def choose_noise(
    sets: list[datasets.Dataset], candidates: dict[str, tuple[float, ...]]
) -> tuple[dict[str, float], float]:
    """Return the noise with the largest sum of log-likelihoods, one number after the other."""
    chosen = {name: values[0] for name, values in candidates.items()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for name, values in 2 * list(candidates.items()):
            fits = {
                value: sum(fit(data, **{**chosen, name: value}) for data in sets)
                for value in values
            }
            chosen[name] = max(fits, key=fits.get)
    return chosen, max(fits.values())


# How the example's noise was chosen, on four sets that the study does not use
CANDIDATES = {
    "place": (0.03, 0.015, 0.02, 0.045, 0.06),
    "heading": (0.015, 0.007, 0.01, 0.022, 0.03),
    "std": (0.15, 0.1, 0.12, 0.2, 0.25),
}
TUNING_SEEDS = np.random.SeedSequence(1400).spawn(4)

METRICS = ("rmse", "nees", "rejected", "scalars")
columns = [f"{row}_{metric}" for row in ROWS for metric in METRICS]
parameters = {
    "duration": DURATION,
    "after": AFTER,
    "gate": GATE,
    "drift": example["DRIFT"],
    "range_std": example["RANGE_STD"],
    "range_std_with_bias": RANGE_STD_WITH_BIAS,
    "bias_std": BIAS_STD,
}
code = [read_set, add_bias, make_filter, run_row, true_component, score]
seeds = np.random.SeedSequence(1401).spawn(16)
rtol = 1e-3
