"""The Kalman filter for many runs at once, with missing components, and the RTS smoother."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from ..gaussians.single import innovation_moments, joseph
from ..linalg import (
    broadcast_leading,
    cholesky,
    log_det,
    solve_lower,
    solve_semidefinite,
    symmetrise,
)
from ..sensors import Sensor
from ..sensors.base import count_turns
from ..validation import (
    ALLOW_NAN,
    Array,
    ArrayInput,
    FrozenModel,
    Mask,
    PositiveDefinite,
    PositiveSemidefinite,
    format_number,
    validated,
)
from ..validation.clocks import warn_of_clock

__all__ = ["FilterResult", "kalman_filter", "rts_smoother"]

MeanVector = Annotated[ArrayInput, "... d"]
SquareMatrix = Annotated[ArrayInput, "... d d"]
ObservationMatrix = Annotated[ArrayInput, "... m d"]
ObservationNoise = Annotated[PositiveDefinite, "... m m"]
ObservationSeries = Annotated[ArrayInput, "... N m", ALLOW_NAN]
"""Observations (T, ..., m) with NaN for missing components."""


@dataclass(frozen=True, eq=False)
class FilterResult(FrozenModel):
    """The result of a filter with Gaussian output.

    Parameters
    ----------
    means : ndarray, (T, ..., d)
        Analysis means, one for each observation time; leading axes are the runs.
    covariances : ndarray, (T, ..., d, d)
        Analysis covariances. The run axes have length 1 if all runs of :func:`kalman_filter`
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
    mean: MeanVector,
    cov: PositiveSemidefinite,
    observations: ObservationSeries,
    *,
    F: SquareMatrix,
    H: ObservationMatrix,
    Q: PositiveSemidefinite,
    R: ObservationNoise,
) -> FilterResult:
    r"""Filter T observations of a linear Gaussian model, for any number of runs at once.

    The model is :math:`\mathbf x_k = \mathbf F_k\mathbf x_{k-1} + \text{noise}(\mathbf Q_k)`,
    :math:`\mathbf y_k = \mathbf H_k\mathbf x_k + \text{noise}(\mathbf R_k)`. The first forecast
    leads from the prior to the first observation.

    Parameters
    ----------
    mean : array_like, (d,) or (..., d)
        Prior mean, one step before the first observation.
    cov : array_like, (d, d) or (..., d, d)
        Prior covariance, positive semidefinite: a known constant has a variance of zero.
    observations : array_like, (T, ..., m)
        Observations; the middle axes are the runs. NaN marks a missing component: the result is
        the same as with its row deleted from H and R.
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
    R. E. Kalman, Journal of Basic Engineering 82 (1960) 35-45. The covariance depends only on
    which components are missing, not on the observed values: runs with the same missing components
    share one recursion. The update is :func:`distfilt.gaussians.condition`.

    Examples
    --------
    >>> y = np.array([[1.0], [np.nan], [2.0]])
    >>> run = kalman_filter(
    ...     [0.0], [[4.0]], y, F=[[1.0]], H=[[1.0]], Q=[[1.0]], R=[[2.0]]
    ... )
    >>> run.means.ravel().round(4)
    array([0.7143, 0.7143, 1.5263])
    """
    # All runs in one axis: observations (T, R, m), means (R, d) and covariances (R, d, d).
    flat = flatten_runs(mean, cov, observations)
    y = flat.observations
    x = flat.means
    p = flat.covs
    # One matrix for each of T steps
    f, h, q, r = repeat_per_step(len(y), F=F, H=H, Q=Q, R=R)
    # A contiguous copy is faster in the loop.
    f_transposed = np.ascontiguousarray(f.mT)
    if _share_covariance(cov, y):
        # One covariance for all R runs, whose means are the columns of one matrix: P is (1, d, d),
        # x (1, d, R) and y (T, 1, m, R).
        p = cov[None]
        x = x.T[None]
        y = y.mT[:, None]
    else:
        # A covariance and a column for each run: P is (R, d, d), x (R, d, 1) and y (T, R, m, 1).
        x = x[..., None]
        y = y[..., None]
    missing = np.asarray(np.isnan(y).any(axis=-1))
    means = np.empty((len(y), *x.shape))
    covs = np.empty((len(y), *p.shape))
    log_likelihood = np.empty((len(y), len(x), x.shape[-1]))
    for k in range(len(y)):
        # Forecast: x⁻ = F x, P⁻ = F P Fᵀ + Q
        x = f[k] @ x
        p = f[k] @ p @ f_transposed[k] + q[k]
        # Innovation: y - H x⁻, zero where the observation is missing
        innovations = y[k] - h[k] @ x
        innovations[missing[k]] = 0.0
        # Analysis: x = x⁻ + K (y - H x⁻), P in Joseph's form
        increments, p, log_likelihood[k] = assimilate(
            p, innovations, h[k], r[k], missing[k]
        )
        x = x + increments
        means[k] = x
        covs[k] = p
    if not np.isfinite(means).all():
        raise np.linalg.LinAlgError(
            "kalman_filter: a mean overflowed; rescale F, H, Q or R"
        )
    # Columns become rows.
    return unflatten_runs(means.mT, covs, log_likelihood, flat.runs)


