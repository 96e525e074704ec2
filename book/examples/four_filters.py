"""One problem, four filters, one loop: a boat seen by its distance from three beacons."""

import numpy as np

from distfilt.filters import EnsembleFilter, GaussianFilter, ParticleFilter
from distfilt.models import constant_velocity, simulate
from distfilt.network import graphs
from distfilt.sensors import distance

model = constant_velocity(sigma=0.1)
beacons = [[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]]
sensors = [distance([0, 1], std=0.3, origin=place) for place in beacons]
net = graphs.ring(3)
prior = ([4.0, 4.0, 0.0, 0.0], np.diag([4.0, 4.0, 0.25, 0.25]))
times = np.arange(1, 41) * 0.5
rng = np.random.default_rng(0)
truth = simulate(model, rng.multivariate_normal(*prior, size=20), times, rng=rng)
seen = [sensor.observe(truth, rng=rng) for sensor in sensors]

filters = {
    "extended": GaussianFilter(model, sensors, net, rule="extended"),
    "unscented": GaussianFilter(model, sensors, net, rule="unscented"),
    "ensemble": EnsembleFilter(model, sensors, net, members=60),
    "particles": ParticleFilter(model, sensors, net, members=2000),
}
for name, f in filters.items():
    run = f.run(f.start(prior, rng=np.random.default_rng(1), runs=(20,)), times, seen, truth=truth)
    error = np.sqrt(run["squared_error"].sel(time=slice(10, None))[..., :2].sum("component").mean())
    print(f"{name:9s} {float(error):.2f} m, {int(run['scalars_total'][-1].sum())} numbers sent")
