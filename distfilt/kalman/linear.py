"""The Kalman filter for many runs at once, with single components missing, and its smoother."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ..gaussians.single import innovation, joseph
from ..linalg import cholesky, leading, log_det, solve_lower, solve_upper, symmetrise
from ..sensors import Sensor
from ..validation import (
    ALLOW_NAN,
    Array,
    FrozenModel,
    Mask,
    PositiveDefinite,
    PositiveSemidefinite,
    validated,
)

__all__ = ["FilterResult", "kalman_filter", "rts_smoother"]

Runs = tuple[int, ...]
Mean = Annotated[Array, "... d"]
Matrix = Annotated[Array, "... d d"]
Seen = Annotated[Array, "... m d"]
Noise = Annotated[PositiveDefinite, "... m m"]
Series = Annotated[Array, "... N m", ALLOW_NAN]


@dataclass(frozen=True, eq=False)
class FilterResult(FrozenModel):
    """What a filter with Gaussian output leaves behind.

    Parameters
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
    >>> run = kalman_filter(
    ...     [0.0], [[1.0]], [[2.0]], F=[[1.0]], H=[[1.0]], Q=[[0.0]], R=[[1.0]]
    ... )
    >>> run.means, run.covariances
    (array([[1.]]), array([[[0.5]]]))
    """

    means: Annotated[Array, "... N d"]
    covariances: Annotated[Array, "... k k"]
    log_likelihood: Array

    @property
    def dim(self) -> int:
        """Number d of a state's components."""
        return int(self.means.shape[-1])


