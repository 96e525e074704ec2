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
from _together_cells import CELLS, cell_names, square_grid
from _together_problems import (
    BATCH,
    STUDY,
    TUNED,
    Data,
    Problem,
    problem,
)

from distfilt.filters import GaussianFilter, GridFilter, ParticleFilter

Array = np.ndarray
Seed = np.random.SeedSequence

SCORES = ("error", "nees", "crps")
UNCERTAIN = (
    "pf_",
    "ot_",
    "maps_",
    "ekf_",
    "reference",
    "half",
    "gm_",
    "sum",
    "ukf_",
    "iekf",
)
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
    after the burn-in. ``floats`` counts the numbers that an agent sends in a step, on
    each link anew; ``cast`` counts them by broadcast, where all neighbours receive one
    transmission. With `one_by_one` the filter follows one run at a time.
    """
    # One run at a time for filters of the library that follow single runs.
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
    # Numbers sent by one agent in one step, by both bills
    for key, name in (("floats", "scalars_total"), ("cast", "broadcast_scalars_total")):
        sent = run[name].values[-1].sum()
        result[key] = float(sent) / p.n_agents / len(p.times)
    return result


def mean_scores(p: Problem, run: Any) -> dict[str, Array]:
    """Return the scores in a run's record, means over agents and times."""
    late = run.isel(time=slice(p.burn_in, None))
    # A run that failed once, at one agent, has no mean.
    means = late.mean(("time", "agent"), skipna=False)
    components = means.sel(component=list(p.scored))
    scores = {}
    # The squared error is that of the whole position, or of the whole state. A run that
    # failed has none: by default NaN would count as zero.
    if "squared_error" in means:
        errors = components["squared_error"].sum("component", skipna=False)
        scores["error"] = errors.values
    if "nees" in means:
        scores["nees"] = means["nees"].values / len(p.scored)
    if "crps" in means:
        scores["crps"] = components["crps"].sum("component", skipna=False).values
    return scores


def best_value(errors: Array, nees: Array) -> int:
    """Return which of some tried values the tuning keeps, by their mean scores.

    The rule is that of the table of results: the least error of those whose NEES per
    component is near one. A filter without such a value keeps that of least error.
    """
    candidates = np.where(near_one(nees), errors, np.inf)
    if not np.isfinite(candidates).any():
        candidates = np.where(np.isfinite(errors), errors, np.inf)
    # Of values that err alike, to a thousandth, the first.
    return int(np.flatnonzero(candidates <= candidates.min() * 1.001)[0])


def near_one(nees: Array) -> Array:
    """Return where a NEES per component counts as that of a consistent filter in tuning."""
    low, high = STUDY["tuned_nees"]
    return np.asarray((nees >= low) & (nees <= high))


def values_that_count(errors: Array, nees: Array) -> set[int]:
    """Return the values whose neighbours should be tried: the best one so far.

    Where none is consistent, that whose NEES is nearest to one counts too.
    """
    # The best of those tried so far
    counted = {best_value(errors, nees)}
    if not near_one(nees).any():
        with np.errstate(divide="ignore"):
            counted.add(int(np.abs(np.log(nees)).argmin()))
    return counted


@cache
def tuned_value(name: str, cell: str) -> float:
    """Return a cell's tuned value for a problem."""
    table = {row["name"]: row["value"] for row in TUNED.tables.get("tuned", ())}
    default = 1.0 if CELLS[cell].option == "inflation" else 0.0
    return float(table.get(f"{name}_{cell}", default))


# --------------------------------------------------------------------------------------- columns


def score_columns(names: Iterable[str], runs: int = BATCH) -> list[str]:
    """Return the columns of some cells."""
    each = [f"{score}_{r}" for score in ("error", "nees") for r in range(runs)]
    keys = ("floats", "cast", *each)
    return [f"{name}_{key}" for name in names for key in keys]


def ill_conditioned_columns(names: Iterable[str]) -> list[str]:
    """Return the columns that another processor need not repeat."""
    return [c for c in score_columns(names) if c.startswith(UNCERTAIN)]


def measure(
    p: Problem, cell: str, f: Any, data: Data, seed: Seed, prefix: str = ""
) -> dict[str, float]:
    """Return a filter's errors and NEES run by run, and its floats; NaN where it fails."""
    name = prefix + cell
    made = CELLS.get(cell)
    local = made is not None and made.local
    one_by_one = made is not None and made.one_by_one
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            scores = score_filter(
                p, f, data, stream(seed, name), local=local, one_by_one=one_by_one
            )
        except (ValueError, ArithmeticError, RuntimeError) as error:
            print(f"{p.name}, {name}: {error}", file=sys.stderr)
            nan = np.full(data[0].shape[1], np.nan)
            scores = {"error": nan, "nees": nan, "floats": np.nan, "cast": np.nan}
    columns = {f"{name}_{key}": scores[key] for key in ("floats", "cast")}
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
            "reference": GridFilter(
                *central, grid=square_grid(STUDY["reference_cells"])
            ),
            "half": GridFilter(*central, grid=square_grid()),
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
        columns["grid_flood_cast"] = np.nan
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
        for bill in ("floats", "cast"):
            columns[f"grid_flood_{bill}"] = columns[f"ekf_flood_{bill}"]
    return columns


def run_problem(name: str, seed: Seed) -> dict[str, float]:
    """Return the columns of the references and of all cells of a problem."""
    p = problem(name)
    # The same data again for all cells
    columns = measure_references(p, seed, draw_data(p, seed))
    return columns | measure_cells(name, seed, cell_names(name))


def make_seeds(runs: int = STUDY["runs"]) -> list[Seed]:
    """Return the trials' seeds for a number of runs."""
    return np.random.SeedSequence(STUDY["seed"]).spawn(runs // BATCH)
