"""A whole mixture forecast and conditioned on a reading: square-root filters at points, no slope.

Two rules share the code. The unscented rule has 2d points with equal positive weights. The divided
differences of second order (DD2) take their step as sqrt(3), which is exact for a Gaussian's fourth
moments along each axis. Both build square roots by QR: no covariance can lose definiteness.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Literal

import numpy as np

from ..doors import MISSING, Array, Bounds, Cov, door, unchecked
from ..gaussians.single import unscented_points
from .gaussian import GaussianMixture

__all__ = ["PointRule", "conditioned", "moved", "within_gate"]

PointRule = Literal["dd2", "unscented"]
"""How points about a mean stand for a Gaussian."""

_LOG_2PI = float(np.log(2 * np.pi))
_STEP = 3.0
"""Square of DD2's step."""
_NOTHING = 1e-9
"""Mixands lighter than this are left out after a reading."""


@door
def moved(
    mixture: GaussianMixture, function: Callable[[Array], Array],
    noise_factor: Annotated[Array, "m k"], *, rule: PointRule = "dd2",
) -> GaussianMixture:
    """The mixture after a function and added noise, mixand by mixand.

    Parameters
    ----------
    mixture : GaussianMixture
    function : callable
        On arrays (..., d), returning (..., m).
    noise_factor : array_like, (m, k)
        A square root of the noise's covariance.
    rule : {"dd2", "unscented"}

    Examples
    --------
    >>> one = GaussianMixture.gaussian([1.0], [[0.25]])
    >>> after = moved(one, lambda x: x**2, [[0.0]])
    >>> after.means, after.covs.round(6)  # E x² = 1.25, and its variance 4 m² P + 2 P²
    (array([[1.25]]), array([[[1.125]]]))
    """
    means, first, second = _differences(np.asarray(function(_points(mixture, rule))), rule)
    if not all(np.isfinite(part).all() for part in (means, first, second)):
        raise ValueError("function: needs finite values at the points, got NaN or an overflow")
    if len(noise_factor) != means.shape[-1]:
        raise ValueError(f"noise_factor: needs {means.shape[-1]} rows, got {len(noise_factor)}")
    return _of_roots(mixture.weights, means, _root(first, second, noise_factor))


@door
def conditioned(
    mixture: GaussianMixture, observed: Annotated[Array, "m", MISSING],
    function: Callable[[Array], Array], noise: Annotated[Cov, "m m"], *,
    residual: Callable[[Array, Array], Array] = np.subtract, rule: PointRule = "dd2",
) -> GaussianMixture:
    """Condition a mixture on a reading: its mixands, and their weights by how likely it was.

    A mixand that cannot explain the reading (`function` is NaN at one of its points) is left out.

    Parameters
    ----------
    mixture : GaussianMixture
    observed : array_like, (m,)
        NaN marks a missing component.
    function : callable
        What predicts the reading, on arrays (..., d), returning (..., m).
    noise : array_like, (m, m)
        Covariance of its noise.
    residual : callable
        ``residual(a, b)``, for readings that wrap.
    rule : {"dd2", "unscented"}

    Raises
    ------
    ValueError
        If no mixand can explain the reading.

    Examples
    --------
    >>> two = GaussianMixture([0.5, 0.5], [[-2.0], [2.0]], [[[1.0]], [[1.0]]])
    >>> after = conditioned(two, [1.0], lambda x: x, [[1.0]])
    >>> after.means.ravel().round(6), after.weights.round(3)
    (array([-0.5,  1.5]), array([0.119, 0.881]))
    """
    here = np.flatnonzero(~np.isnan(observed))
    if not here.size:
        return mixture
    surprise, first, second = _innovations(mixture, observed, function, residual, rule, here)
    noises = np.asarray(np.linalg.cholesky(noise[np.ix_(here, here)]))
    root = _root(first, second, noises)
    cross = mixture.factors @ first.mT
    gain = np.linalg.solve(root.mT, np.linalg.solve(root, cross.mT)).mT
    factors = _root(mixture.factors - gain @ first, gain @ second, gain @ noises)
    means = mixture.means + (gain @ surprise[..., None])[..., 0]
    logs = -0.5 * _lengths(root, surprise)
    logs -= np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1) + 0.5 * here.size * _LOG_2PI
    logs = np.where(np.isfinite(logs), mixture.log_weights + logs, -np.inf)
    if not np.isfinite(logs.max()):
        raise ValueError("observed: needs a target that can be seen, got one that cannot")
    w = np.exp(logs - logs.max())
    w /= w.sum()
    keep = w > _NOTHING
    return _of_roots(w[keep] / w[keep].sum(), means[keep], factors[keep])


