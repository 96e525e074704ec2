"""Weights of covariance intersection for which the result's determinant or trace is least."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..checks import Array
from ..linalg import _cholesky, _log_det, _solve_lower

__all__: list[str] = []

_GAP = 1e-9
"""How far the derivatives may be from the conditions of the optimum, relative to their mean."""


def _least(covs: Array, here: NDArray[np.bool_], determinant: bool) -> Array:
    """Weights of least determinant or trace, by sure steps and Newton steps; see the public one."""
    leading, (n, d) = here.shape[:-1], covs.shape[-3:-1]
    there = here.reshape(-1, n)
    lower = _factors(covs, here).reshape(-1, n, d, d)
    first = lower[:, 0]
    # In the first one's coordinates, as in an intersection: information squared^T squared.
    roots = _solve_lower(lower, np.broadcast_to(first[:, None], lower.shape))
    metric = np.broadcast_to(np.eye(d), first.shape) if determinant else first
    weights = there / there.sum(axis=-1, keepdims=True)
    left = np.arange(len(weights))
    for _ in range(100):
        roots_left, metric_left, there_left = roots[left], metric[left], there[left]
        better, gap = _improved(weights[left], roots_left, metric_left, there_left, determinant)
        open_ = gap > _GAP
        left = left[open_]
        weights[left] = better[open_]
        if not left.size:
            break
    return np.asarray(weights.reshape(*leading, n))


def _objective(
    weights: Array, roots: Array, metric: Array, determinant: bool
) -> tuple[Array, Array]:
    """What is made least, (n,), and the Cholesky factor of the information."""
    wide = np.sqrt(weights)[..., None, None] * roots
    lower = _sum_of_squares(np.zeros(len(weights)), wide.reshape(len(wide), -1, wide.shape[-1]))
    if determinant:
        return -_log_det(lower), lower
    return np.asarray((_solve_lower(lower, metric.swapaxes(-1, -2)) ** 2).sum(axis=(-2, -1))), lower


def _improved(
    weights: Array, roots: Array, metric: Array, there: NDArray[np.bool_], determinant: bool
) -> tuple[Array, Array]:
    """The better of the sure step and a Newton step, and how far the weights are from optimal."""
    n, s, d, _ = roots.shape
    _, lower = _objective(weights, roots, metric, determinant)
    flat = roots.reshape(n, s * d, d).swapaxes(-1, -2)
    half = _solve_lower(lower, flat).reshape(n, d, s, d).swapaxes(1, 2)
    shares = half @ half.swapaxes(-1, -2)  # (n, S, d, d), in which the information is the identity
    unit = metric
    if not determinant:
        unit = _solve_lower(lower, metric.swapaxes(-1, -2))
        shares = shares @ unit[:, None]
    shares = np.where(there[..., None, None], shares, 0.0).reshape(n, s, d * d)
    slope = (shares @ unit.reshape(n, d * d, 1))[..., 0]
    mean = (weights * slope).sum(axis=-1, keepdims=True)
    gap = slope.max(axis=-1) / mean[:, 0] - 1
    sure = weights * (slope if determinant else np.sqrt(slope))
    sure /= sure.sum(axis=-1, keepdims=True)
    curvature = shares @ shares.swapaxes(-1, -2) * (1.0 if determinant else 2.0)
    newton = _newton(weights, slope, mean, curvature, there)
    at_sure = _objective(sure, roots, metric, determinant)[0]
    at_newton = _objective(newton, roots, metric, determinant)[0]
    better = at_newton <= at_sure + 1e-13 * (1 + np.abs(at_sure))
    return np.where(better[:, None], newton, sure), gap


def _newton(
    weights: Array, slope: Array, mean: Array, curvature: Array, there: NDArray[np.bool_]
) -> Array:
    """A Newton step on the simplex; a weight that wants to vanish shrinks a thousandfold."""
    held = np.where(there, np.maximum(mean - slope, 0.0) / np.where(there, weights, 1.0), 1.0)
    size = np.diagonal(curvature, axis1=-2, axis2=-1).max(axis=-1)[:, None]
    ridge = held + 1e-12 * size + np.where(there, 0.0, size)
    matrix = curvature + ridge[..., None] * np.eye(weights.shape[-1])
    both = np.stack([slope, there.astype(np.float64)], axis=-1)
    solved = np.linalg.solve(matrix, both)
    pull, ones = solved[..., 0], solved[..., 1]
    step = pull - (pull.sum(-1, keepdims=True) / ones.sum(-1, keepdims=True)) * ones
    out = np.maximum(weights + step, 1e-3 * weights)
    return np.asarray(out / out.sum(axis=-1, keepdims=True))


def _factors(covs: Array, here: NDArray[np.bool_]) -> Array:
    """Cholesky factors (..., S, d, d) of the sources; the identity for one that is not here."""
    full = covs if here.all() else np.where(here[..., None, None], covs, np.eye(covs.shape[-1]))
    return _cholesky(full)


def _sum_of_squares(own: Array, wide: Array) -> Array:
    """Cholesky factor of own² I + wide' wide."""
    eye = np.eye(wide.shape[-1])
    try:
        return _cholesky(own[..., None, None] ** 2 * eye + wide.swapaxes(-1, -2) @ wide)
    except np.linalg.LinAlgError:  # squared, the sources' ratio leaves the range of numbers
        tall = np.concatenate([own[..., None, None] * eye, wide], axis=-2)
        upper: Array = np.asarray(np.linalg.qr(tall, mode="r"))
        sign = np.where(np.diagonal(upper, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
        return np.asarray((upper * sign[..., None]).swapaxes(-1, -2))
