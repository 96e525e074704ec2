"""Weights of covariance intersection for which the result's determinant or trace is least."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..checks import Array
from ..linalg import _cholesky, _log_det, _solve_lower

__all__: list[str] = []

_GAP = 1e-7
"""How far the derivatives may be from the conditions of the optimum, relative to their mean."""
_STEPS = 60
_LEAST = 1e-30
"""A weight that vanishes stays above it: zero could not grow again."""


def _least(covs: Array, here: NDArray[np.bool_], determinant: bool) -> Array:
    """Weights of least determinant or trace; :func:`.intersection_weights` says how and why."""
    # Where ratios of covariances leave the range of numbers, no gap is found, and none is taken.
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        return _iterated(covs, here, determinant)


def _iterated(covs: Array, here: NDArray[np.bool_], determinant: bool) -> Array:
    leading, (s, d) = here.shape[:-1], covs.shape[-3:-1]
    there = here.reshape(-1, s).astype(np.float64)
    lower = _factors(covs, here).reshape(-1, s, d, d)
    # In the first one's coordinates, as in an intersection; traces are taken in the state's own.
    roots = _solve_lower(lower, np.broadcast_to(lower[:, :1], lower.shape))
    roots *= there[..., None, None]
    problem = _Problem(roots, _square(roots.swapaxes(-1, -2)), lower[:, 0], there, determinant)
    point = there / there.sum(axis=-1, keepdims=True)
    best, sure = point.copy(), point
    left, share = np.arange(len(point)), np.ones((len(point), 1))
    lowest = bound = np.full(len(point), np.inf)
    for _ in range(_STEPS):
        value, slope, curvature = problem.derivatives(point)
        mean = (point * slope).sum(axis=-1, keepdims=True)
        gap = slope.max(axis=-1) / mean[:, 0] - 1
        # What is settled stays: the others' need for more steps must not move it.
        lower_gap = (gap < lowest) & (lowest > _GAP)
        best[left[lower_gap]] = point[lower_gap]
        lowest = np.where(lower_gap, gap, lowest)
        open_ = lowest > _GAP
        if not open_.any():
            break
        # A Newton step counts if it gains a share of what its slope promised; else its start's
        # sure step does, whatever the value there, and the next Newton step is cut.
        at = (value <= bound)[:, None]
        share = np.where(at, np.minimum(2 * share, 1.0), 0.25 * share)
        newton = _newton(point, slope, mean, curvature, problem.there)
        newton = point + share * (newton - point)
        scaled = _scaled(point, slope / mean, determinant)
        gain = (slope * (newton - point)).sum(axis=-1)
        aim = np.where(gain > 0, value - 1e-3 * gain + 1e-13 * (1 + np.abs(value)), -np.inf)
        bound = np.where(at[:, 0], aim, np.inf)
        point, sure = np.where(at, newton, sure), np.where(at, scaled, sure)
        if 2 * np.count_nonzero(open_) <= len(open_):
            problem = problem.part(open_)
            left, lowest, bound = left[open_], lowest[open_], bound[open_]
            point, sure, share = point[open_], sure[open_], share[open_]
    return np.asarray(best.reshape(*leading, s))


@dataclass(frozen=True, eq=False)
class _Problem:
    """Sources of n intersections in coordinates in which the first has the unit covariance."""

    roots: Array
    information: Array
    first: Array
    there: Array
    determinant: bool

    def part(self, keep: NDArray[np.bool_]) -> _Problem:
        parts = (self.roots[keep], self.information[keep], self.first[keep], self.there[keep])
        return _Problem(*parts, self.determinant)

    def derivatives(self, weights: Array) -> tuple[Array, Array, Array]:
        """What is made least (n,), minus its gradient (n, S), its second derivatives (n, S, S)."""
        n, s, d, _ = self.roots.shape
        total = weights[:, None, :] @ self.information.reshape(n, s, d * d)
        lower = _cholesky_or_qr(total.reshape(n, d, d), np.zeros((1, 1)), weights, self.roots)
        half = _solve_lower(lower, self.roots.reshape(n, s * d, d).swapaxes(-1, -2))
        # Each source's information where that of the result is the identity, (n, S, d, d).
        shares = _square(half.reshape(n, d, s, d).swapaxes(1, 2))
        if self.determinant:
            flat = shares.reshape(n, s, d * d)
            return -_log_det(lower), np.einsum("nsii->ns", shares), flat @ flat.swapaxes(-1, -2)
        spread = _solve_lower(lower, self.first.swapaxes(-1, -2))
        flat = (shares @ spread[:, None]).reshape(n, s, d * d)
        slope = (flat @ spread.reshape(n, d * d, 1))[..., 0]
        return (spread**2).sum(axis=(-2, -1)), slope, 2 * flat @ flat.swapaxes(-1, -2)


def _square(root: Array) -> Array:
    """A A' of small matrices; a copy of A' is five times as fast as its view."""
    return np.asarray(np.ascontiguousarray(root) @ np.ascontiguousarray(root.swapaxes(-1, -2)))


def _newton(weights: Array, slope: Array, mean: Array, curvature: Array, there: Array) -> Array:
    """A Newton step on the simplex; a weight that wants to vanish shrinks a thousandfold."""
    size = curvature.max(axis=(-2, -1))[:, None]
    held = np.maximum(mean - slope, 0.0) / np.maximum(weights, _LEAST)
    ridge = there * (held + 1e-12 * size) + (1 - there) * size
    matrix = curvature + ridge[..., None] * np.eye(weights.shape[-1])
    scale = np.sqrt(np.diagonal(matrix, axis1=-2, axis2=-1))[..., None]
    matrix /= scale * scale.swapaxes(-1, -2)
    try:
        solved = np.linalg.solve(matrix, np.stack([slope, there], axis=-1) / scale) / scale
    except np.linalg.LinAlgError:
        return weights  # which is not better: the sure step follows
    pull, ones = solved.sum(axis=1).T[..., None]
    out = weights + solved[..., 0] - pull / ones * solved[..., 1]
    out = np.maximum(out, np.maximum(1e-3 * weights, _LEAST * there))
    return np.asarray(out / out.sum(axis=-1, keepdims=True))


def _scaled(weights: Array, ratio: Array, determinant: bool) -> Array:
    """The sure step: weights times their slopes over the mean one, or the root of that."""
    out = weights * (ratio if determinant else np.sqrt(ratio))
    return np.asarray(out / out.sum(axis=-1, keepdims=True))


def _factors(covs: Array, here: NDArray[np.bool_]) -> Array:
    """Cholesky factors (..., S, d, d) of the sources; the identity for one that is not here."""
    full = covs if here.all() else np.where(here[..., None, None], covs, np.eye(covs.shape[-1]))
    return _cholesky(full)


def _cholesky_or_qr(total: Array, own: Array, weights: Array, roots: Array) -> Array:
    """Cholesky factor of own I + sum of w G' G; from the G where rounding spoils their squares."""
    try:
        return _cholesky(total)
    except np.linalg.LinAlgError:
        d = roots.shape[-1]
        tall = np.sqrt(weights)[..., None, None] * roots
        tall = tall.reshape(*tall.shape[:-3], -1, d)
        first = np.broadcast_to(np.sqrt(own) * np.eye(d), (*tall.shape[:-2], d, d))
        upper: Array = np.asarray(np.linalg.qr(np.concatenate([first, tall], axis=-2), mode="r"))
        sign = np.where(np.diagonal(upper, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
        return np.asarray((upper * sign[..., None]).swapaxes(-1, -2))
