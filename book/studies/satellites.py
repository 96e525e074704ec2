"""Tables II and III of Grange et al.: the paper's filter and better ones, one run a trial.

`make studies` runs a hundred trials. Each stores, for both tables, every filter and every agent,
the squared error, NEES and CRPS of the settled half, and how far the agents' means are apart; for
Fig. 2 also the error at each whole second.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from distfilt import ensembles
from distfilt.filters import EnsembleFilter
from distfilt.filters.agreement import intersection_agreement
from distfilt.models import Model, simulate
from distfilt.models.attitude import satellite_pose
from distfilt.models.satellite import clohessy_wiltshire
from distfilt.network import Graph
from distfilt.network.consensus import mean_pull
from distfilt.published import scenario
from distfilt.sensors import of_kind
from distfilt.studies import spawn
from distfilt.triangular.conditioning import affine_update, pca_update
from distfilt.triangular.regularised import known_noise_update

NAME, PAPER = "satellites", "grange"
TABLES = {"II": scenario(PAPER, "table-2"), "III": scenario(PAPER, "table-3")}
FILTERS = ("pca", "bare", "affine_ci", "pca_ci", "known_ci", "known_alone")
SCORES = ("mse", "nees", "crps")
SECONDS = range(1, 21)
# Metres and metres a second, radians a second and quaternions, by their spread in the prior.
SCALES = {"II": [5.0] * 6, "III": [5.0] * 6 + [0.2] * 7}


def agents(table: str) -> list[str]:
    """Names of a table's agents."""
    return [agent.name for agent in TABLES[table].agents]


columns = [
    *(f"{t}_{f}_{s}_{a}" for t in TABLES for f in FILTERS for s in SCORES for a in agents(t)),
    *(f"{t}_{f}_apart" for t in TABLES for f in FILTERS),
    *(f"III_pca_t{k:02d}_{a}" for k in SECONDS for a in agents("III")),
]
parameters = {"runs": 100, "seed": 2024, "integration_step": 0.1}
seeds = spawn(parameters["seed"], parameters["runs"])
rtol = 1e-4


def model(table: str) -> Model:
    """The position's model, or the pose's."""
    s = TABLES[table]
    options = {"rate": s["orbital_rate"], "sigma": s["process_noise"]}
    if table == "II":
        return clohessy_wiltshire(**options)
    return satellite_pose(**options, step=parameters["integration_step"])


def network(table: str, name: str) -> EnsembleFilter:
    """A table's agents with one of the filters."""
    s = TABLES[table]
    reduced = partial(pca_update, n_state=s["pca_state"], n_observed=s["pca_observation"])
    pull = partial(mean_pull, gain=s["gain"], include_self=s["consensus_includes_self"])
    fuse = partial(intersection_agreement, weights="trace", scale=SCALES[table])
    update, consensus = {
        "pca": (reduced, pull),
        "bare": (affine_update, pull),
        "affine_ci": (affine_update, fuse),
        "pca_ci": (reduced, fuse),
        "known_ci": (known_noise_update, fuse),
        "known_alone": (known_noise_update, None),
    }[name]
    sensors = [of_kind(a.kind, a.dims, noise=a.noise) for a in s.agents]
    graph = Graph.from_adjacency(s.adjacency)
    return EnsembleFilter(model(table), sensors, graph, update, consensus, members=s["members"])


def data(
    table: str, rng: np.random.Generator, runs: tuple[int, ...] = ()
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Times, the truth (T, *runs, d) at them, and each agent's observations."""
    s = TABLES[table]
    dt, x0 = s["dt_observe"], np.array(s["initial_state"])
    times = np.round(np.arange(1, round(s["end_time"] / dt) + 1) * dt, 10)
    start = np.broadcast_to(x0, (*runs, x0.size))
    truth = simulate(model(table), start, times, rng=rng)
    before = np.concatenate([start[None], truth[:-1]])
    seen = [
        sensor.observe(truth, rng=rng, previous=before if sensor.uses_previous else None)
        for sensor in network(table, "bare").sensors
        if sensor is not None
    ]
    return times, truth, seen


def prior(table: str) -> Callable[..., np.ndarray]:
    """What draws the first members."""
    s, x0 = TABLES[table], np.array(TABLES[table]["initial_state"])
    if table == "II":
        offset, variance = s["prior_offset"], s["prior_variance"] * np.ones(6)
    else:
        parts = ("translation", "attitude")
        offset = np.repeat([s[f"prior_offset_{p}"] for p in parts], [6, 7])
        variance = np.repeat([s[f"prior_variance_{p}"] for p in parts], [6, 7])
    return partial(ensembles.draw, x0 + offset, np.diag(variance))


def scored(table: str, name: str, run: Any) -> dict[str, float]:
    """The stored numbers of one filter's run."""
    settled = run.sel(time=slice(TABLES[table]["average_from"] + 0.05, None))
    per_agent = {
        "mse": settled["squared_error"].mean("time"),
        "nees": settled["nees"].mean("time"),
        "crps": settled["crps"].mean(("time", "component")),
    }
    out = {
        f"{table}_{name}_{score}_{a}": float(value[k])
        for score, value in per_agent.items()
        for k, a in enumerate(agents(table))
    }
    gap = settled["mean"] - settled["mean"].mean("agent")
    out[f"{table}_{name}_apart"] = float((gap**2).sum("component").mean())
    if (table, name) == ("III", "pca"):
        for second in SECONDS:
            error = run["squared_error"].sel(time=second, method="nearest")
            for k, a in enumerate(agents(table)):
                out[f"III_pca_t{second:02d}_{a}"] = float(error[k])
    return out


def trial(seed: np.random.SeedSequence) -> list[float]:
    """One run of every filter on the same data, for both tables."""
    out: dict[str, float] = {}
    for table, part in zip(TABLES, seed.spawn(2), strict=True):
        for_data, for_filters = part.spawn(2)
        times, truth, seen = data(table, np.random.default_rng(for_data))
        for name in FILTERS:
            f = network(table, name)
            start = f.start(prior(table), rng=np.random.default_rng(for_filters))
            out |= scored(table, name, f.run(start, times, seen, truth=truth))
    return [out[c] for c in columns]


code = (agents, model, network, data, prior, scored)
