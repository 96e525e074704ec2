"""The Kalman filter for many runs at once: exact, with single components of observations missing.

Inside this module the run axis stands last, ``(d, d, G)``: every product with the matrices of the
model is then one large matrix product, and every operation on the small matrices of the filter is
vectorised over the runs. The functions that a caller sees keep runs in front.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dtrtrs

from ..checks import Array, array, covariance

__all__ = ["GaussianRun", "kalman_filter", "predict", "update"]


_Indices = NDArray[np.intp]
_Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class GaussianRun:
    """What a filter with Gaussian output leaves behind.

    Attributes
    ----------
    means : ndarray, (T, ..., d)
        Analysis means, one for each observation time; leading axes are the runs.
    covariances : ndarray, (T, ..., d, d)
        Analysis covariances. The run axes have length 1 where all runs share the covariance, so
        that the array broadcasts against the means.
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
    mean: ArrayLike,
    cov: ArrayLike,
    observations: ArrayLike,
    *,
    F: ArrayLike,
    H: ArrayLike,
    Q: ArrayLike,
    R: ArrayLike,
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

    Returns
    -------
    GaussianRun

    Raises
    ------
    ValueError
        If a shape or a covariance is wrong, or a number other than a missing component is not
        finite.
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
    x0, p0 = _prior(mean, cov)
    d = x0.shape[-1]
    f, q = _per_step(F, "F", steps, (d, d)), _noise_per_step(Q, "Q", steps, d, semidefinite=True)
    h, r = _per_step(H, "H", steps, (m, d)), _noise_per_step(R, "R", steps, m)
    runs = _broadcast(runs, x0, p0)
    y = np.moveaxis(np.broadcast_to(_fill_axes(y, len(runs)), (steps, *runs, m)), -1, 1)
    y = y.reshape(steps, m, -1)
    x = np.ascontiguousarray(np.broadcast_to(x0, (*runs, d)).reshape(-1, d).T)
    p, group = _groups(y, p0, runs)
    out = _recursion(x, p, group, y, f, h, q, r)
    shared = p.shape[-1] == 1
    means = np.moveaxis(out.means, 1, -1).reshape(steps, *runs, d)
    covs = np.moveaxis(out.covariances if shared else out.covariances[..., group], -1, 1)
    covs = covs.reshape(steps, *((1,) * len(runs) if shared else runs), d, d)
    return GaussianRun(means, covs, out.log_likelihood.reshape(steps, *runs))


def _prior(mean: ArrayLike, cov: ArrayLike) -> tuple[Array, Array]:
    x = array(mean, "mean", (..., "d"))
    return x, covariance(cov, "cov", x.shape[-1])


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


def _broadcast(runs: tuple[int, ...], mean: Array, cov: Array) -> tuple[int, ...]:
    """The run axes that observations, prior means and prior covariances have in common."""
    for name, axes in (("mean", mean.shape[:-1]), ("cov", cov.shape[:-2])):
        try:
            runs = np.broadcast_shapes(runs, axes)
        except ValueError:
            raise ValueError(
                f"{name}: needs run axes that broadcast with {runs}, got {axes}"
            ) from None
    return runs


def _fill_axes(y: Array, count: int) -> Array:
    """Insert run axes of length one after time, as broadcasting would in front."""
    missing = count - (y.ndim - 2)
    return y.reshape(y.shape[:1] + (1,) * missing + y.shape[1:])


def _groups(y: Array, cov: Array, runs: tuple[int, ...]) -> tuple[Array, _Indices]:
    """Prior covariances (d, d, G), and for each run the index of the covariance it uses.

    Two runs with the same missing components at all times have the same covariances.
    """
    d, size = cov.shape[-1], y.shape[-1]
    if cov.ndim > 2:
        full = np.broadcast_to(cov, (*runs, d, d)).reshape(-1, d, d)
        return np.moveaxis(full, 0, -1).copy(), np.arange(size)
    missing = np.isnan(y).reshape(-1, size)
    if (missing == missing[:, :1]).all():
        group: _Indices = np.zeros(size, dtype=np.intp)
    else:
        _, group = np.unique(np.packbits(missing, axis=0), axis=1, return_inverse=True)
        group = np.asarray(group, dtype=np.intp).reshape(-1)
    count = int(group.max(initial=0)) + 1
    if count == size:
        group = np.arange(size)
    return np.repeat(cov[..., None], count, axis=-1), group


