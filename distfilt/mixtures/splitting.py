"""More mixands where a density bends: along the direction that a map stretches."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Annotated

import numpy as np

from ..linalg import symmetrise
from ..validation import (
    Array,
    Bounds,
    Indices,
    PositiveFloat,
    PositiveInt,
    validated,
)
from .gaussian import GaussianMixture

__all__ = ["split_components", "split_library", "split_nonlinear", "nonlinearity"]

Fraction = Annotated[float, Bounds(above=0, below=1)]

# Mixands lighter than this are not split.
_LIGHT = 1e-3


@validated
def split_library(*, std: Fraction = 0.7) -> tuple[Array, Array]:
    r"""Weights and means of three Gaussians of deviation `std` that stand for the standard normal.

    Mean 0 and variance 1 are kept: with weights a, 1 - 2a, a at -m, 0, m that is
    :math:`s^2+2am^2=1`. Of the one freedom left, the smallest integrated squared difference from
    the standard normal density is taken.

    Parameters
    ----------
    std : float
        In (0, 1). Smaller mixands bend less, and fit the tails worse.

    Returns
    -------
    weights, means : ndarray, (3,)

    Examples
    --------
    >>> w, m = split_library(std=0.7)
    >>> round(float(w @ m**2 + 0.7**2), 12)
    1.0
    """
    w, m = _library(std)
    return w.copy(), m.copy()


@lru_cache(maxsize=16)
def _library(std: float) -> tuple[Array, Array]:
    from scipy.optimize import minimize_scalar

    def parts(a: float) -> tuple[Array, Array]:
        m = np.sqrt((1 - std**2) / (2 * a))
        return np.array([a, 1 - 2 * a, a]), np.array([-m, 0.0, m])

    def overlap(gap: Array | float, variance: float) -> Array:
        return np.asarray(np.exp(-0.5 * np.square(gap) / variance) / np.sqrt(variance))

    def ise(a: float) -> float:
        w, m = parts(a)
        own = w @ overlap(m[:, None] - m, 2 * std**2) @ w
        return float(own - 2 * w @ overlap(m, 1 + std**2))

    found = minimize_scalar(
        ise, bounds=(0.01, 0.49), method="bounded", options={"xatol": 1e-12}
    )
    return parts(float(found.x))


@validated
def nonlinearity(
    factors: Annotated[Array, "L d d"],
    jacobians: Annotated[Array, "L m d"],
    *,
    scale: Annotated[Array, "m"] | None = None,
) -> tuple[Array, Array]:
    r"""How far a linearised map takes each mixand, and from where: first-order stretching.

    The direction :math:`\mathbf u=\mathbf S\mathbf v_1` of one standard deviation, with the first
    right singular vector of :math:`\mathbf G\mathbf S`, is the one with the largest image:
    it solves :math:`\max\|\mathbf G\mathbf u\|` over
    :math:`\mathbf u^\top\mathbf P^{-1}\mathbf u=1`.

    Parameters
    ----------
    factors : array_like, (L, d, d)
        Square roots S of the mixands' covariances.
    jacobians : array_like, (L, m, d)
        Jacobians G at their means.
    scale : array_like, (m,), optional
        What each component of the image is multiplied by before lengths are compared.

    Returns
    -------
    directions : ndarray, (L, d)
        One standard deviation long.
    lengths : ndarray, (L,)
        The largest singular values.

    Examples
    --------
    >>> direction, length = nonlinearity([np.diag([3.0, 1.0])], [np.diag([1.0, 2.0])])
    >>> np.abs(direction), length
    (array([[3., 0.]]), array([3.]))
    """
    if scale is not None:
        jacobians = scale[:, None] * jacobians
    _, values, right = np.linalg.svd(jacobians @ factors)
    first = right[:, 0]
    # A singular vector's sign is arbitrary: fix it, though a split does not see it.
    sign = np.sign(first[np.arange(first.shape[0]), np.abs(first).argmax(axis=1)])
    return (factors @ (sign[:, None] * first)[..., None])[..., 0], values[:, 0]


@validated
def split_components(
    mixture: GaussianMixture,
    which: Annotated[Indices, "K", Bounds(at_least=0)],
    directions: Annotated[Array, "K mixture.dim"],
    *,
    std: Fraction = 0.7,
) -> GaussianMixture:
    r"""Replace some mixands by three along a direction, keeping their mean and covariance.

    With :math:`\mathbf u=\mathbf S\mathbf v` for a unit vector v the pieces are
    :math:`\mathcal N(\mathbf m+m_k\mathbf u,\ \mathbf P-(1-s^2)\mathbf u\mathbf u^\top)`.

    Parameters
    ----------
    mixture : GaussianMixture
    which : array_like of int, (K,)
        Which mixands, each once; the pieces come after those that stay.
    directions : array_like, (K, d)
        One standard deviation long, :math:`\mathbf u^\top\mathbf P^{-1}\mathbf u=1`.
    std : float
        As of :func:`split_library`.

    Examples
    --------
    >>> one = GaussianMixture.gaussian([0.0, 0.0], np.eye(2))
    >>> three = split_components(one, [0], [[1.0, 0.0]])
    >>> three.n_components, three.moments()[1].round(12).tolist()
    (3, [[1.0, 0.0], [0.0, 1.0]])
    """
    if (which >= mixture.n_components).any() or np.unique(which).size != which.size:
        raise ValueError(
            f"which must have distinct indices below {mixture.n_components}, got {which.tolist()}"
        )
    white = np.linalg.solve(mixture.factors[which], directions[..., None])[..., 0]
    if np.abs((white**2).sum(axis=1) - 1).max(initial=0.0) > 1e-6:
        raise ValueError(
            "directions must be one standard deviation, got another length"
        )
    w, m = _library(std)
    means = mixture.means[which][:, None] + m[:, None] * directions[:, None]
    less = (
        mixture.covs[which]
        - (1 - std**2) * directions[:, :, None] * directions[:, None, :]
    )
    stay = np.setdiff1d(np.arange(mixture.n_components), which)
    return GaussianMixture.construct(
        np.concatenate(
            [mixture.weights[stay], (mixture.weights[which][:, None] * w).ravel()]
        ),
        np.concatenate([mixture.means[stay], means.reshape(-1, mixture.dim)]),
        np.concatenate([mixture.covs[stay], np.repeat(symmetrise(less), 3, axis=0)]),
    )


@validated
def split_nonlinear(
    mixture: GaussianMixture,
    jacobian: Callable[[Array], Array],
    *,
    max_components: PositiveInt,
    split_threshold: PositiveFloat,
    scale: Annotated[Array, "m"] | None = None,
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
        A mixand is split if its weight times its largest stretching is above this, and its weight
        above a thousandth.
    scale : array_like, (m,), optional
        As of :func:`stretching`.

    Examples
    --------
    >>> one = GaussianMixture.gaussian([0.0], [[1.0]])
    >>> split_nonlinear(
    ...     one, lambda x: 2 * np.ones((1, 1)), max_components=4, split_threshold=1.0
    ... ).n_components
    3
    """
    for _ in range(3):
        room = (max_components - mixture.n_components) // 2
        if room < 1:
            break
        slope = jacobian(mixture.means)
        slope = np.broadcast_to(slope, (mixture.n_components, *np.shape(slope)[-2:]))
        directions, lengths = nonlinearity(mixture.factors, slope, scale=scale)
        cost = np.where(mixture.weights > _LIGHT, mixture.weights * lengths, 0.0)
        worst = np.argsort(-cost, kind="stable")[:room]
        worst = worst[cost[worst] > split_threshold]
        if not worst.size:
            break
        mixture = split_components(mixture, worst, directions[worst])
    return mixture