def _share_covariance(cov: Array, y: Array) -> bool:
    """Whether all runs have one prior covariance and the same missing components of y (T, R, m)."""
    # Patterns are compared with that of the first run.
    missing = np.isnan(y)
    return cov.ndim == 2 and bool((missing == missing[:, :1]).all())


def assimilate(
    cov: Array, innovations: Array, H: Array, R: Array, missing: Mask
) -> tuple[Array, Array, Array]:
    """Update Gaussians that have one covariance in common by an observation each.

    Parameters
    ----------
    cov : ndarray, (..., d, d)
        The forecast covariance.
    innovations : ndarray, (..., m, k)
        Observations minus predictions of k Gaussians, as columns; zero where they are missing.
    H, R : ndarray, (..., m, d) and (..., m, m)
        Observation matrix and noise covariance.
    missing : ndarray of bool, (..., m)
        Which components are missing, in all k columns.

    Returns
    -------
    increments : ndarray, (..., d, k)
        Analysis means minus forecast means.
    cov : ndarray, (..., d, d)
        The analysis covariance.
    log_densities : ndarray, (..., k)
        Logarithms of the innovations' densities.
    """
    # H P and S = H P Hᵀ + R, with a one on the diagonal for missing components
    cross, innovation_cov = innovation_moments(cov, H, R, missing)
    try:
        lower = cholesky(innovation_cov)
    except np.linalg.LinAlgError:
        raise np.linalg.LinAlgError(
            "the innovation covariance is not positive definite"
        ) from None
    d = cov.shape[-1]
    # With S = L Lᵀ: L⁻¹ [H P, e] in one solve
    whitened = solve_lower(lower, np.concatenate([cross, innovations], axis=-1))
    # K = P Hᵀ S⁻¹ = (L⁻ᵀ L⁻¹ H P)ᵀ
    gain = solve_lower(lower, whitened[..., :d], transposed=True).mT
    # log N(e; 0, S) = -½ (|L⁻¹ e|² + m log 2π + log det S), m without missing components
    squares = (whitened[..., d:] ** 2).sum(axis=-2)
    constant = np.log(2 * np.pi) * (~missing).sum(axis=-1) + log_det(lower)
    log_densities = -0.5 * (squares + constant[..., None])
    return gain @ innovations, joseph(cov, gain, H, R), log_densities


