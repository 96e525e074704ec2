"""The ensemble Kalman filter with perturbed observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..checks import Array, array, count, covariance, generator
from ..ensembles import cross_covariance, mean, sample_covariance
from ..linalg import cholesky_solve, factor
from ..models import Model
from ..sensors import Sensor
from ._inputs import instantaneous, series

__all__ = ["EnsembleRun", "enkf", "enkf_filter"]


@dataclass(frozen=True)
class EnsembleRun:
    """What an ensemble filter leaves behind.

    Attributes
    ----------
    means : ndarray, (T, ..., d)
        Analysis means.
    covariances : ndarray, (T, ..., d, d)
        Sample covariances of the analysis ensembles.
    ensembles : ndarray, (T // every, ..., N, d)
        The ensembles after each `every`-th observation.

    Examples
    --------
    >>> EnsembleRun(np.zeros((5, 2)), np.zeros((5, 2, 2)), np.zeros((1, 9, 2))).means.shape
    (5, 2)
    """

    means: Array
    covariances: Array
    ensembles: Array


def enkf(
    ensemble: ArrayLike,
    predicted: ArrayLike,
    observed: ArrayLike,
    noise: ArrayLike,
    *,
    rng: np.random.Generator,
    known_noise: bool = False,
) -> Array:
    r"""Update each member with its own perturbed prediction of the observation.

    .. math:: \mathbf x_i' = \mathbf x_i + \hat{\mathbf\Sigma}_{xy}\hat{\mathbf\Sigma}_{yy}^{-1}
              (\mathbf y^* - \mathbf y_i), \qquad \mathbf y_i = \mathbf h(\mathbf x_i) + \zeta_i

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Forecast members.
    predicted : array_like, (..., N, m)
        Each member's observation without noise, h(x_i). For a reading that wraps, pass it
        unwrapped around the observation, ``observed - sensor.residual(observed, h(x_i))``.
    observed : array_like, (..., m)
        The observation y*.
    noise : array_like, (m, m)
        Covariance R of the observation's noise, positive definite.
    rng : numpy.random.Generator
        Source of the perturbations :math:`\zeta_i\sim N(0, \mathbf R)`.
    known_noise : bool
        False: both sample covariances are those of the perturbed predictions, which needs N > m.
        True: :math:`\hat{\mathbf C}_{xh}(\hat{\mathbf C}_{hh}+\mathbf R)^{-1}`, with the sample
        covariances of the predictions without noise and R itself, which needs N > 1.

    Returns
    -------
    ndarray, (..., N, d)
        Analysis members.

    Raises
    ------
    ValueError
        If a shape or the covariance is wrong, a number is not finite, or N is too small.

    Notes
    -----
    G. Burgers, P. J. van Leeuwen, G. Evensen, Monthly Weather Review 126 (1998) 1719-1724.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> prior = rng.standard_normal((2000, 1))
    >>> after = enkf(prior, prior, [2.0], [[1.0]], rng=rng)
    >>> after.mean().round(1), after.var().round(1)
    (np.float64(1.0), np.float64(0.5))
    """
    x = array(ensemble, "ensemble", (..., "N", "d"))
    h = array(predicted, "predicted", (..., x.shape[-2], "m"))
    members, m = h.shape[-2:]
    y = array(observed, "observed", (..., m))
    r = array(covariance(noise, "noise", m), "noise", (m, m))
    needed = 2 if known_noise else m + 1
    if members < needed:
        raise ValueError(f"ensemble: needs at least {needed} members, got {members}")
    drawn = h + generator(rng).standard_normal(h.shape) @ factor(r, name="noise").T
    if known_noise:
        cross, inner = cross_covariance(x, h), sample_covariance(h) + r
    else:
        cross, inner = cross_covariance(x, drawn), sample_covariance(drawn)
    # The gain transposed, (..., m, d): one solve for all members.
    gain = cholesky_solve(inner, np.swapaxes(cross, -1, -2))
    return x + (y[..., None, :] - drawn) @ gain


def enkf_filter(
    ensemble: ArrayLike,
    observations: ArrayLike,
    *,
    model: Model,
    sensors: Sequence[Sensor],
    times: ArrayLike,
    rng: np.random.Generator,
    t0: float = 0.0,
    known_noise: bool = False,
    every: int | None = None,
) -> EnsembleRun:
    """Run the ensemble Kalman filter over a series of observations, for any number of runs.

    Parameters
    ----------
    ensemble : array_like, (..., N, d)
        Members of the prior at `t0`; leading axes are runs.
    observations : array_like, (T, ..., m)
        The observations of all sensors, one after the other. NaN marks a missing component, which
        has to be missing in all runs.
    model : Model
        Each member receives its own draw of the model's noise.
    sensors : sequence of Sensor
        Sensors of the present state.
    times : array_like, (T,)
        Observation times, in s.
    rng : numpy.random.Generator
        Source of all noise.
    t0 : float
        The time of the prior, in s.
    known_noise : bool
        As for :func:`enkf`.
    every : int, optional
        Keep the ensemble after each `every`-th observation; by default none is kept.

    Returns
    -------
    EnsembleRun

    Raises
    ------
    ValueError
        If a shape or a time is wrong, or a component is missing in some runs only.

    Examples
    --------
    >>> from distfilt.sensors import direct
    >>> walk = Model(1, lambda x, t, dt: x, lambda t, dt: np.array([[dt]]))
    >>> rng = np.random.default_rng(1)
    >>> run = enkf_filter(rng.standard_normal((4, 9, 1)), np.ones((2, 4, 1)), model=walk,
    ...                   sensors=[direct([0], std=1.0)], times=[1.0, 2.0], rng=rng)
    >>> run.means.shape, run.covariances.shape
    ((2, 4, 1), (2, 4, 1, 1))
    """
    sensor = instantaneous(sensors)
    x = array(ensemble, "ensemble", (..., "N", model.dim))
    y, grid = series(observations, times, t0, sensor.dim)
    stride = len(y) + 1 if every is None else count(every, "every")
    generator(rng)
    means, covs, kept = [], [], []
    for k in range(len(y)):
        x = model.sample_step(x, grid[k], grid[k + 1] - grid[k], rng=rng)
        seen = _seen(y[k])
        if seen.any():
            h = sensor.predict(x)
            near = y[k][..., None, :] - sensor.residual(
                np.broadcast_to(y[k][..., None, :], h.shape), h
            )
            noise = sensor.cov[np.ix_(seen, seen)]
            x = enkf(
                x, near[..., seen], y[k][..., seen], noise, rng=rng, known_noise=known_noise
            )
        means.append(mean(x))
        covs.append(sample_covariance(x))
        if (k + 1) % stride == 0:
            kept.append(x)
    ensembles = np.array(kept) if kept else np.empty((0, *x.shape))
    return EnsembleRun(np.array(means), np.array(covs), ensembles)


def _seen(y: Array) -> NDArray[np.bool_]:
    """Which components are there; refuses components that are missing in some runs only."""
    missing = np.isnan(y).reshape(-1, y.shape[-1])
    if (missing != missing[:1]).any():
        raise ValueError("observations: needs the same missing components in all runs, got others")
    return np.asarray(~missing[0], dtype=np.bool_)
