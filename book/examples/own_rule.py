"""A fusion rule of your own: each agent moves to the median of the means it knows."""

import numpy as np

from distfilt.filters import EnsembleFilter
from distfilt.models import Model
from distfilt.network import Channel, graphs
from distfilt.sensors import component


def median_of_means(ensembles: np.ndarray, channel: Channel) -> np.ndarray:
    """Move every ensemble (A, N, d) to the median of its own mean and its neighbours'."""
    means = list(ensembles.mean(axis=-2))
    inbox = channel.broadcast(means)
    fused = ensembles.copy()
    for agent, received in enumerate(inbox):
        median = np.median([means[agent], *received.values()], axis=0)
        fused[agent] += median - means[agent]
    return fused


walk = Model(1, lambda x, t, dt: x, lambda t, dt: 0.1 * dt * np.eye(1), units=("m",))
sensors = [component([0], std=0.5) for _ in range(5)]
f = EnsembleFilter(
    walk,
    sensors,
    graphs.complete(5),
    fusion=median_of_means,
    share_observations=False,
    members=100,
)
state = f.start(([0.0], [[4.0]]), rng=np.random.default_rng(0))
# Four sensors work, the last one is broken.
observations = [np.full((20, 1), 1.0)] * 4 + [np.full((20, 1), 30.0)]
run = f.run(state, np.arange(1.0, 21.0), observations)
means = run["mean"].values[-1, :, 0].round(1)
print(means, "m;", run["scalars"].values[-1].sum(), "numbers")