@validated
def rts_smoother(
    run: FilterResult,
    *,
    F: Annotated[ArrayInput, "... run.dim run.dim"],
    Q: Annotated[PositiveSemidefinite, "... run.dim run.dim"],
) -> FilterResult:
    r"""Smooth a Kalman filter's run: states given all observations, by a backward recursion.

    With the forecast :math:`\mathbf P^-_{k+1} = \mathbf F\mathbf P_k\mathbf F^\top+\mathbf Q` and
    the gain :math:`\mathbf G_k = \mathbf P_k\mathbf F^\top(\mathbf P^-_{k+1})^{-1}`,

    .. math:: \mathbf x^s_k = \mathbf x_k + \mathbf G_k(\mathbf x^s_{k+1}-\mathbf F\mathbf x_k),
        \qquad \mathbf P^s_k = \mathbf P_k
        + \mathbf G_k(\mathbf P^s_{k+1}-\mathbf P^-_{k+1})\mathbf G_k^\top.

    Parameters
    ----------
    run : FilterResult
        Result of :func:`kalman_filter`, for any number of runs and missing observations. The
        smoother's result has its shapes and its log-likelihoods.
    F, Q : array_like, (d, d) or (T, d, d)
        Those of the filter: the first of T leads from the prior to the first observation.

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
    f, q = repeat_per_step(len(run.means), F=F, Q=Q)
    identity = np.eye(run.dim)
    means = run.means.copy()
    covs = run.covariances.copy()
    # Backwards from the last state, whose filtered estimate is the smoothed one.
    for k in reversed(range(len(f) - 1)):
        x = run.means[k]
        p = run.covariances[k]
        # G = P Fᵀ (F P Fᵀ + Q)⁻¹, by a solve instead of an inverse
        cross = f[k + 1] @ p
        forecast_cov = symmetrise(cross @ f[k + 1].T + q[k + 1])
        gain = solve_semidefinite(forecast_cov, cross).mT
        # xˢ = x + G (xˢ' - F x), with the smoothed state one step later
        difference = means[k + 1] - x @ f[k + 1].T
        means[k] = x + (gain @ difference[..., None])[..., 0]
        # Pˢ = (I - G F) P (I - G F)ᵀ + G (Pˢ' + Q) Gᵀ
        remainder = identity - gain @ f[k + 1]
        filtered = remainder @ p @ remainder.mT
        covs[k] = symmetrise(filtered + gain @ (covs[k + 1] + q[k + 1]) @ gain.mT)
    return run.replace(means=means, covariances=covs)


class FlatRuns(NamedTuple):
    """Arguments whose run axes, of the shape `runs`, are flattened to one of length R.

    Observations are (T, R, m), means (R, d) and covariances (R, d, d).
    """

    runs: tuple[int, ...]
    observations: Array
    means: Array
    covs: Array


def flatten_runs(mean: Array, cov: Array, observations: Array) -> FlatRuns:
    """Broadcast the run axes of three arguments, and flatten them to one axis of length R.

    The axes are the leading ones of the mean (..., d) and of the covariance (..., d, d), and the
    middle ones of the observations (T, ..., m).
    """
    runs = broadcast_leading(observations.shape[1:-1], mean.shape[:-1], "mean")
    runs = broadcast_leading(runs, cov.shape[:-2], "cov")
    steps = len(observations)
    m = observations.shape[-1]
    d = mean.shape[-1]
    size = math.prod(runs)
    # Run axes that only the prior has come first, after the time.
    new_axes = len(runs) - (observations.ndim - 2)
    y = np.expand_dims(observations, tuple(range(1, 1 + new_axes)))
    # All axes of runs become one.
    y = np.broadcast_to(y, (steps, *runs, m)).reshape(steps, size, m)
    x = np.broadcast_to(mean, (*runs, d)).reshape(size, d)
    p = np.broadcast_to(cov, (*runs, *cov.shape[-2:])).reshape(size, *cov.shape[-2:])
    return FlatRuns(runs, observations=y, means=x, covs=p)


def unflatten_runs(
    means: Array, covs: Array, log_likelihood: Array, runs: tuple[int, ...]
) -> FilterResult:
    """Restore the run axes of means (T, R, d), covariances (T, R, d, d) and densities (T, R).

    If the runs share a covariance, (T, 1, d, d), its run axes have length 1.
    """
    steps = len(means)
    # R runs have a covariance each, or share one.
    cov_runs = runs if covs.shape[1] == math.prod(runs) else (1,) * len(runs)
    return FilterResult.construct(
        means.reshape(steps, *runs, means.shape[-1]),
        covs.reshape(steps, *cov_runs, *covs.shape[2:]),
        log_likelihood.reshape(steps, *runs),
    )


def repeat_per_step(steps: int, **matrices: Array) -> list[Array]:
    """Broadcast matrices (a, b) or (steps, a, b) to one for each step, in the order given.

    Their names are those of the caller's arguments, for the error.
    """
    repeated = []
    for name, matrix in matrices.items():
        size = matrix.shape[-2:]
        if matrix.shape[:-2] not in ((), (steps,)):
            raise ValueError(
                f"{name} must have shape {size} or {(steps, *size)}, got {matrix.shape}"
            )
        # Views: a constant matrix is not copied.
        repeated.append(np.broadcast_to(matrix, (steps, *size)))
    return repeated


def prepend_prior_time(times: Array, observations: Array, sensor: Sensor) -> Array:
    """Validate the observations' times (T,) and shape (T, ..., m) for a sensor.

    Returns the T + 1 times from that of the prior, which is 0.
    """
    steps = len(times)
    if len(observations) != steps or observations.shape[-1] != sensor.dim:
        raise ValueError(
            f"observations must have shape ({steps}, ..., {sensor.dim}), "
            f"got {observations.shape}"
        )
    if times.min(initial=np.inf) <= 0:
        raise ValueError(f"times must be after 0, got {format_number(times[0])}")
    warn_of_clock(start=0.0, times=times, name="times")
    # Angles are off by a few turns at most, if they are in rad.
    if sensor.wraps and observations.size:
        turns = count_turns(sensor, np.nan_to_num(observations.reshape(-1, sensor.dim)))
        if turns > 4:
            warnings.warn(
                f"observations must be angles in rad, got some {turns:.0f} turns off: are "
                "they in degrees?",
                RuntimeWarning,
                # The warning points at the call of mekf(), above it and its validation.
                stacklevel=4,
            )
    return np.concatenate([[0.0], times])
