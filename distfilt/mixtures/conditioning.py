"""A whole mixture forecast and conditioned on a reading: square-root filters at points, no slope.

Divided differences of second order (DD2), with the step sqrt(3), which is exact for a Gaussian's
fourth moments along each axis. Square roots are built by QR: no covariance can lose definiteness.
Filters call these functions, with models and sensors that have been checked.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..gaussians.single import unscented_points
from ..linalg import cholesky, log_det, lower_root, quadratic_form
from ..validation import Array
from .gaussian import GaussianMixture

__all__ = ["propagate_mixture", "update_mixture", "within_gate"]

_LOG_2PI = float(np.log(2 * np.pi))
# Square of the step, in units of the variance.
_STEP = 3.0
# Mixands lighter than this are left out after a reading.
_NOTHING = 1e-9


def propagate_mixture(
    mixture: GaussianMixture, function: Callable[[Array], Array], noise_factor: Array
) -> GaussianMixture:
    """The mixture after a function and added noise, mixand by mixand.

    Parameters
    ----------
    mixture : GaussianMixture
    function : callable
        On arrays (..., d), returning (..., m).
    noise_factor : ndarray, (m, k)
        A square root of the noise's covariance.

    Examples
    --------
    >>> one = GaussianMixture.gaussian([1.0], [[0.25]])
    >>> after = propagate_mixture(one, lambda x: x**2, np.zeros((1, 1)))
    >>> after.means, after.covs.round(6)  # E x² = 1.25, and its variance 4 m² P + 2 P²
    (array([[1.25]]), array([[[1.125]]]))
    """
    means, first, second = _differences(np.asarray(function(_points(mixture))))
    if not all(np.isfinite(part).all() for part in (means, first, second)):
        raise ValueError(
            "function must be finite values at the points, got NaN or an overflow"
        )
    return _of_roots(mixture.weights, means, _root(first, second, noise_factor))


def update_mixture(
    mixture: GaussianMixture,
    observed: Array,
    function: Callable[[Array], Array],
    noise: Array,
    *,
    residual: Callable[[Array, Array], Array] = np.subtract,
) -> GaussianMixture:
    """Condition a mixture on a reading: its mixands, and their weights by how likely it was.

    A mixand that cannot explain the reading (`function` is NaN at one of its points) is left out.

    Parameters
    ----------
    mixture : GaussianMixture
    observed : ndarray, (m,)
        NaN marks a missing component.
    function : callable
        What predicts the reading, on arrays (..., d), returning (..., m).
    noise : ndarray, (m, m)
        Covariance of its noise.
    residual : callable
        ``residual(a, b)``, for readings that wrap.

    Raises
    ------
    ValueError
        If no mixand can explain the reading.

    Examples
    --------
    >>> two = GaussianMixture([0.5, 0.5], [[-2.0], [2.0]], [[[1.0]], [[1.0]]])
    >>> after = update_mixture(two, np.ones(1), lambda x: x, np.eye(1))
    >>> after.means.ravel().round(6), after.weights.round(3)
    (array([-0.5,  1.5]), array([0.119, 0.881]))
    """
    if np.isnan(observed).all():
        return mixture
    surprise, first, second, noises = _innovations(
        mixture, observed, function, noise, residual
    )
    root = _root(first, second, noises)
    cross = mixture.factors @ first.mT
    gain = np.linalg.solve(root.mT, np.linalg.solve(root, cross.mT)).mT
    factors = _root(mixture.factors - gain @ first, gain @ second, gain @ noises)
    means = mixture.means + (gain @ surprise[..., None])[..., 0]
    logs = -0.5 * (
        quadratic_form(root, surprise) + log_det(root) + len(noises) * _LOG_2PI
    )
    logs = np.where(np.isfinite(logs), mixture.log_weights + logs, -np.inf)
    if not np.isfinite(logs.max()):
        raise ValueError(
            "observed must be a target that can be seen, got one that cannot"
        )
    w = np.exp(logs - logs.max())
    w /= w.sum()
    keep = w > _NOTHING
    return _of_roots(w[keep] / w[keep].sum(), means[keep], factors[keep])


def within_gate(
    mixture: GaussianMixture,
    observed: Array,
    function: Callable[[Array], Array],
    noise: Array,
    *,
    gate: float,
    residual: Callable[[Array, Array], Array] = np.subtract,
) -> Array:
    """The reading, or NaN in its place where no mixand expects it.

    Parameters
    ----------
    mixture, observed, function, noise, residual
        As of :func:`updated`.
    gate : float
        How many standard deviations a reading may lie from the nearest mixand's prediction.

    Examples
    --------
    >>> two = GaussianMixture([0.5, 0.5], [[-9.0], [9.0]], [[[1.0]], [[1.0]]])
    >>> [
    ...     within_gate(two, np.array([y]), lambda x: x, np.eye(1), gate=3.0)
    ...     for y in (0.0, 9.5)
    ... ]
    [array([nan]), array([9.5])]
    """
    surprise, *columns = _innovations(mixture, observed, function, noise, residual)
    far = np.where(
        mixture.weights > 0, quadratic_form(_root(*columns), surprise), np.nan
    )
    # A mixand that cannot see the target expects nothing.
    refused = np.isfinite(far).any() and np.nanmin(far) > gate**2
    return np.full_like(observed, np.nan) if refused else observed


def _innovations(
    mixture: GaussianMixture,
    observed: Array,
    function: Callable[[Array], Array],
    noise: Array,
    residual: Callable[[Array, Array], Array],
) -> tuple[Array, Array, Array, Array]:
    """Innovations (L, k) of what is there, differences of its prediction, its noise's root."""
    here = np.flatnonzero(~np.isnan(observed))
    # A residual may need every component; those that are missing are zeros in both.
    y = np.where(np.isnan(observed), 0.0, observed)
    seen = np.where(np.isnan(observed), 0.0, function(_points(mixture)))
    centre = seen[:, 0]
    # Relative to the prediction at the mean, so that angles do not wrap between points.
    about = residual(seen, np.broadcast_to(centre[:, None], seen.shape))
    mean, first, second = _differences(about[..., here])
    surprise = residual(np.broadcast_to(y, centre.shape), centre)[..., here] - mean
    return surprise, first, second, cholesky(noise[np.ix_(here, here)])


def _points(mixture: GaussianMixture) -> Array:
    kappa = _STEP - mixture.dim
    return unscented_points(mixture.means, mixture.factors, kappa=kappa)[0]


def _differences(values: Array) -> tuple[Array, Array, Array]:
    """Mean (..., m) of a function's values at points, and first and second differences, columns."""
    d = values.shape[-2] // 2
    centre = values[..., :1, :]
    plus = values[..., 1 : d + 1, :]
    minus = values[..., d + 1 :, :]
    even = plus + minus - 2 * centre
    mean = centre[..., 0, :] + even.sum(axis=-2) / (2 * _STEP)
    first = (plus - minus).mT / (2 * np.sqrt(_STEP))
    return mean, first, even.mT * np.sqrt(_STEP - 1) / (2 * _STEP)


def _root(first: Array, second: Array, noise: Array) -> Array:
    """Lower triangular L with L L' = A A' for A of these columns."""
    noise = np.broadcast_to(noise, (*first.shape[:-2], *noise.shape[-2:]))
    return lower_root(np.concatenate([first, second, noise], axis=-1))


def _of_roots(weights: Array, means: Array, factors: Array) -> GaussianMixture:
    """A mixture that keeps the square roots it came with."""
    return GaussianMixture.construct(
        weights, means, factors @ factors.mT, factors=factors
    )
