"""The Kalman filter for many runs at once: exact, with single components of observations missing.

The functions that a caller sees keep runs in front; inside, the run axis stands last.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, covariance
from ._algebra import Indices, analysis, forecast_cov, log_density, shared_gains, whitened
from ._inputs import common_runs, fill_axes, prior

__all__ = ["GaussianRun", "kalman_filter", "predict", "update"]


@dataclass(frozen=True, eq=False)
class GaussianRun:
    """What a filter with Gaussian output leaves behind.

    Attributes
    ----------
    means : ndarray, (T, ..., d)
        Analysis means, one for each observation time; leading axes are the runs.
    covariances : ndarray, (T, ..., d, d)
        Analysis covariances. Of :func:`kalman_filter` the run axes have length 1 where all runs
        share the covariance, so that the array broadcasts against the means.
    log_likelihood : ndarray, (T, ...)
        Log density of each observation given those before it; its sum over time is the log
        likelihood of the model. Zero where nothing was observed.

    Examples
    --------
    >>> run = kalman_filter([0.0], [[1.0]], [[2.0]], F=[[1.0]], H=[[1.0]], Q=[[0.0]], R=[[1.0]])
    >>> run.means, run.covariances
    (array([[1.]]), array([[[0.5]]]))
    """

    means: Array
    covariances: Array
    log_likelihood: Array


def kalman_filter(
    mean: ArrayLike, cov: ArrayLike, observations: ArrayLike, *, F: ArrayLike, H: ArrayLike,
    Q: ArrayLike, R: ArrayLike,
) -> GaussianRun:
    r"""Filter T observations of a linear Gaussian model, for any number of runs at once.

    The model is :math:`\mathbf x_k = \mathbf F_k\mathbf x_{k-1} + \text{noise}(\mathbf Q_k)`,
    :math:`\mathbf y_k = \mathbf H_k\mathbf x_k + \text{noise}(\mathbf R_k)`; the filter forecasts
    to the first observation before it uses it.

    Parameters
    ----------
    mean : array_like, (d,) or (..., d)
        Prior mean, one step before the first observation.
    cov : array_like, (d, d) or (..., d, d)
        Prior covariance, positive definite.
    observations : array_like, (T, ..., m)
        Observations; the middle axes are the runs. NaN marks a missing component: the result is
        the one with its row deleted from H and R.
    F, Q : array_like, (d, d) or (T, d, d)
        Transition and process noise covariance (positive semidefinite), constant or per step.
    H, R : array_like, (m, d) and (m, m), or (T, m, d) and (T, m, m)
        Observation matrix and noise covariance (positive definite), constant or per step.

    Raises
    ------
    numpy.linalg.LinAlgError
        If an innovation covariance is not positive definite in floating point.

    Notes
    -----
    R. E. Kalman, Journal of Basic Engineering 82 (1960) 35-45. The covariance does not depend on
    the observed values, only on which of them are there: runs that share their pattern of missing
    components share one recursion. The update is in Joseph's form.

    Examples
    --------
    >>> y = np.array([[1.0], [np.nan], [2.0]])
    >>> run = kalman_filter([0.0], [[4.0]], y, F=[[1.0]], H=[[1.0]], Q=[[1.0]], R=[[2.0]])
    >>> run.means.ravel().round(4)
    array([0.7143, 0.7143, 1.5263])
    """
    y = array(observations, "observations", None, finite=False)
    if y.ndim < 2:
        raise ValueError(f"observations: needs shape (T, ..., m), got {y.shape}")
    if np.isinf(y).any():
        raise ValueError("observations: needs finite numbers or NaN (missing), got infinity")
    steps, runs, m = y.shape[0], y.shape[1:-1], y.shape[-1]
    x0, p0 = prior(mean, cov)
    d = x0.shape[-1]
    f, q = _per_step(F, "F", steps, (d, d)), _noise_per_step(Q, "Q", steps, d, semidefinite=True)
    h, r = _per_step(H, "H", steps, (m, d)), _noise_per_step(R, "R", steps, m)
    runs = common_runs(runs, x0, p0)
    size = math.prod(runs)
    y = np.broadcast_to(fill_axes(y, len(runs)), (steps, *runs, m)).reshape(steps, size, m)
    x = np.broadcast_to(x0, (*runs, d)).reshape(size, d)
    p, group = _groups(y, p0, runs)
    own = p.shape[-1] > 1
    model = (f, h, q, r)
    out = _recursion(x, p, group, y, *model) if own else _shared(x, p[..., 0], y, *model)
    if not np.isfinite(out.means).all():
        raise np.linalg.LinAlgError("kalman_filter: needs matrices without overflow, got infinity")
    covs = out.covariances.reshape(steps, *(runs if own else (1,) * len(runs)), d, d)
    density = out.log_likelihood.reshape(steps, *runs)
    return GaussianRun(out.means.reshape(steps, *runs, d), covs, density)


def _per_step(value: ArrayLike, name: str, steps: int, shape: tuple[int, int]) -> Array:
    """Check a matrix that is constant or given per step, and return it per step."""
    out = array(value, name, (..., *shape))
    if out.ndim > 3 or (out.ndim == 3 and out.shape[0] != steps):
        raise ValueError(f"{name}: needs shape {shape} or {(steps, *shape)}, got {out.shape}")
    return np.broadcast_to(out, (steps, *shape))


def _noise_per_step(
    value: ArrayLike, name: str, steps: int, dim: int, *, semidefinite: bool = False
) -> Array:
    return _per_step(
        covariance(value, name, dim, semidefinite=semidefinite), name, steps, (dim, dim)
    )


def _groups(y: Array, cov: Array, runs: tuple[int, ...]) -> tuple[Array, Indices]:
    """Prior covariances (d, d, G), and for each run the index of the covariance it uses.

    Two runs of y (T, R, m) with the same missing components at all times have the same covariances.
    """
    d, size = cov.shape[-1], y.shape[1]
    if cov.ndim > 2:
        full = np.broadcast_to(cov, (*runs, d, d)).reshape(-1, d, d)
        return np.moveaxis(full, 0, -1).copy(), np.arange(size)
    missing = np.isnan(y)
    if (missing == missing[:, :1]).all():
        group: Indices = np.zeros(size, dtype=np.intp)
    else:
        bits = np.packbits(np.moveaxis(missing, 1, -1).reshape(-1, size), axis=0)
        _, group = np.unique(bits, axis=1, return_inverse=True)
        group = np.asarray(group, dtype=np.intp).reshape(-1)
    count = int(group.max(initial=0)) + 1
    if count == size:
        group = np.arange(size)
    return np.repeat(cov[..., None], count, axis=-1), group


def _shared(x: Array, p: Array, y: Array, f: Array, h: Array, q: Array, r: Array) -> GaussianRun:
    """All steps of runs x (R, d), y (T, R, m) that share their covariance p (d, d)."""
    steps = len(y)
    here = np.asarray(~np.isnan(y).any(axis=1))
    gains, lowers, covs = shared_gains(p, f, h, q, r, here)
    means, squares = np.empty((steps, *x.shape)), np.empty((steps, len(x)))
    for k in range(steps):
        x = x @ f[k].T
        innovation = y[k] - x @ h[k].T
        if not here[k].all():
            innovation[:, ~here[k]] = 0.0
        means[k] = x = x + innovation @ gains[k].T
        white = whitened(lowers[k], innovation)
        squares[k] = np.einsum("rm,rm->r", white, white)
    log_det = 2.0 * np.log(np.diagonal(lowers, axis1=1, axis2=2)).sum(axis=-1)
    size = np.count_nonzero(here, axis=1)
    return GaussianRun(means, covs, log_density(size[:, None], log_det[:, None], squares))


def _recursion(
    x: Array, p: Array, group: Indices, y: Array, f: Array, h: Array, q: Array, r: Array
) -> GaussianRun:
    """All steps of runs x (R, d), y (T, R, m) with covariances p (d, d, G)."""
    steps, x = len(y), np.ascontiguousarray(x.T)
    means, covs = np.empty((steps, *x.shape)), np.empty((steps, *p.shape))
    density = np.empty((steps, x.shape[-1]))
    for k in range(steps):
        x, p = f[k] @ x, forecast_cov(p, f[k], q[k])
        x, p, density[k] = analysis(x, p, y[k].T - h[k] @ x, h[k], r[k], group)
        means[k], covs[k] = x, p
    covs = np.moveaxis(covs[..., group], -1, 1)
    return GaussianRun(np.moveaxis(means, -1, 1), covs, density)


def predict(mean: ArrayLike, cov: ArrayLike, *, F: ArrayLike, Q: ArrayLike) -> tuple[Array, Array]:
    r"""Forecast a Gaussian by a linear step: the new mean (..., d) and covariance.

    The mean becomes :math:`\mathbf F\mathbf x`, the covariance
    :math:`\mathbf F\mathbf P\mathbf F^\top+\mathbf Q`.

    Parameters
    ----------
    mean, cov : array_like, (..., d) and (..., d, d)
        The covariance positive definite.
    F, Q : array_like, (d, d)
        Transition, and process noise covariance (positive semidefinite).

    Examples
    --------
    >>> predict([1.0], [[2.0]], F=[[3.0]], Q=[[0.5]])
    (array([3.]), array([[18.5]]))
    """
    x, p = prior(mean, cov)
    d = x.shape[-1]
    f = array(F, "F", (d, d))
    q = array(covariance(Q, "Q", d, semidefinite=True), "Q", (d, d))
    return _predict(x, p, f, q)


def _predict(x: Array, p: Array, f: Array, q: Array) -> tuple[Array, Array]:
    """`predict` of checked arguments."""
    d = x.shape[-1]
    stack = np.ascontiguousarray(np.moveaxis(p.reshape(-1, d, d), 0, -1))
    return x @ f.T, np.moveaxis(forecast_cov(stack, f, q), -1, 0).reshape(p.shape)


def update(
    mean: ArrayLike, cov: ArrayLike, observed: ArrayLike, *, H: ArrayLike, R: ArrayLike
) -> tuple[Array, Array, Array]:
    r"""Condition a Gaussian on one observation :math:`\mathbf y=\mathbf H\mathbf x+\text{noise}`.

    Parameters
    ----------
    mean, cov : array_like, (..., d) and (..., d, d)
        The covariance positive definite.
    observed : array_like, (..., m)
        NaN marks a missing component.
    H : array_like, (m, d)
    R : array_like, (m, m)
        Positive definite.

    Returns
    -------
    mean : ndarray, (..., d)
    cov : ndarray, (..., d, d)
        The run axes have length 1 where all runs share the covariance.
    log_likelihood : ndarray, (...)
        Log density of the observation.

    Examples
    --------
    >>> x, p, _ = update([0.0], [[1.0]], [2.0], H=[[1.0]], R=[[1.0]])
    >>> x, p
    (array([1.]), array([[0.5]]))
    """
    x, p = prior(mean, cov)
    h = array(H, "H", ("m", x.shape[-1]))
    m = h.shape[0]
    y = array(observed, "observed", (..., m), finite=False)
    if np.isinf(y).any():
        raise ValueError("observed: needs finite numbers or NaN (missing), got infinity")
    r = array(covariance(R, "R", m), "R", (m, m))
    common_runs(y.shape[:-1], x, p)
    return _update(x, p, y, h, r)


def _update(x: Array, p: Array, y: Array, h: Array, r: Array) -> tuple[Array, Array, Array]:
    """`update` of checked arguments."""
    d, m = x.shape[-1], y.shape[-1]
    runs = np.broadcast_shapes(y.shape[:-1], x.shape[:-1], p.shape[:-2])
    seen = np.broadcast_to(y, (*runs, m)).reshape(-1, m).T
    mean = np.ascontiguousarray(np.broadcast_to(x, (*runs, d)).reshape(-1, d).T)
    stack, group = _groups(seen.T[None], p, runs)
    shared = stack.shape[-1] == 1
    mean, stack, density = analysis(mean, stack, seen - h @ mean, h, r, group)
    covs = np.moveaxis(stack if shared else stack[..., group], -1, 0)
    covs = covs.reshape(*((1,) * len(runs) if shared else runs), d, d)
    return np.ascontiguousarray(mean.T).reshape(*runs, d), covs, density.reshape(runs)
