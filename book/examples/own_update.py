"""An update of one's own: an ensemble filter that cannot be pulled far by a single reading."""

import numpy as np

from distfilt.filters import EnsembleFilter
from distfilt.models import Model
from distfilt.sensors import component


def cautious(ensemble, predicted, observed, noise, *, rng):
    """The ensemble Kalman filter's update with innovations cut at three standard deviations."""
    x = ensemble - ensemble.mean(axis=-2, keepdims=True)
    h = predicted - predicted.mean(axis=-2, keepdims=True)
    n = ensemble.shape[-2] - 1
    inner = np.swapaxes(h, -1, -2) @ h / n + noise
    width = 3 * np.sqrt(np.diagonal(inner, axis1=-2, axis2=-1))[..., None, :]
    drawn = rng.standard_normal(predicted.shape) @ np.linalg.cholesky(noise).T
    gap = np.clip(observed[..., None, :] - predicted - drawn, -width, width)
    return ensemble + gap @ np.linalg.solve(inner, np.swapaxes(h, -1, -2) @ x / n)


walk = Model(1, lambda x, t, dt: x, lambda t, dt: 0.1 * dt * np.eye(1), units=("m",))
f = EnsembleFilter(walk, [component([0], std=0.5)], update=cautious, members=200)
state = f.start(([0.0], [[1.0]]), rng=np.random.default_rng(0))
readings = np.where(np.arange(30) == 20, 50.0, 0.3)[:, None]  # one of them is wild
run = f.run(state, np.arange(1.0, 31.0), [readings])
print(run["mean"].values[[19, 20, 29], 0, 0].round(1), "m")
