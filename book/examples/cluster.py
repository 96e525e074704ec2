"""A study on this machine's cores, on a Dask cluster or under MPI."""

import sys
from concurrent.futures import Executor
from typing import Any

import numpy as np

from bookkit import studies
from distfilt.filters import EnsembleFilter
from distfilt.models import constant_velocity, simulate
from distfilt.network import graphs
from distfilt.sensors import distance

PARAMETERS: dict[str, Any] = {"sigma": 0.1, "std": 0.3, "members": 60}
COLUMNS = ["squared_error", "variance"]
model = constant_velocity(sigma=PARAMETERS["sigma"])
std = PARAMETERS["std"]
sensors = [distance([0, 1], std=std, origin=(x, 9)) for x in (0, 3, 6, 9)]
members = PARAMETERS["members"]
f = EnsembleFilter.exact(model, sensors, graphs.ring(4), members=members)


def trial(seed: np.random.SeedSequence) -> list[float]:
    """Run the filter once; return mean squared error and reported variance, m²."""
    rng = np.random.default_rng(seed)
    times = np.arange(1, 11) * 0.5
    truth = simulate(model, [4.0, 4.0, 0.1, 0.0], times, rng=rng)
    observed = [sensor.observe(truth, rng=rng) for sensor in sensors]
    state = f.start(([4, 4, 0, 0], np.diag([1, 1, 0.1, 0.1])), rng=rng)
    run = f.run(state, times, observed, truth=truth)
    return [float(run[name][5:, :, :2].mean()) for name in COLUMNS]


def executor(where: str) -> Executor | None:
    """Return the executor that runs the trials; None uses this machine's cores."""
    if where == "dask":
        import dask.distributed as dask

        client: Any = dask.Client
        pool: Executor = client(scheduler_file="cluster.json").get_executor()
        return pool
    if where == "mpi":
        from mpi4py.futures import MPIPoolExecutor

        return MPIPoolExecutor()
    return None


if __name__ == "__main__":
    # cluster.py WHERE [FIRST LAST]: all trials, or those of a range
    where, *bounds = sys.argv[1:]
    indices = range(*map(int, bounds)) if bounds else None
    path = studies.store(
        "errors.csv",
        trial,
        studies.spawn(2026, 40),
        columns=COLUMNS,
        parameters=PARAMETERS,
        executor=executor(where),
        indices=indices,
    )
    print(path)