@validated
def kalman_filter(
    mean: Mean,
    cov: PositiveDefinite,
    observations: Series,
    *,
    F: Matrix,
    H: Seen,
    Q: PositiveSemidefinite,
    R: Noise,
) -> FilterResult:
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
    the observed values, only on which of them are there: runs that all miss the same components
    share one recursion. The update is :func:`distfilt.gaussians.conditioned`.

    Examples
    --------
    >>> y = np.array([[1.0], [np.nan], [2.0]])
    >>> run = kalman_filter(
    ...     [0.0], [[4.0]], y, F=[[1.0]], H=[[1.0]], Q=[[1.0]], R=[[2.0]]
    ... )
    >>> run.means.ravel().round(4)
    array([0.7143, 0.7143, 1.5263])
    """
    runs, y, x, p = flatten_runs(mean, cov, observations)
    f, h, q, r = per_step(len(y), F=F, H=H, Q=Q, R=R)
    turned = np.ascontiguousarray(f.mT)
    missing = np.isnan(y)
    shared = cov.ndim == 2 and bool((missing == missing[:, :1]).all())
    # Runs that share a covariance stand side by side, as the columns of one mean.
    p, x, y = (
        (cov[None], x.T[None], y.mT[:, None])
        if shared
        else (p, x[..., None], y[..., None])
    )
    means = np.empty((len(y), *x.shape))
    covs = np.empty((len(y), *p.shape))
    density = np.empty((len(y), len(x), x.shape[-1]))
    missing = np.asarray(np.isnan(y).any(axis=-1))
    for k in range(len(y)):
        x = f[k] @ x
        p = f[k] @ p @ turned[k] + q[k]
        gap = y[k] - h[k] @ x
        gap[missing[k]] = 0.0
        move, p, density[k] = assimilate(p, gap, h[k], r[k], missing[k])
        x = x + move
        means[k] = x
        covs[k] = p
    if not np.isfinite(means).all():
        raise np.linalg.LinAlgError(
            "kalman_filter must have matrices without overflow, got infinity"
        )
    return unflatten_runs(means.mT, covs, density, runs)


def assimilate(
    cov: Array, gap: Array, H: Array, R: Array, missing: Mask
) -> tuple[Array, ...]:
    """How innovations (..., m, k) move the mean, the covariance after it, and their log densities.

    An innovation is 0 where it is missing.
    """
    (cross, inner) = innovation(cov, H, R, missing)
    d = cov.shape[-1]
    try:
        lower = cholesky(inner)
    except np.linalg.LinAlgError:
        raise np.linalg.LinAlgError(
            "the innovation covariance is not positive definite"
        ) from None
    white = solve_lower(lower, np.concatenate([cross, gap], axis=-1))
    gain = solve_upper(lower, white[..., :d]).mT
    length = (white[..., d:] ** 2).sum(axis=-2)
    constant = np.log(2 * np.pi) * (~missing).sum(axis=-1) + log_det(lower)
    return gain @ gap, joseph(cov, gain, H, R), -0.5 * (length + constant[..., None])


@validated
def rts_smoother(
    run: FilterResult,
    *,
    F: Annotated[Array, "... run.dim run.dim"],
    Q: Annotated[PositiveSemidefinite, "... run.dim run.dim"],
) -> FilterResult:
    r"""States given all observations, backwards through a Kalman filter's run.

    With the forecast :math:`\mathbf P^-_{k+1} = \mathbf F\mathbf P_k\mathbf F^\top+\mathbf Q` and
    the gain :math:`\mathbf G_k = \mathbf P_k\mathbf F^\top(\mathbf P^-_{k+1})^{-1}`,

    .. math:: \mathbf x^s_k = \mathbf x_k + \mathbf G_k(\mathbf x^s_{k+1}-\mathbf F\mathbf x_k),
        \qquad \mathbf P^s_k = \mathbf P_k
        + \mathbf G_k(\mathbf P^s_{k+1}-\mathbf P^-_{k+1})\mathbf G_k^\top.

    Parameters
    ----------
    run : FilterResult
        What :func:`kalman_filter` left, with any number of runs and gaps. The result has its
        shapes and its log-likelihoods.
    F, Q : array_like, (d, d) or (T, d, d)
        Those that the filter had: the first of T leads from the prior to the first observation.

    Raises
    ------
    numpy.linalg.LinAlgError
        If a forecast covariance is singular.

    Notes
    -----
    H. E. Rauch, F. Tung and C. T. Striebel, AIAA Journal 3 (1965) 1445-1450. The covariance is
    computed as the sum of squares :math:`(\mathbf I-\mathbf G\mathbf F)\mathbf P
    (\mathbf I-\mathbf G\mathbf F)^\top + \mathbf G(\mathbf P^s+\mathbf Q)\mathbf G^\top`.

    Examples
    --------
    >>> model = {"F": [[1.0]], "Q": [[1.0]]}
    >>> y = np.array([[np.nan], [2.0]])
    >>> run = kalman_filter([0.0], [[1.0]], y, H=[[1.0]], R=[[1.0]], **model)
    >>> rts_smoother(run, **model).means.ravel()
    array([1. , 1.5])
    """
    f, q = per_step(len(run.means), F=F, Q=Q)
    means = run.means.copy()
    covs = run.covariances.copy()
    for k in reversed(range(len(f) - 1)):
        x = run.means[k]
        p = run.covariances[k]
        forward = f[k + 1] @ p
        gain = np.linalg.solve(symmetrise(forward @ f[k + 1].T + q[k + 1]), forward).mT
        gap = means[k + 1] - x @ f[k + 1].T
        means[k] = x + (gain @ gap[..., None])[..., 0]
        kept = np.eye(run.dim) - gain @ f[k + 1]
        covs[k] = symmetrise(
            kept @ p @ kept.mT + gain @ (covs[k + 1] + q[k + 1]) @ gain.mT
        )
    return run.replace(means=means, covariances=covs)


def flatten_runs(
    mean: Array, cov: Array, observations: Array
) -> tuple[Runs, Array, Array, Array]:
    """The axes of all runs, with observations (T, R, m), means and covariances on one such axis.

    New run axes of observations come in front.
    """
    runs = leading(observations.shape[1:-1], mean.shape[:-1], "mean")
    runs = leading(runs, cov.shape[:-2], "cov")
    steps, *axes, m = observations.shape
    y = observations.reshape(steps, *(1,) * (len(runs) - len(axes)), *axes, m)
    y = np.broadcast_to(y, (steps, *runs, m)).reshape(steps, math.prod(runs), m)
    x = np.broadcast_to(mean, (*runs, *mean.shape[-1:])).reshape(-1, mean.shape[-1])
    p = np.broadcast_to(cov, (*runs, *cov.shape[-2:])).reshape(-1, *cov.shape[-2:])
    return runs, y, x, p


def unflatten_runs(
    means: Array, covs: Array, density: Array, runs: Runs
) -> FilterResult:
    """What a filter found of all runs, (T, R, ...), with their axes apart."""
    steps = len(means)
    lead = runs if covs.shape[1] == math.prod(runs) else (1,) * len(runs)
    return FilterResult.construct(
        means.reshape(steps, *runs, means.shape[-1]),
        covs.reshape(steps, *lead, *covs.shape[2:]),
        density.reshape(steps, *runs),
    )


def per_step(steps: int, **matrices: Array) -> list[Array]:
    """Matrices that are constant, or given per step, for every step."""
    for name, a in matrices.items():
        if a.shape[:-2] not in ((), (steps,)):
            needs = f"shape {a.shape[-2:]} or {(steps, *a.shape[-2:])}"
            raise ValueError(f"{name} must be {needs}, got {a.shape}")
    return [np.broadcast_to(a, (steps, *a.shape[-2:])) for a in matrices.values()]


def grid(times: Array, observations: Array, sensor: Sensor) -> Array:
    """The T + 1 times of the prior, which is 0, and of a sensor's T observations."""
    wanted = len(times), sensor.dim
    if (len(observations), observations.shape[-1]) != wanted:
        needs = f"shape ({wanted[0]}, ..., {wanted[1]})"
        raise ValueError(f"observations must be {needs}, got {observations.shape}")
    if times.min(initial=np.inf) <= 0:
        raise ValueError(f"times must be times after 0, got {times[0]:g}")
    return np.concatenate([[0.0], times])
