"""One loop for all filters of chapter 11: run them on the same data, score, compare.

Filters draw from generators of their own, so that any of them can be run again alone.
"""

from __future__ import annotations

import sys
import warnings
import zlib
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from _together_cells import CELLS, cell_names
from _together_filters import GridFilter
from _together_problems import (
    BATCH,
    FOUR,
    STUDY,
    THREE,
    TUNED,
    Data,
    Problem,
    problem,
)

from distfilt import metrics
from distfilt.ensembles import sample_covariance
from distfilt.filters import GaussianFilter, ParticleFilter

Array = np.ndarray
Seed = np.random.SeedSequence

SCORES = ("error", "nees", "crps")
UNCERTAIN = ("pf_", "ot_", "maps_", "ekf_", "reference", "half", "gm_")
"""Beginnings of the columns in which a last bit may decide, as which particle is drawn."""


def stream(seed: Seed, name: str) -> np.random.Generator:
    """Return a generator that belongs to a name, whatever else the seed serves."""
    # The name's checksum extends the spawn key.
    key = (*seed.spawn_key, zlib.crc32(name.encode()))
    return np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=key))


def draw_data(p: Problem, seed: Seed, runs: int = BATCH) -> Data:
    """Return the truths and observations of one trial."""
    return p.simulate(runs, stream(seed, "data"))


# ---------------------------------------------------------------------------------------- scores


def prior_of(p: Problem, local: bool) -> tuple[Array, Array]:
    """Return the prior of a problem, or that of the agents' own problem."""
    return p.local.prior if local and p.local else p.prior


def score_filter(
    p: Problem,
    f: Any,
    data: Data,
    rng: Any,
    *,
    one_by_one: bool = False,
    local: bool = False,
    scores: tuple[str, ...] = ("squared_error", "nees"),
) -> dict[str, Any]:
    """Run a filter on the data; return each run's scores, and the numbers sent a step.

    ``error`` is the mean squared error of the scored components, ``nees`` the NEES per
    component, ``crps`` their sum of CRPS; all are means over agents and over the times
    after the burn-in. ``floats`` counts the numbers that an agent sends in a step. With
    `one_by_one` the filter follows one run at a time.
    """
    truth, observed = data
    runs = truth.shape[1]
    names = p.scored_truth(truth)
    collected: dict[str, list[Array]] = {name: [] for name in SCORES}
    batches: Iterable[Any] = range(runs) if one_by_one else [slice(None)]
    for batch in batches:
        state = f.start(
            prior_of(p, local),
            rng=rng if f.requires_rng else None,
            runs=() if one_by_one else (runs,),
        )
        run = f.run(
            state,
            p.times,
            [values[:, batch] for values in observed],
            truth={name: values[:, batch] for name, values in names.items()},
            scores=scores,
        )
        for name, values in mean_scores(p, run).items():
            collected[name].append(values)
    result = {name: np.ravel(values) for name, values in collected.items() if values}
    # Numbers sent by one agent in one step
    sent = run["scalars_total"].values[-1].sum() / p.n_agents / len(p.times)
    return result | {"floats": float(sent)}


def mean_scores(p: Problem, run: Any) -> dict[str, Array]:
    """Return the scores in a run's record, means over agents and times."""
    late = run.isel(time=slice(p.burn_in, None))
    # A run that failed once, at one agent, has no mean.
    means = late.mean(("time", "agent"), skipna=False)
    components = means.sel(component=list(p.scored))
    scores = {}
    if "squared_error" in means:
        scores["error"] = components["squared_error"].sum("component").values
    if "nees" in means:
        scores["nees"] = means["nees"].values / len(p.scored)
    if "crps" in means:
        scores["crps"] = components["crps"].sum("component").values
    return scores


def log_scores(
    p: Problem, f: Any, data: Data, rng: Any, *, local: bool = False
) -> Array:
    """Return minus the log-density of the truth, by each run's means and covariances.

    Tuning minimizes it. Means over agents and over the times after the burn-in, of the
    scored components; infinite where a filter fails or a cloud has no width.
    """
    truth, observed = data
    state = f.start(
        prior_of(p, local),
        runs=truth.shape[1:2],
        rng=rng if f.requires_rng else None,
    )
    names = list(f.model.names)
    indices = [names.index(name) for name in p.scored]
    values = np.stack(list(p.scored_truth(truth).values()), axis=-1)
    scores = []
    for k, current in enumerate(f.steps(state, p.times, observed)):
        if k < p.burn_in:
            continue
        summary = f.summarize(current)
        cov = summary.covariance
        if cov is None:
            cov = sample_covariance(summary.members)
        mean = summary.mean[..., indices]
        cov = cov[..., indices, :][..., indices]
        target = np.broadcast_to(values[k][:, None], mean.shape)
        scores.append(gaussian_log_scores(mean, cov, target).mean(axis=-1))
    return np.mean(scores, axis=0)


