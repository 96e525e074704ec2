"""Table III of Grange et al.: five agents and the pose of a satellite, one run a trial.

`make studies` runs a hundred trials and stores, for each filter and agent, the error of the settled
half, NEES and CRPS; for Fig. 2 also the error at each whole second.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from distfilt import ensembles
from distfilt.filters import EnsembleFilter
from distfilt.models import simulate
from distfilt.models.attitude import satellite_pose
from distfilt.network import Graph
from distfilt.network.consensus import mean_pull
from distfilt.published import scenario
from distfilt.sensors import of_kind
from distfilt.studies import spawn
from distfilt.triangular.conditioning import affine_update, pca_update

NAME, PAPER = "table-3", "grange"
SETTING = scenario("grange", "table-3")
AGENTS = [agent.name for agent in SETTING.agents]
SECONDS = range(1, round(SETTING["end_time"]) + 1)
PULL = partial(
    mean_pull, gain=SETTING["gain"], include_self=SETTING["consensus_includes_self"]
)
FILTERS: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "pca": (
        partial(
            pca_update,
            n_state=SETTING["pca_state"],
            n_observed=SETTING["pca_observation"],
        ),
        PULL,
    ),
    "bare": (affine_update, PULL),
}
columns = [
    *(f"{f}_{score}_{a}" for f in FILTERS for score in ("mse", "nees", "crps") for a in AGENTS),
    *(f"pca_t{t:02d}_{a}" for t in SECONDS for a in AGENTS),
]
parameters = {"runs": SETTING["runs"], "seed": 2024, "integration_step": 0.1}
seeds = spawn(parameters["seed"], parameters["runs"])
rtol = 1e-6


def network(update: Callable[..., Any], consensus: Callable[..., Any]) -> EnsembleFilter:
    """The five agents with one update and one consensus rule."""
    model = satellite_pose(
        rate=SETTING["orbital_rate"],
        sigma=SETTING["process_noise"],
        step=parameters["integration_step"],
    )
    sensors = [of_kind(a.kind, a.dims, noise=a.noise) for a in SETTING.agents]
    graph = Graph.from_adjacency(SETTING.adjacency)
    return EnsembleFilter(model, sensors, graph, update, consensus, members=SETTING["members"])


def data(
    rng: np.random.Generator, runs: tuple[int, ...] = ()
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Times, the truth (T, *runs, 13) at them, and each agent's observations."""
    dt, x0 = SETTING["dt_observe"], np.array(SETTING["initial_state"])
    times = np.round(np.arange(1, round(SETTING["end_time"] / dt) + 1) * dt, 10)
    f = network(affine_update, PULL)
    truth = simulate(f.model, np.broadcast_to(x0, (*runs, x0.size)), times, rng=rng)
    before = np.concatenate([np.broadcast_to(x0, truth[:1].shape), truth[:-1]])
    seen = [
        s.observe(truth, rng=rng, previous=before if s.uses_previous else None)
        for s in f.sensors
        if s is not None
    ]
    return times, truth, seen


def prior() -> Callable[..., np.ndarray]:
    """What draws the first members."""
    parts = ("translation", "attitude")
    offset = np.repeat([SETTING[f"prior_offset_{p}"] for p in parts], [6, 7])
    variance = np.repeat([SETTING[f"prior_variance_{p}"] for p in parts], [6, 7])
    x0 = np.array(SETTING["initial_state"])
    return partial(ensembles.draw, x0 + offset, np.diag(variance))


def trial(seed: np.random.SeedSequence) -> list[float]:
    """One run of every filter on the same data."""
    for_data, for_filters = seed.spawn(2)
    times, truth, seen = data(np.random.default_rng(for_data))
    out: dict[str, float] = {}
    for name, rule in FILTERS.items():
        f = network(*rule)
        start = f.start(prior(), rng=np.random.default_rng(for_filters))
        run = f.run(start, times, seen, truth=truth)
        settled = run.sel(time=slice(SETTING["average_from"] + 0.05, None))
        for k, a in enumerate(AGENTS):
            of_agent = settled.isel(agent=k)
            out[f"{name}_mse_{a}"] = float(of_agent["squared_error"].mean())
            out[f"{name}_nees_{a}"] = float(of_agent["nees"].mean())
            out[f"{name}_crps_{a}"] = float(of_agent["crps"].mean())
            if name == "pca":
                for t in SECONDS:
                    error = run["squared_error"].sel(time=t, method="nearest")
                    out[f"pca_t{t:02d}_{a}"] = float(error.isel(agent=k))
    return [out[c] for c in columns]


code = (network, data, prior)
