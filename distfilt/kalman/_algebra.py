"""The Kalman filter's algebra for many runs at once, without checks.

The run axis stands last, ``(d, d, G)``: every product with a matrix that all runs share is then one
large matrix product, and every operation on the small matrices of the filter is vectorised over
the runs. G is the number of different covariances: 1 where all runs share theirs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf, dpotrs, dtrtrs

from ..checks import Array

__all__: list[str] = []

Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]


def left(h: Array, a: Array) -> Array:
    """H A for H (m, d), shared, or (m, d, G), and A (d, k, G): (m, k, G)."""
    d, k, g = a.shape
    if h.ndim == 2:
        return np.asarray((h @ a.reshape(d, k * g)).reshape(len(h), k, g))
    out: Array = h[:, 0, None] * a[0][None]
    for j in range(1, d):
        out += h[:, j, None] * a[j][None]
    return out


def sum_of_outer(a: Array, b: Array) -> Array:
    """A' B for stacks (m, d, G) and (m, k, G), (d, k, G)."""
    if a.shape[-1] == 1:
        return np.asarray((a[..., 0].T @ b[..., 0])[..., None])
    out: Array = a[0][:, None] * b[0][None]
    for j in range(1, a.shape[0]):
        out += a[j][:, None] * b[j][None]
    return out


def symmetric(p: Array) -> Array:
    """The symmetric part of (d, d, G), taken where rounding breaks symmetry."""
    return np.asarray(0.5 * (p + p.swapaxes(0, 1)))


def forecast_cov(p: Array, f: Array, q: Array) -> Array:
    """F P F' + Q on (d, d, G); F and Q (d, d) or (d, d, G)."""
    half = left(f, p)
    return symmetric(left(f, half.swapaxes(0, 1))) + (q if q.ndim == 3 else q[..., None])


def analysis_cov(p: Array, h: Array, r: Array, here: Mask | None) -> tuple[Array, Array, Array]:
    """Factor of the innovation covariance, its solve with H P, and the analysis covariance.

    `here` (m, G) marks the components that are not missing; None if none is. A missing component
    keeps its place with a zero row in H and a one on the diagonal of R, which takes it out of
    every sum exactly.
    """
    d, _, g = p.shape
    m = h.shape[0]
    mask = np.ones((m, 1, 1)) if here is None else here[:, None].astype(np.float64)
    cross = left(h, p) * mask  # H P, (m, d, G)
    inner = left(h, np.ascontiguousarray(cross.swapaxes(0, 1))) + r[..., None]
    if here is not None:
        inner *= mask * mask.swapaxes(0, 1)
        inner[range(m), range(m)] += 1.0 - mask[:, 0]
    lower = cholesky(inner)
    half = forward(lower, cross)  # L^-1 H P: the gain K is half' L^-1
    gain = backward(lower, half)  # K'
    # Joseph's form, (I - KH) P (I - KH)' + K R K', with A = (I - KH) P and its small factor
    # K R - A H' taken together: it cancels the rounding errors of A along the observed directions.
    kept = p - sum_of_outer(gain, cross)
    noise = (r @ gain.reshape(m, d * g)).reshape(m, d, g)
    rest = (noise - left(h, kept.swapaxes(0, 1))) * mask
    return lower, half, symmetric(kept + sum_of_outer(rest, gain))


def analysis_mean(
    x: Array, innovation: Array, lower: Array, half: Array, group: Indices
) -> tuple[Array, Array]:
    """Analysis means (d, R) and squared Mahalanobis lengths of the innovations (R,)."""
    if lower.shape[-1] not in (1, x.shape[-1]):
        lower, half = lower[..., group], half[..., group]
    white = forward(lower, innovation)
    shared = half.shape[-1] == 1
    moved = half[..., 0].T @ white if shared else (half * white[:, None]).sum(axis=0)
    return x + moved, (white**2).sum(axis=0)


def analysis(
    x: Array, p: Array, innovation: Array, h: Array, r: Array, group: Indices
) -> tuple[Array, Array, Array]:
    """Means (d, R), covariances (d, d, G) and log densities (R,) after one observation.

    NaN in the innovation (m, R) marks a missing component; runs of one group miss the same.
    """
    missing = np.isnan(innovation)
    here = None
    if missing.any():
        here = ~missing[:, np.unique(group, return_index=True)[1]]
        innovation = np.where(missing, 0.0, innovation)
    lower, half, p = analysis_cov(p, h, r, here)
    x, squares = analysis_mean(x, innovation, lower, half, group)
    log_det = 2.0 * np.log(lower.diagonal()).sum(axis=-1)
    size = len(innovation) - np.count_nonzero(missing, axis=0)
    return x, p, log_density(size, log_det[group], squares)