def _recursion(
    x: Array, p: Array, group: _Indices, y: Array, f: Array, h: Array, q: Array, r: Array
) -> GaussianRun:
    """Forecast and analysis over all steps, runs last: x (d, R), p (d, d, G), y (T, m, R)."""
    steps, g = y.shape[0], p.shape[-1]
    means, covs = np.empty((steps, *x.shape)), np.empty((steps, *p.shape))
    squares, log_det = np.empty((steps, x.shape[-1])), np.empty((steps, g))
    missing = np.isnan(y)
    gaps = np.asarray(missing.any(axis=(1, 2)))
    # One representative run shows the pattern of its whole group.
    here = ~missing[:, :, np.unique(group, return_index=True)[1]]
    for k in range(steps):
        p = _forecast_cov(p, f[k], q[k])
        lower, half, p = _analysis_cov(p, h[k], r[k], here[k] if gaps[k] else None)
        x = f[k] @ x
        innovation = y[k] - h[k] @ x
        if gaps[k]:
            innovation[missing[k]] = 0.0
        x, squares[k] = _analysis_mean(x, innovation, lower, half, group)
        log_det[k] = 2.0 * np.log(lower.diagonal()).sum(axis=-1)
        means[k], covs[k] = x, p
    size = y.shape[1] - np.count_nonzero(missing, axis=1)
    likelihood = -0.5 * (size * np.log(2.0 * np.pi) + log_det[:, group] + squares)
    return GaussianRun(means, covs, likelihood)


def _forecast_cov(p: Array, f: Array, q: Array) -> Array:
    """F P F' + Q on (d, d, G), made symmetric here, where rounding breaks it."""
    d, _, g = p.shape
    left = (f @ p.reshape(d, d * g)).reshape(d, d, g)
    out = np.matmul(f, left)
    return np.asarray(0.5 * (out + out.swapaxes(0, 1)) + q[..., None])


def _analysis_cov(
    p: Array, h: Array, r: Array, here: _Mask | None
) -> tuple[Array, Array, Array]:
    """Factor of the innovation covariance, its solve with H P, and the analysis covariance.

    `here` (m, G) marks the components that are not missing; None if none is. A missing component
    keeps its place with a zero row in H and a one on the diagonal of R, which takes it out of
    every sum exactly.
    """
    d, _, g = p.shape
    m = h.shape[0]
    mask = np.ones((m, 1, 1)) if here is None else here[:, None].astype(np.float64)
    cross = np.matmul(h, p).swapaxes(0, 1) * mask  # H P, (m, d, G)
    inner = np.matmul(h, cross) + r[..., None]
    if here is not None:
        inner *= mask * mask.swapaxes(0, 1)
        inner[range(m), range(m)] += 1.0 - mask[:, 0]
    lower = _cholesky(inner)
    half = _forward(lower, cross)  # L^-1 H P: the gain K is half' L^-1
    gain = _backward(lower, half)  # K'
    # Joseph's form, (I - KH) P (I - KH)' + K R K', with A = (I - KH) P and its small factor
    # K R - A H' taken together: it cancels the rounding errors of A along the observed directions.
    kept = p - _sum_of_outer(gain, cross)
    noise = (r @ gain.reshape(m, d * g)).reshape(m, d, g)
    rest = (noise - np.matmul(h, kept).swapaxes(0, 1)) * mask
    out = kept + _sum_of_outer(rest, gain)
    return lower, half, 0.5 * (out + out.swapaxes(0, 1))


def _analysis_mean(
    x: Array, innovation: Array, lower: Array, half: Array, group: _Indices
) -> tuple[Array, Array]:
    """Analysis means (d, R) and squared Mahalanobis lengths of the innovations (R,)."""
    if lower.shape[-1] not in (1, x.shape[-1]):
        lower, half = lower[..., group], half[..., group]
    white = _forward(lower, innovation)
    shared = half.shape[-1] == 1
    moved = half[..., 0].T @ white if shared else (half * white[:, None]).sum(axis=0)
    return x + moved, (white**2).sum(axis=0)


def _sum_of_outer(a: Array, b: Array) -> Array:
    """A' B for stacks (m, d, G) and (m, d, G), (d, d, G)."""
    if a.shape[-1] == 1:
        return np.asarray((a[..., 0].T @ b[..., 0])[..., None])
    out: Array = a[0][:, None] * b[0][None]
    for j in range(1, a.shape[0]):
        out += a[j][:, None] * b[j][None]
    return out