@door
def within_gate(
    mixture: GaussianMixture, observed: Annotated[Array, "m", MISSING],
    function: Callable[[Array], Array], noise: Annotated[Cov, "m m"], *,
    gate: Annotated[float, Bounds(above=0, at_most=1e150)],
    readings: Sequence[slice] = (slice(None),),
    residual: Callable[[Array, Array], Array] = np.subtract, rule: PointRule = "dd2",
) -> Array:
    """What is left of a reading after a gate: NaN takes the place of what no mixand expects.

    Parameters
    ----------
    mixture, observed, function, noise, residual, rule
        As of :func:`conditioned`.
    gate : float
        How many standard deviations a reading may lie from the nearest mixand's prediction.
    readings : sequence of slice
        Which components are one reading each, tested by itself; all of them by default.

    Examples
    --------
    >>> two = GaussianMixture([0.5, 0.5], [[-9.0], [9.0]], [[[1.0]], [[1.0]]])
    >>> within_gate(two, [0.0, 9.5], lambda x: x.repeat(2, axis=-1), np.eye(2), gate=3.0,
    ...             readings=[slice(0, 1), slice(1, 2)])
    array([nan, 9.5])
    """
    out = observed.copy()
    here = np.flatnonzero(~np.isnan(observed))
    surprise, first, second = _innovations(mixture, observed, function, residual, rule, here)
    for reading in readings:
        part = np.isin(here, np.arange(observed.size)[reading])
        noises = np.asarray(np.linalg.cholesky(noise[np.ix_(here[part], here[part])]))
        far = _lengths(_root(first[:, part], second[:, part], noises), surprise[:, part])
        # A mixand that cannot see the target expects nothing.
        if np.isfinite(far).any() and np.nanmin(far) > gate**2:
            out[here[part]] = np.nan
    return out


def _innovations(
    mixture: GaussianMixture, observed: Array, function: Callable[[Array], Array],
    residual: Callable[[Array, Array], Array],
    rule: PointRule, here: np.ndarray[tuple[int], np.dtype[np.intp]],
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Innovations (L, k) of the components that are there, and differences of their prediction."""
    # A residual may need every component; those that are missing are zeros in both.
    y = np.where(np.isnan(observed), 0.0, observed)
    seen = np.where(np.isnan(observed), 0.0, function(_points(mixture, rule)))
    centre = seen[:, 0]
    # Relative to the prediction at the mean, so that angles do not wrap between points.
    about = residual(seen, np.broadcast_to(centre[:, None], seen.shape))
    mean, first, second = _differences(about[..., here], rule)
    surprise = residual(np.broadcast_to(y, centre.shape), centre)[..., here] - mean
    return surprise, first, second


def _points(mixture: GaussianMixture, rule: PointRule) -> Array:
    kappa = _STEP - mixture.dim if rule == "dd2" else 0.0
    return unchecked(unscented_points)(mixture.means, mixture.factors, kappa=kappa)[0]


def _differences(values: Array, rule: PointRule) -> tuple[Array, Array, Array]:
    """Mean (..., m) of a function's values at points, and first and second differences, columns."""
    d = values.shape[-2] // 2
    h2 = _STEP if rule == "dd2" else float(d)
    centre, plus, minus = values[..., :1, :], values[..., 1 : d + 1, :], values[..., d + 1 :, :]
    first = (plus - minus).mT / (2 * np.sqrt(h2))
    if rule == "unscented":
        mean = values[..., 1:, :].mean(axis=-2)
        # What is even about the mean: each pair's middle, from the mean of all.
        return mean, first, (0.5 * (plus + minus) - mean[..., None, :]).mT / np.sqrt(d)
    even = plus + minus - 2 * centre
    mean = centre[..., 0, :] + even.sum(axis=-2) / (2 * h2)
    return mean, first, even.mT * np.sqrt(h2 - 1) / (2 * h2)


def _root(first: Array, second: Array, noise: Array) -> Array:
    """Lower triangular L with L L' = A A' for A of these columns, with a positive diagonal."""
    noise = np.broadcast_to(noise, (*first.shape[:-2], *noise.shape[-2:]))
    columns = np.concatenate([first, second, noise], axis=-1)
    lower = np.swapaxes(np.linalg.qr(columns.mT, mode="r"), -1, -2)
    sign = np.where(np.diagonal(lower, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    return np.asarray(lower * sign[..., None, :])


def _lengths(root: Array, gap: Array) -> Array:
    """Squared Mahalanobis lengths (L,) of gaps (L, m)."""
    return np.asarray((np.linalg.solve(root, gap[..., None])[..., 0] ** 2).sum(axis=-1))


def _of_roots(weights: Array, means: Array, factors: Array) -> GaussianMixture:
    """A mixture that keeps the square roots it came with."""
    return GaussianMixture.unchecked(weights, means, factors @ factors.mT, factors=factors)