def log_density(size: NDArray[np.intp], log_det: Array, squares: Array) -> Array:
    """Log density of innovations with so many components, determinants and squared lengths."""
    return np.asarray(-0.5 * (size * np.log(2.0 * np.pi) + log_det + squares))


def shared_gains(
    p: Array, f: Array, h: Array, q: Array, r: Array, here: Mask
) -> tuple[Array, Array, Array]:
    """Gains (T, d, m), innovation factors (T, m, m) and covariances (T, d, d) of all steps.

    The recursion of one covariance (d, d), which needs no observation; `here` (T, m).
    """
    steps, m, d = h.shape
    gains, lowers, covs = np.empty((steps, d, m)), np.empty((steps, m, m)), np.empty((steps, d, d))
    seen = np.where(here[..., None], h, 0.0)
    both = here[:, :, None] & here[:, None, :]
    noise = np.where(both, r, 0.0) + np.eye(m) * ~here[..., None]
    for k in range(steps):
        p = f[k] @ p @ f[k].T
        p = 0.5 * (p + p.T) + q[k]
        cross = seen[k] @ p
        lower, info = dpotrf(cross @ seen[k].T + noise[k], lower=1, clean=1)
        if info:
            raise np.linalg.LinAlgError(_INDEFINITE)
        gain = dpotrs(lower, cross, lower=1)[0].T
        # Joseph's form, as in analysis_cov.
        kept = p - gain @ cross
        p = kept + (gain @ noise[k] - kept @ seen[k].T) @ gain.T
        p = 0.5 * (p + p.T)
        gains[k], lowers[k], covs[k] = gain, lower, p
    return gains, lowers, covs


_INDEFINITE = "the innovation covariance is not positive definite"


def cholesky(a: Array) -> Array:
    """Lower Cholesky factors of (m, m, G), column by column over all G at once."""
    if a.shape[-1] == 1:
        lower, info = dpotrf(a[..., 0], lower=1, clean=1)
        if info:
            raise np.linalg.LinAlgError(_INDEFINITE)
        return np.asarray(lower[..., None])
    lower = np.zeros_like(a)
    for j in range(a.shape[0]):
        column = a[j:, j] - (lower[j:, :j] * lower[j, :j]).sum(axis=1)
        if not (column[0] > 0).all():
            raise np.linalg.LinAlgError(_INDEFINITE)
        lower[j:, j] = column / np.sqrt(column[0])
    return lower


def forward(lower: Array, right: Array) -> Array:
    """Solve L z = right for (m, m, G) and (m, ..., G), or for (m, m, 1) and any last axis."""
    if lower.shape[-1] == 1:
        return _triangular_solve(lower[..., 0], right)
    out = np.empty_like(right)
    factors = lower[:, :, None] if right.ndim == 3 else lower
    for j in range(lower.shape[0]):
        done = (factors[j, :j] * out[:j]).sum(axis=0)
        out[j] = (right[j] - done) / lower[j, j]
    return out


def backward(lower: Array, right: Array) -> Array:
    """Solve L' z = right for (m, m, G) and (m, d, G)."""
    if lower.shape[-1] == 1:
        return _triangular_solve(lower[..., 0], right, transposed=True)
    out = np.empty_like(right)
    for j in reversed(range(lower.shape[0])):
        done = (lower[j + 1 :, j, None] * out[j + 1 :]).sum(axis=0)
        out[j] = (right[j] - done) / lower[j, j]
    return out


def whitened(lower: Array, rows: Array) -> Array:
    """L^-1 applied to each of the rows (R, m), without a copy of them in another order."""
    if not rows.size:
        return rows
    return np.asarray(dtrsm(1.0, lower, rows.T, lower=1).T)


def _triangular_solve(lower: Array, right: Array, *, transposed: bool = False) -> Array:
    """One triangular system with all its right-hand sides, by LAPACK."""
    if not right.size:
        return right.copy()
    out, _ = dtrtrs(lower, right.reshape(len(right), -1), lower=1, trans=int(transposed))
    return np.asarray(out).reshape(right.shape)