def _cholesky(a: Array) -> Array:
    """Lower Cholesky factors of (m, m, G), column by column over all G at once."""
    if a.shape[-1] == 1:
        return np.asarray(np.linalg.cholesky(a[..., 0])[..., None], dtype=np.float64)
    lower = np.zeros_like(a)
    for j in range(a.shape[0]):
        column = a[j:, j] - (lower[j:, :j] * lower[j, :j]).sum(axis=1)
        if not (column[0] > 0).all():
            raise np.linalg.LinAlgError("the innovation covariance is not positive definite")
        lower[j:, j] = column / np.sqrt(column[0])
    return lower


def _forward(lower: Array, right: Array) -> Array:
    """Solve L z = right for (m, m, G) and (m, ..., G), or for (m, m, 1) and any last axis."""
    if lower.shape[-1] == 1:
        return _triangular_solve(lower[..., 0], right)
    out = np.empty_like(right)
    factors = lower[:, :, None] if right.ndim == 3 else lower
    for j in range(lower.shape[0]):
        done = (factors[j, :j] * out[:j]).sum(axis=0)
        out[j] = (right[j] - done) / lower[j, j]
    return out


def _triangular_solve(lower: Array, right: Array, *, transposed: bool = False) -> Array:
    """One triangular system with all its right-hand sides, by LAPACK."""
    out, _ = dtrtrs(lower, right.reshape(len(right), -1), lower=1, trans=int(transposed))
    return np.asarray(out).reshape(right.shape)


def _backward(lower: Array, right: Array) -> Array:
    """Solve L' z = right for (m, m, G) and (m, d, G)."""
    if lower.shape[-1] == 1:
        return _triangular_solve(lower[..., 0], right, transposed=True)
    out = np.empty_like(right)
    for j in reversed(range(lower.shape[0])):
        done = (lower[j + 1 :, j, None] * out[j + 1 :]).sum(axis=0)
        out[j] = (right[j] - done) / lower[j, j]
    return out


def predict(mean: ArrayLike, cov: ArrayLike, *, F: ArrayLike, Q: ArrayLike) -> tuple[Array, Array]:
    r"""Forecast a Gaussian by a linear step.

    The mean becomes :math:`\mathbf F\mathbf x`, the covariance
    :math:`\mathbf F\mathbf P\mathbf F^\top+\mathbf Q`.

    Parameters
    ----------
    mean : array_like, (..., d)
    cov : array_like, (..., d, d)
        Positive definite.
    F, Q : array_like, (d, d)
        Transition, and process noise covariance (positive semidefinite).

    Returns
    -------
    mean : ndarray, (..., d)
    cov : ndarray, (..., d, d)

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite or a covariance is none.

    Examples
    --------
    >>> predict([1.0], [[2.0]], F=[[3.0]], Q=[[0.5]])
    (array([3.]), array([[18.5]]))
    """
    x, p = _prior(mean, cov)
    d = x.shape[-1]
    f = array(F, "F", (d, d))
    q = array(covariance(Q, "Q", d, semidefinite=True), "Q", (d, d))
    stack = np.ascontiguousarray(np.moveaxis(p.reshape(-1, d, d), 0, -1))
    out = np.moveaxis(_forecast_cov(stack, f, q), -1, 0)
    return x @ f.T, out.reshape(p.shape)


def update(
    mean: ArrayLike, cov: ArrayLike, observed: ArrayLike, *, H: ArrayLike, R: ArrayLike
) -> tuple[Array, Array, Array]:
    r"""Condition a Gaussian on one observation :math:`\mathbf y=\mathbf H\mathbf x+\text{noise}`.

    Parameters
    ----------
    mean : array_like, (..., d)
    cov : array_like, (..., d, d)
        Positive definite.
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

    Raises
    ------
    ValueError
        If a shape is wrong, a number is not finite or a covariance is none.

    Examples
    --------
    >>> x, p, _ = update([0.0], [[1.0]], [2.0], H=[[1.0]], R=[[1.0]])
    >>> x, p
    (array([1.]), array([[0.5]]))
    """
    x, p = _prior(mean, cov)
    h = array(H, "H", ("m", x.shape[-1]))
    y = array(observed, "observed", (..., h.shape[0]), finite=False)
    if np.isinf(y).any():
        raise ValueError("observed: needs finite numbers or NaN (missing), got infinity")
    # The filter's one step without a forecast: identity dynamics and no process noise.
    d = x.shape[-1]
    run = kalman_filter(x, p, y[None], F=np.eye(d), H=h, Q=np.zeros((d, d)), R=R)
    return run.means[0], run.covariances[0], run.log_likelihood[0]