def gaussian_log_scores(mean: Array, cov: Array, truth: Array) -> Array:
    """Return log scores of Gaussians; infinite where one is not finite or has no width."""
    usable = np.isfinite(mean).all(axis=-1) & np.isfinite(cov).all(axis=(-2, -1))
    variance = np.diagonal(cov, axis1=-2, axis2=-1)
    std = np.sqrt(np.where(usable[..., None], variance, 1.0))
    usable &= (std > 0).all(axis=-1)
    # The width is judged by the correlation matrix, whatever the units.
    scale = std[usable][:, :, None] * std[usable][:, None, :]
    correlation = cov[usable] / scale
    usable[usable] = np.linalg.eigvalsh(correlation)[:, 0] > 1e-12
    scores = np.full(usable.shape, np.inf)
    scores[usable] = metrics.log_score(mean[usable], cov[usable], truth[usable])
    return scores


@cache
def tuned_value(name: str, cell: str) -> float:
    """Return a cell's tuned value for a problem; for one held out the upper median of the four."""
    table = {row["name"]: row["value"] for row in TUNED.tables.get("tuned", ())}
    if name in THREE:
        values = [
            tuned_value(other, cell)
            for other in FOUR
            if not CELLS[cell].why_excluded(other)
        ]
        return sorted(values)[len(values) // 2] if values else 0.0
    default = 1.0 if CELLS[cell].option == "inflation" else 0.0
    return float(table.get(f"{name}_{cell}", default))


# --------------------------------------------------------------------------------------- columns


def score_columns(names: Iterable[str], runs: int = BATCH) -> list[str]:
    """Return the columns of some cells."""
    each = [f"{score}_{r}" for score in ("error", "nees") for r in range(runs)]
    return [f"{name}_{key}" for name in names for key in ("floats", *each)]


def ill_conditioned_columns(names: Iterable[str]) -> list[str]:
    """Return the columns that another processor need not repeat."""
    return [c for c in score_columns(names) if c.startswith(UNCERTAIN)]


def measure(
    p: Problem, cell: str, f: Any, data: Data, seed: Seed, prefix: str = ""
) -> dict[str, float]:
    """Return a filter's errors and NEES run by run, and its floats; NaN where it fails."""
    name = prefix + cell
    local = cell in CELLS and CELLS[cell].local
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            scores = score_filter(p, f, data, stream(seed, name), local=local)
        except (ValueError, ArithmeticError, RuntimeError) as error:
            print(f"{p.name}, {name}: {error}", file=sys.stderr)
            nan = np.full(data[0].shape[1], np.nan)
            scores = {"error": nan, "nees": nan, "floats": np.nan}
    columns = {f"{name}_floats": scores["floats"]}
    for key in ("error", "nees"):
        for r, value in enumerate(scores[key]):
            columns[f"{name}_{key}_{r}"] = value
    # Six digits are enough to store.
    return {key: float(f"{value:.6g}") for key, value in columns.items()}


def references(p: Problem) -> dict[str, Any]:
    """Return filters of all observations in one place; ``reference`` is the best of them."""
    central = (p.model, [p.all_sensors])
    if not {"curved", "chaotic"} & set(p.traits):
        return {"reference": GaussianFilter(*central)}
    if p.model.dim == 2:
        return {
            "reference": GridFilter(*central, cells=STUDY["reference_cells"]),
            "half": GridFilter(*central),
        }
    many = STUDY["reference"]
    return {
        "reference": ParticleFilter(*central, members=many),
        "half": ParticleFilter(*central, members=many // 2),
    }


def measure_references(
    p: Problem, seed: Seed, data: Data, *, half: bool = True
) -> dict[str, float]:
    """Return the references' columns, by default with those of half the effort."""
    # One agent has the stacked sensor of all.
    one = replace(p, sensors=[p.all_sensors], graph=None, local=None)
    joint = data[0], [np.concatenate(data[1], axis=-1)]
    columns: dict[str, float] = {}
    for name, f in references(p).items():
        if half or name == "reference":
            columns |= measure(one, name, f, joint, seed)
    if half and "half_floats" in columns and p.model.dim == 2:
        # Agents that flood all observations and use one grid are that grid.
        columns |= {
            key.replace("half", "grid_flood"): value
            for key, value in columns.items()
            if "half" in key
        }
        columns["grid_flood_floats"] = np.nan
    return columns


def measure_cells(name: str, seed: Seed, cells: Iterable[str]) -> dict[str, float]:
    """Return the columns of some cells of a problem, tuned, on the data of one trial."""
    p = problem(name)
    data = draw_data(p, seed)
    columns: dict[str, float] = {}
    for cell in cells:
        # `measure_references` has it already.
        if cell == "grid_flood":
            continue
        f = CELLS[cell].make(p, tuned_value(name, cell))
        columns |= measure(p, cell, f, data, seed)
    # Flooding sends the same numbers whatever the filter.
    if "ekf_flood_floats" in columns and p.model.dim == 2:
        columns["grid_flood_floats"] = columns["ekf_flood_floats"]
    return columns


def run_problem(name: str, seed: Seed) -> dict[str, float]:
    """Return the columns of the references and of all cells of a problem."""
    p = problem(name)
    columns = measure_references(p, seed, draw_data(p, seed))
    return columns | measure_cells(name, seed, cell_names(name))


def make_seeds(runs: int = STUDY["runs"]) -> list[Seed]:
    """Return the trials' seeds for a number of runs."""
    return np.random.SeedSequence(STUDY["seed"]).spawn(runs // BATCH)
