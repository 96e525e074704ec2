"""Fig. 1 of Grange et al. with other values of the inputs that the paper does not print.

The number of members of the claim about small samples, the gain, the meaning of σ, how
an angle wraps, and line 8 of Algorithm 2 as printed: one input at a time, on the 100
truths and observations of `figure_1.py`. Only the settled errors and NEES are stored.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import _satellites as satellites

from distfilt.filters import EnsembleFilter
from distfilt.updates import principal_components, principal_directions, update

NAME = "figure-1-inputs"
PAPER = "grange"
SETUP = satellites.setup("table-2")
# Ten batches of figure_1.py in one, since many runs cost little more than a few; one
# for the short trials of a scenario that a reader has changed.
PARTS = 1 if SETUP.is_changed else 10
BATCH = 5 * PARTS
VERSIONS = {"bare": False, "pca": True}
MEMBERS = (8, 9, 11, 20, 30)
GAINS = {"g00": 0.0, "g01": 0.01, "g10": 0.1, "g30": 0.3}
WRAPS = ("together", "never", "innovation")
# Noise of standard deviation σ in each step: Q = σ² I is the Q of σ / sqrt(Δ) per √s.
STEP_NOISE = float(0.2 / np.sqrt(SETUP.scenario["dt_observe"]))
NOISY = satellites.setup("table-2", process_noise=STEP_NOISE)
# Which of an agent's numbers are angles, by how many it receives: C receives none.
ANGLE_OF_SIZE = {}
for links in SETUP.scenario.adjacency + np.eye(len(SETUP.sensors)):
    received = [q for q, link in zip(SETUP.sensors, links, strict=True) if link]
    is_angle = np.concatenate([[q.wraps] * q.dim for q in received])
    if is_angle.any():
        ANGLE_OF_SIZE[is_angle.size] = np.flatnonzero(is_angle)
# Few members have no NEES, as their covariance is singular; nor has line 8 as printed.
UNSCORED = [f"m{n:02d}_{v}" for n in MEMBERS for v in VERSIONS]
UNSCORED += [f"m{n:02d}_together_{v}" for n in (8, 13) for v in VERSIONS]
UNSCORED += ["printed_pca"]
SCORED = [f"{case}_{v}" for case in (*GAINS, *WRAPS, "step") for v in VERSIONS]
columns = [f"{name}_mse_{r}" for name in UNSCORED for r in range(BATCH)]
for scored in SCORED:
    columns += satellites.score_columns(SETUP, scored, BATCH, each_agent=False)
parameters = {
    "batch": BATCH,
    "seed": 2024,
    "members": list(MEMBERS),
    "gains": list(GAINS.values()),
    "step_noise": STEP_NOISE,
}
seeds = np.random.SeedSequence([satellites.SEED, 1]).spawn(SETUP.runs // BATCH)
scenarios = (SETUP.scenario,)
rtol = 1e-3
# A run that diverges does so from its last bit on.
ill_conditioned = [c for c in columns if c.startswith(("m", "printed", "innovation"))]
max_outliers = 40


@update
def wrap_innovations(
    ensemble: np.ndarray,
    predicted: np.ndarray,
    observed: np.ndarray,
    noise: np.ndarray,
    *,
    rng: np.random.Generator,
    n_state: int | None = None,
    n_observed: int | None = None,
) -> np.ndarray:
    """Algorithm 2 with a gain from angles as they are, and innovations that wrap.

    Without numbers of components to keep, all are kept: the map of Algorithm 1.
    """
    d = ensemble.shape[-1]
    m = predicted.shape[-1]
    # y_i = h(x_i) + ζ_i
    stds = np.sqrt(np.diagonal(noise, axis1=-2, axis2=-1))
    noisy = predicted + stds[..., None, :] * rng.standard_normal(predicted.shape)
    w = principal_directions(ensemble, n_state or d)
    v = principal_directions(noisy, min(n_observed or m, m))
    dx = (ensemble - ensemble.mean(axis=-2, keepdims=True)) @ w
    dy = (noisy - noisy.mean(axis=-2, keepdims=True)) @ v
    # Kᵀ = (dYᵀ dY)⁻¹ dYᵀ dX
    gain = np.linalg.solve(dy.mT @ dy, dy.mT @ dx)
    innovations = observed[..., None, :] - noisy
    if m in ANGLE_OF_SIZE:
        # The angle of a line has period π.
        k = ANGLE_OF_SIZE[m]
        innovations[..., k] = (innovations[..., k] + np.pi / 2) % np.pi - np.pi / 2
    return np.asarray(ensemble + innovations @ v @ gain @ w.mT)


def filter_with_wrap(wrap: str, *, pca: bool) -> EnsembleFilter:
    """Return the paper's filter with another treatment of the angle."""
    f = satellites.paper_filter(SETUP, pca=pca, angles="together")
    if wrap == "together":
        return f
    # Without a period the numbers in (-π/2, π/2) are subtracted as they are.
    sensors = tuple(
        replace(sensor, periods=()) if sensor.wraps else sensor
        for sensor in SETUP.sensors
    )
    f = f.replace(sensors=sensors)
    if wrap == "innovation":
        f = f.replace(update=partial(wrap_innovations, **(SETUP.pca if pca else {})))
    return f


