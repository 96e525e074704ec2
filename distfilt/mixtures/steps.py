"""A step of a whole mixture: split where a map stretches it, move it, condition it on a reading."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..checks import Array, array, callable_, count, instance, number
from .gaussian import GaussianMixture, trusted
from .splitting import split, stretching
from .unscented import forecast, update

__all__ = ["conditioned", "moved", "split_stretched"]

_LIGHT = 1e-3
"""Mixands lighter than this are not split."""
_NOTHING = 1e-9
"""Mixands lighter than this are left out after a reading."""


def split_stretched(
    mixture: GaussianMixture, jacobian: Callable[[Array], Array], *, most: int, stretch: float,
    scale: ArrayLike | None = None,
) -> GaussianMixture:
    """Split the mixands that a map stretches most in three, up to three times over.

    Parameters
    ----------
    mixture : GaussianMixture
    jacobian : callable
        The map's derivatives (L, m, d), or one (m, d) for all, at means (L, d).
    most : int
        How many mixands there may be.
    stretch : float
        A mixand is split if its weight times its largest stretching is above this.
    scale : array_like, (m,), optional
        As of :func:`stretching`.

    Examples
    --------
    >>> one = GaussianMixture.gaussian([0.0], [[1.0]])
    >>> split_stretched(one, lambda x: 2 * np.ones((1, 1)), most=4, stretch=1.0).size
    3
    """
    instance(mixture, "mixture", GaussianMixture)
    callable_(jacobian, "jacobian")
    limit, largest = number(stretch, "stretch", above=0), count(most, "most")
    for _ in range(3):
        room = (largest - mixture.size) // 2
        if room < 1:
            break
        slope = jacobian(mixture.means)
        slope = np.broadcast_to(slope, (mixture.size, *np.shape(slope)[-2:]))
        directions, lengths = stretching(mixture.factors, slope, scale=scale)
        cost = np.where(mixture.weights > _LIGHT, mixture.weights * lengths, 0.0)
        worst = np.argsort(-cost, kind="stable")[:room]
        worst = worst[cost[worst] > limit]
        if not worst.size:
            break
        mixture = split(mixture, worst, directions[worst])
    return mixture


def moved(
    mixture: GaussianMixture, function: Callable[[Array], Array], noise_factor: ArrayLike, *,
    rule: str = "dd2",
) -> GaussianMixture:
    """The mixture after a function and added noise, mixand by mixand.

    Parameters
    ----------
    mixture : GaussianMixture
    function, noise_factor, rule
        As of :func:`distfilt.mixtures.unscented.forecast`.

    Examples
    --------
    >>> one = GaussianMixture.gaussian([1.0], [[0.25]])
    >>> moved(one, lambda x: 2 * x, [[1.0]]).covs.round(9)
    array([[[2.]]])
    """
    instance(mixture, "mixture", GaussianMixture)
    means, factors = forecast(mixture.means, mixture.factors, function, noise_factor, rule=rule)
    return _from_factors(mixture.weights, means, factors)


def conditioned(
    mixture: GaussianMixture, observed: ArrayLike, function: Callable[[Array], Array],
    noise: ArrayLike, *, residual: Callable[[Array, Array], Array] = np.subtract,
    rule: str = "dd2", gate: float | None = None,
) -> GaussianMixture:
    """Condition a mixture on a reading: its mixands, and their weights by how likely it was.

    A mixand that cannot explain the reading (`function` is NaN at one of its points) is left out.

    Parameters
    ----------
    mixture : GaussianMixture
    observed : array_like, (m,)
        NaN marks a missing component.
    function, noise, residual, rule
        As of :func:`distfilt.mixtures.unscented.update`, for whole readings.
    gate : float, optional
        Leave the reading out if it is farther than so many standard deviations from every mixand.

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
    instance(mixture, "mixture", GaussianMixture)
    y = array(observed, "observed", ("m",), finite=False)
    r = array(noise, "noise", (y.size, y.size))
    callable_(function, "function")
    callable_(residual, "residual")
    if gate is not None:
        number(gate, "gate", above=0, at_most=1e150)  # its square is a number
    return _conditioned(mixture, y, function, r, residual, rule, gate, "observed")


def _conditioned(
    mixture: GaussianMixture, y: Array, function: Callable[[Array], Array], noise: Array,
    residual: Callable[[Array, Array], Array], rule: str, gate: float | None,
    name: str,
) -> GaussianMixture:
    """The same without checks; `name` is what a reading that nothing explains is called."""
    there = np.flatnonzero(~np.isnan(y))
    if not there.size:
        return mixture

    def gap(a: Array, b: Array) -> Array:
        # A residual may need every component; those that are missing are zeros in both.
        full = np.zeros((2, *np.broadcast_shapes(a.shape, b.shape)[:-1], y.size))
        full[0][..., there], full[1][..., there] = a, b
        return np.asarray(residual(full[0], full[1])[..., there])

    means, factors, logs, distance = update(
        mixture.means, mixture.factors, y[there], lambda x: np.asarray(function(x))[..., there],
        noise[np.ix_(there, there)], residual=gap, rule=rule,
    )
    visible = np.isfinite(logs)
    logs = np.where(visible, mixture.log_weights + logs, -np.inf)
    if not np.isfinite(logs.max()):
        raise ValueError(f"{name}: needs a target that can be seen, got one that cannot")
    if gate is not None and distance[visible].min() > gate**2:
        return mixture
    w = np.exp(logs - logs.max())
    w /= w.sum()
    keep = w > _NOTHING
    return _from_factors(w[keep] / w[keep].sum(), means[keep], factors[keep])


def _from_factors(weights: Array, means: Array, factors: Array) -> GaussianMixture:
    """A mixture that keeps the square roots it came with."""
    array(means, "means", (weights.size, "d"))
    out = trusted(weights, means, factors @ np.swapaxes(factors, -1, -2))
    out.__dict__["factors"] = factors
    return out
