"""Seven filters, one loop: six on one network of walkers, one on a swarm's density."""

from functools import partial
from typing import Any

import numpy as np

from distfilt import filters
from distfilt.density import Flooding, FokkerPlanck, Grid
from distfilt.mixtures import target_fusion
from distfilt.models import constant_velocity, rotating_swarm, simulate
from distfilt.network import covariance_intersection, graphs
from distfilt.sensors import component

walk = constant_velocity(sigma=0.1)
rng = np.random.default_rng(0)
times = np.arange(1, 31) * 0.5
sensors = [component([k % 2], std=0.5) for k in range(4)]
net = graphs.ring(4)
prior = (np.zeros(4), np.diag([4.0, 4.0, 0.2, 0.2]))
truth = simulate(walk, rng.multivariate_normal(*prior), times, rng=rng)
# Four agents on a ring observe a walker.
walkers = prior, truth, [sensor.observe(truth, rng=rng) for sensor in sensors]
# Forty agents of a swarm estimate its density.
swarm = rotating_swarm("gibbs")
grid = Grid((12, 12))
first = rng.random((40, 2))
law = FokkerPlanck(swarm, grid)
path = swarm.simulate(first, times, rng=rng, substeps=5)
crowd = first, law.evolve(np.ones(144), times), path.swapaxes(0, 1)

# Each filter with the input of its problem: prior, truth, observations.
fuse = partial(target_fusion, target_dim=4)
intersect = covariance_intersection

problems: dict[str, tuple[Any, Any]] = {
    "ensemble": (filters.EnsembleFilter(walk, sensors, net), walkers),
    "gaussian": (filters.GaussianFilter(walk, sensors, net, fusion=intersect), walkers),
    "particle": (filters.ParticleFilter(walk, sensors, net, members=2000), walkers),
    "transport": (
        filters.TransportFilter(walk, sensors, net, rejuvenation=0.2),
        walkers,
    ),
    "mixture": (
        filters.MixtureFilter(walk, sensors, net, fusion=fuse, target_dim=4),
        walkers,
    ),
    "increment": (
        filters.InformationIncrementFilter(walk, sensors, net, target_dim=4),
        walkers,
    ),
    "density": (
        filters.DensityFilter(law, 40, 0.4, fusion=Flooding(), bandwidth=0.12),
        crowd,
    ),
}
print("filter      error   NEES/d  floats")
for name, (f, (prior, truth, observations)) in problems.items():
    state = f.start(prior, rng=np.random.default_rng(1))
    run = f.run(state, times, observations, truth=truth)
    late = run.isel(time=slice(10, None))
    error = np.sqrt(late["squared_error"].mean())
    nees = late["nees"].mean() / len(run["component"]) if "nees" in run else np.nan
    print(f"{name:9s} {error:7.3f} {nees:8.2f} {run['scalars_total'][-1].sum():8d}")