def filters() -> Iterator[tuple[str, EnsembleFilter]]:
    """Yield the filters that run on the data of Fig. 1, by their names."""
    for v, pca in VERSIONS.items():
        for wrap in WRAPS:
            yield f"{wrap}_{v}", filter_with_wrap(wrap, pca=pca)
        for name, gain in GAINS.items():
            yield f"{name}_{v}", satellites.paper_filter(SETUP, pca=pca, gain=gain)
        for n in MEMBERS:
            yield f"m{n:02d}_{v}", satellites.paper_filter(with_members(n), pca=pca)
        # Both small sizes of the claim with the other treatment of angles
        for n in (8, 13):
            f = satellites.paper_filter(with_members(n), pca=pca, angles="together")
            yield f"m{n:02d}_together_{v}", f
    # Line 8 of Algorithm 2 drops the part outside the leading directions.
    rule = partial(principal_components, complement="literal", **SETUP.pca)
    f = satellites.paper_filter(SETUP, pca=True)
    yield "printed_pca", f.replace(update=satellites.align_each(rule))


def with_members(n: int) -> satellites.Setup:
    """Return the set-up with another number of members."""
    return replace(SETUP, members=n)


def run_case(
    s: satellites.Setup,
    name: str,
    f: EnsembleFilter,
    seed: np.random.SeedSequence,
    data: tuple[np.ndarray, list[np.ndarray]],
) -> dict[str, float]:
    """Settled errors of one case, and NEES where the covariances have an inverse."""
    scores = ("squared_error", "nees") if name in SCORED else ("squared_error",)
    result = satellites.run_filter(s, f, seed, *data, scores)
    return satellites.score_runs(s, name, result, each_agent=False)


def draw_batches(
    s: satellites.Setup, seed: np.random.SeedSequence
) -> tuple[np.ndarray, list[np.ndarray]]:
    """The truths and observations of ten batches of `figure_1.py`, side by side."""
    # The seed's number says which ten.
    first = PARTS * seed.spawn_key[-1]
    of_figure = np.random.SeedSequence(satellites.SEED).spawn(PARTS + first)[first:]
    truths = []
    observations = []
    for batch in of_figure:
        # As in the trial of figure_1.py
        for_data, _ = batch.spawn(2)
        rng = np.random.default_rng(for_data)
        truth, seen = satellites.draw_data(s, rng, (BATCH // PARTS,))
        truths.append(truth)
        observations.append(seen)
    # Runs are the second axis.
    by_sensor = zip(*observations, strict=True)
    return (
        np.concatenate(truths, axis=1),
        [np.concatenate(batches, axis=1) for batches in by_sensor],
    )


def trial(seed: np.random.SeedSequence) -> dict[str, float]:
    """A batch of runs of every case on the same data; σ of a step has data of its own."""
    data = draw_batches(SETUP, seed)
    values: dict[str, float] = {}
    for name, f in filters():
        values |= run_case(SETUP, name, f, seed, data)
    # The truth has the larger noise as well as the members.
    data = draw_batches(NOISY, seed)
    for v, pca in VERSIONS.items():
        f = satellites.paper_filter(NOISY, pca=pca)
        values |= run_case(NOISY, f"step_{v}", f, seed, data)
    return values


def part(seed: np.random.SeedSequence) -> dict[str, float]:
    """The filter with angles on one branch, as in the trial, for chapter 4 to run again."""
    f = filter_with_wrap(WRAPS[0], pca=False)
    return run_case(SETUP, f"{WRAPS[0]}_bare", f, seed, draw_batches(SETUP, seed))


code = (
    draw_batches,
    satellites.draw_data,
    satellites.paper_filter,
    satellites.align_each,
    satellites.score_runs,
    wrap_innovations,
    filter_with_wrap,
    filters,
    run_case,
)
