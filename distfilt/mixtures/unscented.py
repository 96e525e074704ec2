"""Square-root filters at points: each mixand forecast and updated without a derivative.

Two rules share the code. The unscented rule has 2d points with equal positive weights. The divided
differences of second order (DD2) take their step as sqrt(3), which is exact for a Gaussian's fourth
moments along each axis. Both build square roots by QR: no covariance can lose definiteness.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, choice, covariance

__all__ = ["POINT_RULES", "forecast", "update"]

POINT_RULES = ("dd2", "unscented")
"""How points about a mean stand for a Gaussian."""

_LOG_2PI = float(np.log(2 * np.pi))
_STEP = 3.0
"""Square of DD2's step."""
_LARGEST = 1e150
"""Entries of square roots have finite squares."""


def forecast(
    means: ArrayLike,
    factors: ArrayLike,
    function: Callable[[Array], Array],
    noise_factor: ArrayLike,
    *,
    rule: str = "dd2",
) -> tuple[Array, Array]:
    """Means and square roots of the covariances after a function and added noise.

    Parameters
    ----------
    means : array_like, (..., d)
    factors : array_like, (..., d, d)
        Square roots of the covariances.
    function : callable
        On arrays (..., d), returning (..., m).
    noise_factor : array_like, (m, k)
        A square root of the noise's covariance.
    rule : {"dd2", "unscented"}

    Returns
    -------
    means : ndarray, (..., m)
    factors : ndarray, (..., m, m)
        Lower triangular.

    Examples
    --------
    >>> m, s = forecast([1.0], [[0.5]], lambda x: x**2, [[0.0]])
    >>> m, (s @ s.T).round(6)  # E x² = 1.25, and its variance 4 m² P + 2 P²
    (array([1.25]), array([[1.125]]))
    """
    m, s = _gaussians(means, factors)
    choice(rule, "rule", POINT_RULES)
    noise = array(noise_factor, "noise_factor", ("m", "k"))
    mean, first, second = _differences(m, s, callable_(function, "function"), rule)
    if not (np.isfinite(mean).all() and np.isfinite(first).all() and np.isfinite(second).all()):
        raise ValueError("function: needs finite values at the points, got NaN or an overflow")
    if noise.shape[0] != mean.shape[-1]:
        raise ValueError(f"noise_factor: needs {mean.shape[-1]} rows, got {noise.shape[0]}")
    spread = np.broadcast_to(noise, (*mean.shape[:-1], *noise.shape))
    return mean, _root(np.concatenate([first, second, spread], axis=-1))


def update(
    means: ArrayLike,
    factors: ArrayLike,
    observed: ArrayLike,
    function: Callable[[Array], Array],
    noise: ArrayLike,
    *,
    residual: Callable[[Array, Array], Array] | None = None,
    rule: str = "dd2",
) -> tuple[Array, Array, Array, Array]:
    """Condition Gaussians on a reading, and tell how likely it was.

    Parameters
    ----------
    means, factors, function, rule
        As of :func:`forecast`; `function` predicts the reading.
    observed : array_like, (m,)
    noise : array_like, (m, m)
        Covariance of its noise.
    residual : callable, optional
        ``residual(a, b)``, for readings that wrap; subtraction by default.

    Returns
    -------
    means, factors : ndarray, (..., d), (..., d, d)
    log_likelihood : ndarray, (...)
    distance : ndarray, (...)
        Squared Mahalanobis length of the innovation, for a gate.

    Examples
    --------
    >>> m, s, _, _ = update([0.0], [[1.0]], [2.0], lambda x: x, [[1.0]])
    >>> m, (s @ s.T).round(9)
    (array([1.]), array([[0.5]]))
    """
    m, s = _gaussians(means, factors)
    choice(rule, "rule", POINT_RULES)
    y = array(observed, "observed", ("m",))
    r = np.linalg.cholesky(covariance(array(noise, "noise", (y.size, y.size)), "noise"))
    gap = np.subtract if residual is None else callable_(residual, "residual")
    centre = np.asarray(callable_(function, "function")(m))

    def about(x: Array) -> Array:
        # Relative to the prediction at the mean, so that angles do not wrap between points.
        seen = np.asarray(function(x))
        lead = (None,) * (seen.ndim - centre.ndim)
        base = np.broadcast_to(np.moveaxis(centre, -1, -1)[lead] if lead else centre, seen.shape)
        return np.asarray(gap(seen, base))

    mean, first, second = _differences(m, s, about, rule)
    noises = np.broadcast_to(r, (*mean.shape[:-1], *r.shape))
    root = _root(np.concatenate([first, second, noises], axis=-1))
    surprise = np.asarray(gap(np.broadcast_to(y, centre.shape), centre)) - mean
    white = np.linalg.solve(root, surprise[..., None])[..., 0]
    cross = s @ np.swapaxes(first, -1, -2)
    half = np.linalg.solve(root, np.swapaxes(cross, -1, -2))
    gain = np.swapaxes(np.linalg.solve(np.swapaxes(root, -1, -2), half), -1, -2)
    after = np.concatenate([s - gain @ first, gain @ second, gain @ noises], axis=-1)
    distance = np.asarray((white**2).sum(axis=-1))
    logs = -0.5 * distance - np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
    moved = m + (gain @ surprise[..., None])[..., 0]
    return moved, _root(after), np.asarray(logs - 0.5 * y.size * _LOG_2PI), distance


def _gaussians(means: ArrayLike, factors: ArrayLike) -> tuple[Array, Array]:
    m = array(means, "means", (..., "d"))
    s = array(factors, "factors", (*m.shape, m.shape[-1]))
    if (np.abs(np.diagonal(s, axis1=-2, axis2=-1)) == 0).any():
        raise ValueError("factors: needs square roots of full rank, got a zero on a diagonal")
    largest = float(np.abs(s).max(initial=0.0))
    if largest > _LARGEST:
        raise ValueError(f"factors: needs entries up to {_LARGEST:g}, got {largest:g}")
    return m, s


def _differences(
    m: Array, s: Array, function: Callable[[Array], Array], rule: str
) -> tuple[Array, Array, Array]:
    """Mean (..., m) of a function, and its first and second differences as columns."""
    d = m.shape[-1]
    h2 = _STEP if rule == "dd2" else float(d)
    moves = np.sqrt(h2) * np.swapaxes(s, -1, -2)
    around = [m[..., None, :] + moves, m[..., None, :] - moves]
    points = np.moveaxis(np.concatenate(around, axis=-2), -2, 0)
    ends = np.asarray(function(points))
    plus, minus = ends[:d], ends[d:]
    first = np.moveaxis(plus - minus, 0, -1) / (2 * np.sqrt(h2))
    if rule == "unscented":
        mean = ends.mean(axis=0)
        # What is even about the mean: each pair's middle, from the mean of all.
        second = np.moveaxis(0.5 * (plus + minus) - mean, 0, -1) / np.sqrt(d)
        return mean, first, second
    centre = np.asarray(function(m))
    even = plus + minus - 2 * centre
    mean = centre + even.sum(axis=0) / (2 * h2)
    return mean, first, np.moveaxis(even, 0, -1) * np.sqrt(h2 - 1) / (2 * h2)


def _root(wide: Array) -> Array:
    """Lower triangular L with L L' = A A', for A (..., m, k), with a positive diagonal."""
    upper = np.linalg.qr(np.swapaxes(wide, -1, -2), mode="r")
    lower = np.swapaxes(upper, -1, -2)
    sign = np.where(np.diagonal(lower, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    return np.asarray(lower * sign[..., None, :])
