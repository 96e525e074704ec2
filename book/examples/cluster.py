"""A study on this machine's cores, on a Dask cluster or under MPI."""

import sys

import numpy as np

from bookkit import studies
from distfilt.filters import EnsembleFilter
from distfilt.models import constant_velocity, simulate
from distfilt.network import graphs
from distfilt.sensors import distance

S = {"sigma": 0.1, "std": 0.3, "members": 60}
COLUMNS = ["squared_error", "variance"]
model = constant_velocity(sigma=S["sigma"])
sensors = [distance([0, 1], std=S["std"], origin=(x, 9)) for x in (0, 3, 6, 9)]
f = EnsembleFilter.exact(model, sensors, graphs.ring(4), members=S["members"])


def trial(seed):
    """One truth, its readings, a run: squared error and the claimed, m²."""
    rng = np.random.default_rng(seed)
    times = np.arange(1, 11) * 0.5
    truth = simulate(model, [4.0, 4.0, 0.1, 0.0], times, rng=rng)
    seen = [sensor.observe(truth, rng=rng) for sensor in sensors]
    state = f.start(([4, 4, 0, 0], np.diag([1, 1, 0.1, 0.1])), rng=rng)
    run = f.run(state, times, seen, truth=truth)
    return [float(run[name][5:, :, :2].mean()) for name in COLUMNS]


def executor(where):
    """Where trials run: this machine's cores unless it says otherwise."""
    if where == "dask":
        from dask.distributed import Client

        return Client(scheduler_file="cluster.json").get_executor()
    if where == "mpi":
        from mpi4py.futures import MPIPoolExecutor

        return MPIPoolExecutor()


if __name__ == "__main__":
    where, *some = sys.argv[1:]
    print(
        studies.store(
            "errors.csv",
            trial,
            studies.spawn(2026, 40),
            columns=COLUMNS,
            parameters=S,
            executor=executor(where),
            indices=range(*map(int, some)) if some else None,
        )
    )
