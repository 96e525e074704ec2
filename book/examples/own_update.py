"""An update of your own: an ensemble filter that a single outlier cannot move far."""

import numpy as np

from distfilt.filters import EnsembleFilter
from distfilt.models import Model
from distfilt.sensors import component


def robust_update(
    ensemble: np.ndarray,
    predicted: np.ndarray,
    observed: np.ndarray,
    noise: np.ndarray,
    *,
    rng: np.random.Generator,
) -> np.ndarray:
    """Update by the stochastic EnKF, with innovations clipped at three standard deviations."""
    x = ensemble - ensemble.mean(axis=-2, keepdims=True)
    h = predicted - predicted.mean(axis=-2, keepdims=True)
    n = ensemble.shape[-2] - 1
    # Innovation covariance S = HᵀH / (N - 1) + R, cross covariance C = HᵀX / (N - 1)
    S = np.swapaxes(h, -1, -2) @ h / n + noise
    C = np.swapaxes(h, -1, -2) @ x / n
    limit = 3 * np.sqrt(np.diagonal(S, axis1=-2, axis2=-1))[..., None, :]
    perturbation = rng.standard_normal(predicted.shape) @ np.linalg.cholesky(noise).T
    innovation = observed[..., None, :] - predicted - perturbation
    increment = np.clip(innovation, -limit, limit) @ np.linalg.solve(S, C)
    return np.asarray(ensemble + increment)


walk = Model(1, lambda x, t, dt: x, lambda t, dt: 0.1 * dt * np.eye(1), units=("m",))
f = EnsembleFilter(walk, [component([0], std=0.5)], update=robust_update, members=200)
state = f.start(([0.0], [[1.0]]), rng=np.random.default_rng(0))
observations = np.where(np.arange(30) == 20, 50.0, 0.3)[:, None]  # one is an outlier
run = f.run(state, np.arange(1.0, 31.0), [observations])
print(run["mean"].values[[19, 20, 29], 0, 0].round(1), "m")
